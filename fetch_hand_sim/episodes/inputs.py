"""Rules by which a robot accepts goals and pushes; the check of its log applies the same rules."""

from __future__ import annotations

from typing import Any

import numpy as np

from fetch_hand_sim.episodes.runner import EpisodeRunner
from msgs_spec.arrays import Array
from msgs_spec.codecs import check_frame, decode, message_stamp
from msgs_spec.topics import TopicSpec

# Metres. Goals beyond overflow in distances and rewards sooner or later.
FARTHEST_GOAL = 1000.0
# Newton metres of torque for each newton of force: fingers are about as long, in metres.
_LEVER = 0.1
_WITHIN = 1.0 - 1e-9


def accept_goal(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, *, reads_header: bool = True
) -> None:
    """Replace the goal of the running episode from the next tick on.

    Args:
        topic: `set_goal` of the task.
        message: The received message, of rclpy or of `schemas`.
        reads_header: Whether frame and stamp count; robots of interface version 1 ignored both.

    Raises:
        ValueError: If the goal is rejected; the episode is unchanged.
    """
    if runner.is_between_episodes:
        raise ValueError('no episode is running')
    if reads_header:
        check_frame(topic, message.header.frame_id)
        _check_stamp(runner, message_stamp(message))
    goal = decode(topic, message)
    beyond = np.abs(goal) > FARTHEST_GOAL
    if beyond.any():
        allowed = f'-{FARTHEST_GOAL:g} ... {FARTHEST_GOAL:g}'
        raise ValueError(f'{goal[beyond][0]:g} given; allowed: {allowed}')
    runner.set_goal(goal)


def _check_stamp(runner: EpisodeRunner, stamp_ns: int) -> None:
    """Reject goals of another episode or of the future."""
    first, last = runner.current.first_stamp_ns, runner.stamp_ns
    if stamp_ns and not first <= stamp_ns <= last:
        raise ValueError(
            f'stamp {stamp_ns / 1e9:.3f} s given; allowed: 0, or simulated time of the running '
            f'episode, {first / 1e9:.3f} ... {last / 1e9:.3f} s'
        )


def bounded_wrench(wrench: Array, limit: float) -> Array:
    """Return a wrench (6,) that is accepted: the same, or a weaker one along the same line.

    Args:
        wrench: N and N m.
        limit: Largest force, N.
    """
    force, torque = _sizes(wrench)
    share = max(force / limit, torque / (_LEVER * limit))
    # Slightly within the limit, so that rounding does not exceed it.
    return wrench if share <= _WITHIN else wrench * (_WITHIN / share)


def accept_perturbation(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, limit: float
) -> None:
    """Push a body of the running episode during its next tick.

    Args:
        topic: `perturb` of the task.
        message: The received message, of rclpy or of `schemas`.
        limit: Largest force, N; 0 rejects all.

    Raises:
        ValueError: If the push is rejected; the episode is unchanged.
    """
    if not limit:
        raise ValueError('perturbations are off; perturb_limit:=10.0 at the start allows 10 N')
    if runner.is_between_episodes:
        raise ValueError('no episode is running')
    wrench = decode(topic, message)
    force, torque = _sizes(wrench)
    # Written so that NaN is rejected too.
    if not (force <= limit and torque <= _LEVER * limit):
        raise ValueError(
            f'{force:g} N and {torque:g} N m given; allowed: up to {limit:g} N and '
            f'{_LEVER * limit:g} N m'
        )
    runner.perturb(message.header.frame_id, wrench)


def _sizes(wrench: Array) -> tuple[float, float]:
    """Return the sizes of the force, N, and of the torque, N m."""
    # A number too large to be squared is beyond every limit.
    with np.errstate(over='ignore'):
        return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
