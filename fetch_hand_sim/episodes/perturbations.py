"""When a robot lets itself be pushed: one rule for the robot and for the check of its log."""

from __future__ import annotations

from typing import Any

import numpy as np

from fetch_hand_sim.episodes.runner import EpisodeRunner
from msgs_spec.arrays import Array
from msgs_spec.codecs import decode
from msgs_spec.topics import TopicSpec

# Newton metres of torque for each newton of force: fingers are about as long, in metres.
_LEVER = 0.1
_WITHIN = 1.0 - 1e-9


def bounded_wrench(wrench: Array, limit: float) -> Array:
    """Returns a wrench (6,) that is accepted: the same, or weaker along the same line.

    Args:
        wrench: N and N m.
        limit: Largest force, N.
    """
    force, torque = _sizes(wrench)
    share = max(force / limit, torque / (_LEVER * limit))
    # A hair within the limit, whatever rounding does.
    return wrench if share <= _WITHIN else wrench * (_WITHIN / share)


def accept_perturbation(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, limit: float
) -> None:
    """Pushes a body of the running episode during its next tick.

    Args:
        runner: Runs the episode.
        topic: `perturb` of its task.
        message: What was received, of rclpy or of `schemas`.
        limit: Largest force, N; 0 refuses all.

    Raises:
        ValueError: If it is refused, and nothing has changed; the message is one line.
    """
    if not limit:
        raise ValueError('perturbations are off; perturb_limit:=10.0 at the start allows 10 N')
    if runner.is_between_episodes:
        raise ValueError('no episode is running')
    wrench = decode(topic, message)
    force, torque = _sizes(wrench)
    # Not "beyond the limit": what is not a number is refused as well.
    if not (force <= limit and torque <= _LEVER * limit):
        raise ValueError(
            f'{force:g} N and {torque:g} N m given; allowed: up to {limit:g} N and '
            f'{_LEVER * limit:g} N m'
        )
    runner.perturb(message.header.frame_id, wrench)


def _sizes(wrench: Array) -> tuple[float, float]:
    """Sizes of the force, N, and of the torque, N m."""
    # Whatever is too large to be squared is beyond every limit.
    with np.errstate(over='ignore'):
        return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
