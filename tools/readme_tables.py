"""The tables of results in README.md and docs/simulation.md.

Shipped actors come from the evaluation files beside them, speed from the last `make bench-sim`.

python tools/readme_tables.py --write README.md docs/simulation.md
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
ACTORS = ROOT / 'policy_node' / 'actors'
SPEED = ROOT / 'bench' / 'results' / 'bench_sim.csv'

# Best success at the last step found published for each task: value, steps, source.
PUBLISHED = {
    'FetchReach': '1.00, 10k-20k (`spitis/mrl`)',
    'FetchPush': '0.994, 2M (SAC+HER, `VladPrytula/robotics_series`)',
    'FetchSlide': '0.88, 2.5M (`spitis/mrl`, read off a figure)',
    'FetchPickAndPlace': '1.000 of 300 episodes, 5M (SAC+HER, `VladPrytula/robotics_series`)',
    'HandReach': 'about 0.40, 2M (`zzyunzhi/vds`, quoted)',
    'HandManipulateBlockRotateZ': 'no number found',
    'HandManipulateBlockRotateParallel': 'no number found',
    'HandManipulateBlockRotateXYZ': 'no number found',
    'HandManipulateBlockFull': '0.675, 40M (`spitis/mrl`, read off a figure)',
    'HandManipulateEggRotate': 'no number found',
    'HandManipulateEggFull': '0.93, 40M (`spitis/mrl`, read off a figure)',
    'HandManipulatePenRotate': '0.317, 38M (EBP, arXiv 1810.01363, quoted)',
    'HandManipulatePenFull': '0.48, 40M (`spitis/mrl`, read off a figure)',
}


def actors_table(actors: Path = ACTORS) -> str:
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


def speed_table(path: Path = SPEED) -> str:
    """Returns the Markdown table of environment steps per second, and what it was measured on."""
    text = path.read_text(encoding='utf-8')
    machine, rows = text.splitlines()[0].lstrip('# '), list(csv.DictReader(_without_comments(text)))
    threads = sorted({int(row['threads']) for row in rows})
    one, many = ({r['task']: r for r in rows if int(r['threads']) == n} for n in threads[:2])
    lines = [
        '| task | this project | of bare physics | EnvPool | x EnvPool | Gymnasium-Robotics, one '
        f'process | x that | {threads[1]} threads | of bare physics | x EnvPool '
        '| x one process of Gymnasium-Robotics |',
        '| --- |' + ' ---: |' * 10,
    ]
    ratios: list[list[float]] = []
    for task, row in one.items():
        wide, process = many[task], float(row['gymnasium_robotics'])
        gain = float(wide['this_project']) / process
        ours, peer, bare = 'this_project', 'ratio_envpool', 'ratio_bare_physics'
        ratios.append([float(row[peer]), float(wide[peer]), gain])
        cells = [
            *(task, f'{float(row[ours]):,.0f}', f'{float(row[bare]):.0%}'),
            *(f'{float(row["envpool"]):,.0f}', f'{float(row[peer]):.2f}'),
            *(f'{process:,.0f}', f'{float(row["ratio_gymnasium_robotics"]):.1f}'),
            *(f'{float(wide[ours]):,.0f}', f'{float(wide[bare]):.0%}'),
            *(f'{float(wide[peer]):.2f}', f'{gain:.1f}'),
        ]
        lines.append(f'| {" | ".join(cells)} |')
    means = [statistics.geometric_mean(column) for column in zip(*ratios, strict=True)]
    lines.append(
        f'| *geometric mean* | | | | {means[0]:.2f} | | | | | {means[1]:.2f} | {means[2]:.1f} |'
    )
    return '\n'.join([*lines, '', f'({machine})'])


def _without_comments(text: str) -> Iterable[str]:
    return (line for line in text.splitlines() if not line.startswith('#'))


TABLES = {'results': actors_table, 'speed': speed_table}


def with_tables(page: str) -> str:
    """Returns a page with the present tables between its markers.

    Raises:
        ValueError: If there are no markers, or one without the other.
    """
    found = False
    for name, table in TABLES.items():
        first, last = f'<!-- {name} -->', f'<!-- /{name} -->'
        before, begin, rest = page.partition(first)
        _, end, after = rest.partition(last)
        if bool(begin) != bool(end):
            raise ValueError(f'no {first} ... {last}')
        if begin:
            found = True
            page = f'{before}{first}\n\n{table()}\n\n{last}{after}'
    if not found:
        raise ValueError(f'no markers; allowed: {", ".join(f"<!-- {name} -->" for name in TABLES)}')
    return page


def main() -> int:
    """Prints or writes the tables; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--write', type=Path, nargs='+', metavar='PAGE', help='pages to update')
    paths: list[Path] | None = parser.parse_args().write
    if paths is None:
        print('\n\n'.join(table() for table in TABLES.values()))
        return 0
    for path in paths:
        try:
            path.write_text(with_tables(path.read_text(encoding='utf-8')), encoding='utf-8')
        except (OSError, ValueError) as error:
            print(f'readme_tables: {path}: {error}', file=sys.stderr)
            return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
