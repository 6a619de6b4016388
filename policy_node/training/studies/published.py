"""Tables of shipped actors, and published success rates to compare them with.

The paper gives curves but no numbers. So `RERUN` contains results of other authors, who ran the
paper's code and configuration at about its budget. `BEST` has the best known results of any method.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.runs.initial_networks import steps_behind

EXACT = 'exact'
"""Read from a text, log, table or configuration file of the source."""
QUOTED = 'quoted'
"""Quoted second-hand from the source, whose own table was not checked."""
FIGURE = 'figure'
"""Read off a figure, within 0.01 to 0.02."""


@dataclass(frozen=True, slots=True)
class Published:
    """A published success rate.

    Attributes:
        success: Success rate at the last step, as text such as `0.994 +- 0.009`.
        kind: How it was read: `exact`, `quoted` (second-hand) or `figure` (off a figure).
    """

    success: str
    kind: str
    source: str

    def __str__(self) -> str:
        return f'{self.success} ({self.kind}; {self.source})'


_REACH = Published('solved', EXACT, 'Plappert et al. 2018, text: by all four arms')
_EBP = 'EBP, arXiv 1810.01363, its HER baseline, 19 CPUs, 5 seeds'
_MRL = 'spitis/mrl, HER + futureactual'
_USHER = 'schrammlb2/USHER_Implementation'

RERUN: dict[tuple[str, str], Published] = {
    **{('FetchReach', arm): _REACH for arm in ('her_sparse', 'her_dense')},
    **{('FetchReach', arm): _REACH for arm in ('ddpg_sparse', 'ddpg_dense')},
    ('FetchPush', 'her_sparse'): Published('about 0.99', QUOTED, "re-run at the paper's budget"),
    ('FetchPush', 'ddpg_sparse'): Published('0.05-0.08', FIGURE, f'{_USHER}, to 24k episodes'),
    ('FetchPickAndPlace', 'her_sparse'): Published('0.9378', QUOTED, _EBP),
    ('FetchSlide', 'her_sparse'): Published('about 0.75', QUOTED, "re-run at the paper's budget"),
    ('FetchSlide', 'ddpg_sparse'): Published('about 0.18', FIGURE, f'{_USHER}, 90k episodes'),
    ('HandManipulateBlockFull', 'her_sparse'): Published('0.2032', QUOTED, _EBP),
    ('HandManipulateEggFull', 'her_sparse'): Published('0.7619', QUOTED, _EBP),
    ('HandManipulatePenRotate', 'her_sparse'): Published('0.2728', QUOTED, _EBP),
}
"""The paper's arms by task and arm, re-run by others at its budget or about it."""

BEST: dict[str, Published] = {
    'FetchReach': Published('1.00', EXACT, 'rl-baselines3-zoo TQC/SAC + HER, 3,000 episodes'),
    'FetchPush': Published('0.994 +- 0.009', EXACT, 'VladPrytula/robotics_series, SAC, v4, 2M'),
    'FetchPickAndPlace': Published('1.000', EXACT, 'VladPrytula/robotics_series, SAC, v4, 5M'),
    'FetchSlide': Published('0.88', FIGURE, f'{_MRL}, 2.5M'),
    'HandReach': Published('about 0.40', QUOTED, 'VDS, 2M'),
    'HandManipulateBlockFull': Published('0.675', FIGURE, f'{_MRL}, 40M'),
    'HandManipulateEggFull': Published('0.93', FIGURE, f'{_MRL}, 40M'),
    'HandManipulatePenRotate': Published('0.3169', QUOTED, 'EBP, arXiv 1810.01363, 38M'),
    'HandManipulatePenFull': Published('0.48', FIGURE, f'{_MRL}, 40M'),
}
"""Best known by task, with any method and budget."""

CEILINGS: dict[str, float] = {
    'HandReach': 0.957,
    'HandManipulatePenRotate': 0.925,
    'HandManipulatePenFull': 0.926,
}
"""Share of goals that can be reached at all, where it was computed (docs/results.md, Ceilings)."""

_NOT_PUBLISHED = 'no number found'


def actors_table(actors: Path) -> str:
    """Return a Markdown table with success, return and steps of each `<task>.json` in a folder.

    Raises:
        ValueError: If a file is no evaluation of an actor; the message names the file.
    """
    head = (
        '| task | success (95 % interval) | at most | in Gymnasium-Robotics | at any step '
        '| mean return | episodes | env steps | best published (how read; who, steps) |'
    )
    return _table(head, actors, _row)


def actors_summary(actors: Path) -> str:
    """Return a Markdown table with only the success of each `<task>.json` in a folder.

    Raises:
        ValueError: If a file is no evaluation of an actor; the message names the file.
    """
    head = '| task | success | 95 % interval | in Gymnasium-Robotics | best published |'
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
    lower, upper = report['success_gymnasium_interval_95']
    reference = report.get('reference')
    return [
        task,
        f'**{report["success_gymnasium"]:.3f}** ({lower:.3f} ... {upper:.3f})',
        f'{CEILINGS[task]:.3f}' if task in CEILINGS else '',
        f'{reference["success"]:.3f} of {reference["episodes"]:,}' if reference else '',
        f'{report["touched"]:.3f}',
        f'{report["mean_return"]:.2f}',
        f'{report["episodes"]:,}',
        f'{steps_behind(report) / 1e6:.2f}M',
        str(BEST.get(task, _NOT_PUBLISHED)),
    ]


def _short_row(task: str, report: dict[str, Any]) -> list[str]:
    lower, upper = report['success_gymnasium_interval_95']
    reference = report.get('reference')
    return [
        task,
        f'**{report["success_gymnasium"]:.3f}**',
        f'{lower:.3f} ... {upper:.3f}',
        f'{reference["success"]:.3f}' if reference else '',
        BEST[task].success if task in BEST else '',
    ]
