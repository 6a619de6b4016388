"""Command line options that several commands share: episode filters and sizes such as 640x480."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from fetch_hand_sim.episode_log.metadata import HasOutcome
from msgs_spec.parameters import LARGEST_PICTURE_SIDE
from msgs_spec.tasks import TASKS


def add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Add `--task`, `--success`, `--failure` and `--complete`; None (default) filters nothing."""
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
        help='only complete episodes, or only interrupted ones',
    )


def is_wanted(options: argparse.Namespace, task: str | None, episode: HasOutcome) -> bool:
    """Return whether an episode of `task` matches the filters of `add_filter_options`.

    An episode whose success is unknown matches neither `--success` nor `--failure`.
    """
    return (
        options.task in (None, task)
        and options.success in (None, episode.outcome.is_success)
        and options.complete in (None, episode.is_complete)
    )


def two_numbers(largest: int) -> Callable[[str], tuple[int, int]]:
    """Return an argparse type for two numbers from 1 to `largest`, written as in `640x480`."""

    def read(text: str) -> tuple[int, int]:
        try:
            first, second = (int(number) for number in text.split('x'))
        except ValueError:
            first = second = 0
        if not (1 <= first <= largest and 1 <= second <= largest):
            raise argparse.ArgumentTypeError(
                f'{text[:80]!r} given; allowed: 1x1 ... {largest}x{largest}'
            )
        return first, second

    return read


picture_size = two_numbers(LARGEST_PICTURE_SIDE)
