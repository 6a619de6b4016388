"""The tables of shipped actors, from the evaluation files beside them: all of it, and the short."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.runs.origins import steps_behind
from policy_node.training.studies.published import BEST, CEILINGS

_NOT_PUBLISHED = 'no number found'


def actors_table(actors: Path) -> str:
    """Returns the Markdown table of the actors in a folder.

    Raises:
        ValueError: If a file is no evaluation of an actor; the line names it.
    """
    head = (
        '| task | success (95 % interval) | at most | in Gymnasium-Robotics | touched once '
        '| mean return | episodes | env steps | best published (how read; who, steps) |'
    )
    return _table(head, actors, _row)


def actors_summary(actors: Path) -> str:
    """Returns the same in five columns, each task linked to its page.

    Raises:
        ValueError: If a file is no evaluation of an actor; the line names it.
    """
    head = '| task | success (95 % interval) | in Gymnasium-Robotics | best published | by whom |'
    return _table(head, actors, _short_row)


def _table(head: str, actors: Path, row: Callable[[str, dict[str, Any]], list[str]]) -> str:
    lines = [head, '|' + ' --- |' * (head.count('|') - 1)]
    for task in TASKS:
        report = actors / f'{task}.json'
        if report.is_file():
            try:
                lines.append(f'| {" | ".join(row(task, json.loads(report.read_text())))} |')
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise ValueError(f'{report} is no evaluation of an actor: {error!r}') from None
    return '\n'.join(lines)


def _row(task: str, report: dict[str, Any]) -> list[str]:
    return [
        task,
        _success(report),
        f'{CEILINGS[task]:.3f}' if task in CEILINGS else '',
        _in_reference(report),
        f'{report["touched"]:.3f}',
        f'{report["mean_return"]:.2f}',
        f'{report["episodes"]:,}',
        f'{steps_behind(report) / 1e6:.2f}M',
        str(BEST.get(task, _NOT_PUBLISHED)),
    ]


def _short_row(task: str, report: dict[str, Any]) -> list[str]:
    ours = [f'[{task}](docs/tasks/{task}.md)', _success(report), _in_reference(report)]
    if task not in BEST:
        return [*ours, _NOT_PUBLISHED, '']
    best = BEST[task]
    return [*ours, f'{best.success} ({best.kind})', best.source]


def _success(report: dict[str, Any]) -> str:
    lower, upper = report['success_gymnasium_interval_95']
    return f'**{report["success_gymnasium"]:.3f}** ({lower:.3f} ... {upper:.3f})'


def _in_reference(report: dict[str, Any]) -> str:
    """What the reference's own environments counted, where they were asked."""
    reference = report.get('reference')
    return f'{reference["success"]:.3f} of {reference["episodes"]:,}' if reference else ''
