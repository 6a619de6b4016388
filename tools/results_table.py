"""The README's table of shipped actors, from the evaluation files that lie beside them.

python tools/results_table.py --write README.md
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
ACTORS = ROOT / 'policy_node' / 'actors'
BEGIN, END = '<!-- results -->', '<!-- /results -->'

# Best success at the last step found published for each task: value, steps, source.
PUBLISHED = {
    'FetchReach': '1.00, 10k-20k (`spitis/mrl`)',
    'FetchPush': '0.994, 2M (SAC+HER, `VladPrytula/robotics_series`)',
    'FetchSlide': '0.88, 2.5M (`spitis/mrl`, read off a figure)',
    'FetchPickAndPlace': '1.000 of 300 episodes, 5M (SAC+HER, `VladPrytula/robotics_series`)',
    'HandReach': 'about 0.40, 2M (`zzyunzhi/vds`, quoted)',
}


def table(actors: Path = ACTORS) -> str:
    """Returns the Markdown table."""
    lines = [
        '| task | success (95 % interval) | in Gymnasium-Robotics | touched once | mean return '
        '| episodes | env steps | best published, steps |',
        '| --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    found = {path.stem: json.loads(path.read_text()) for path in actors.glob('*.json')}
    for task, published in PUBLISHED.items():
        if task in found:
            lines.append(_row(task, found[task], published))
    return '\n'.join(lines)


def _row(task: str, report: dict[str, Any], published: str) -> str:
    lower, upper = report['success_gymnasium_interval_95']
    reference = report.get('reference')
    cells = [
        task,
        f'**{report["success_gymnasium"]:.3f}** ({lower:.3f} ... {upper:.3f})',
        f'{reference["success"]:.3f} of {reference["episodes"]:,}' if reference else '',
        f'{report["touched"]:.3f}',
        f'{report["mean_return"]:.2f}',
        f'{report["episodes"]:,}',
        f'{report["env_steps"] / 1e6:.2f}M',
        published,
    ]
    return f'| {" | ".join(cells)} |'


def with_table(readme: str) -> str:
    """Returns the README with the present table between its markers.

    Raises:
        ValueError: If the markers are missing.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f'no {BEGIN} ... {END}')
    return f'{before}{BEGIN}\n\n{table()}\n\n{END}{after}'


def main() -> int:
    """Prints or writes the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--write', type=Path, metavar='README.md', help='file to update')
    path: Path | None = parser.parse_args().write
    if path is None:
        print(table())
        return 0
    try:
        path.write_text(with_table(path.read_text(encoding='utf-8')), encoding='utf-8')
    except (OSError, ValueError) as error:
        print(f'results_table: {path}: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
