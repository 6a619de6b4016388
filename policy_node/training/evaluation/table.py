"""The summary of an evaluation as a table."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

_DIAGNOSES = {
    'stay': 'success at the next tick, given success at this one',
    'long_way': 'success where the goal is the long way round',
    'dropped': 'object below the palm at the end',
    'distance': 'median distance at the end, m',
    'rotation': 'median rotation at the end, rad',
}

_NARROWEST = 60


def print_table(report: dict[str, Any]) -> None:
    """Prints rates with their 95 % intervals."""
    title = f'{report["task"]}: {report["policy"]}, {report["episodes"]} episodes'
    if 'disturbances' in report:
        title += ', disturbed'
    table = Table('measure', 'value', '95 % interval', title=Text(title))
    names = {
        'success_gymnasium': 'success at the last step, gymnasium rule',
        'success_paper': 'success at the last step, paper rule',
        'touched': 'goal touched at least once',
    }
    for name, label in names.items():
        low, high = report[f'{name}_interval_95']
        table.add_row(label, f'{report[name]:.4f}', f'{low:.4f} ... {high:.4f}')
    for name, label in _DIAGNOSES.items():
        if name in report:
            table.add_row(label, f'{report[name]:.4f}', '')
    table.add_row('mean return', f'{report["mean_return"]:.3f}', '')
    table.add_row('diverged episodes', str(report['diverged']), '')
    # Numbers are whole in a terminal that has no room for them.
    Console(width=max(Console().width, _NARROWEST)).print(table)
