"""Which of the episodes in a folder a command takes, by their task and how they ended."""

from __future__ import annotations

import argparse

from fetch_hand_sim.episode_log.episode_record import HasOutcome
from msgs_spec.tasks import TASKS


def add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Adds `--task`, `--success`, `--failure` and `--complete`; one not given is None."""
    parser.add_argument('--task', choices=list(TASKS), metavar='TASK', help='only this task')
    success = parser.add_mutually_exclusive_group()
    success.add_argument('--success', action='store_true', default=None, help='only successes')
    success.add_argument(
        '--failure', dest='success', action='store_false', help='only failures', default=None
    )
    parser.add_argument(
        '--complete',
        action=argparse.BooleanOptionalAction,
        default=None,
        help='only episodes that ran to their end, or only interrupted ones',
    )


def is_wanted(options: argparse.Namespace, task: str | None, episode: HasOutcome) -> bool:
    """Whether a command takes an episode; one that does not say is no success and no failure."""
    return (
        options.task in (None, task)
        and options.success in (None, episode.outcome.is_success)
        and options.complete in (None, episode.is_complete)
    )
