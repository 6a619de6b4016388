"""The table of docs/speed.md, from the results of the last `make bench-sim`."""

from __future__ import annotations

import csv
import statistics
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SPEED = ROOT / 'bench' / 'results' / 'bench_sim.csv'


def speed_table() -> str:
    """Return the Markdown table of environment steps per second, and the machine."""
    machine, *table = SPEED.read_text(encoding='utf-8').splitlines()
    rows = list(csv.DictReader(table))
    threads = sorted({int(row['threads']) for row in rows})[:2]
    one, many = ({r['task']: r for r in rows if int(r['threads']) == n} for n in threads)
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
    return '\n'.join([*lines, '', f'({machine.lstrip("# ")})'])
