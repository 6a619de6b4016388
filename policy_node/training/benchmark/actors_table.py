"""The table of shipped actors, from the evaluation files beside them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.benchmark.published import BEST, CEILINGS
from policy_node.training.learning.origins import steps_behind


def actors_table(actors: Path) -> str:
    """Returns the Markdown table of the actors in a folder.

    Raises:
        ValueError: If a file is no evaluation of an actor; the line names it.
    """
    lines = [
        '| task | success (95 % interval) | at most | in Gymnasium-Robotics | touched once '
        '| mean return | episodes | env steps | best published (how read; who, steps) |',
        '| --- | --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    for task in TASKS:
        report = actors / f'{task}.json'
        if report.is_file():
            try:
                lines.append(_row(task, json.loads(report.read_text())))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise ValueError(f'{report} is no evaluation of an actor: {error!r}') from None
    return '\n'.join(lines)


def _row(task: str, report: dict[str, Any]) -> str:
    lower, upper = report['success_gymnasium_interval_95']
    reference = report.get('reference')
    cells = [
        task,
        f'**{report["success_gymnasium"]:.3f}** ({lower:.3f} ... {upper:.3f})',
        f'{CEILINGS[task]:.3f}' if task in CEILINGS else '',
        f'{reference["success"]:.3f} of {reference["episodes"]:,}' if reference else '',
        f'{report["touched"]:.3f}',
        f'{report["mean_return"]:.2f}',
        f'{report["episodes"]:,}',
        f'{steps_behind(report) / 1e6:.2f}M',
        str(BEST.get(task, 'no number found')),
    ]
    return f'| {" | ".join(cells)} |'
