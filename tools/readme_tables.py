"""The tables of results in README.md, docs/speed.md and docs/results.md.

Shipped actors come from the evaluation files beside them, speed from the last `make bench-sim`.

python tools/readme_tables.py --write README.md docs/speed.md docs/results.md
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path

from policy_node.training.studies.published import actors_summary, actors_table

ROOT = Path(__file__).resolve().parent.parent
ACTORS = ROOT / 'policy_node' / 'actors'
SPEED = ROOT / 'bench' / 'results' / 'bench_sim.csv'


def speed_table(path: Path = SPEED) -> str:
    """Returns the Markdown table of environment steps per second, and what it was measured on."""
    machine, threads, (one, many) = _measured(path)
    lines = [
        '| task | this project | of bare physics | EnvPool | x EnvPool | Gymnasium-Robotics, one '
        f'process | x that | {threads} threads | of bare physics | x EnvPool '
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


def _measured(path: Path) -> tuple[str, int, list[dict[str, dict[str, str]]]]:
    """The machine, the larger number of threads, and the rows by task of one and of that many."""
    text = path.read_text(encoding='utf-8')
    rows = list(csv.DictReader(_without_comments(text)))
    threads = sorted({int(row['threads']) for row in rows})[:2]
    tables = [{r['task']: r for r in rows if int(r['threads']) == n} for n in threads]
    return text.splitlines()[0].lstrip('# '), threads[1], tables


def _without_comments(text: str) -> Iterable[str]:
    return (line for line in text.splitlines() if not line.startswith('#'))


TABLES = {
    'results': lambda: actors_table(ACTORS),
    'results, short': lambda: actors_summary(ACTORS),
    'speed': speed_table,
}


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
