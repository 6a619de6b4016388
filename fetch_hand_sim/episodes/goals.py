"""When a robot takes a received goal: one rule for the robot and for the check of its log."""

from __future__ import annotations

from typing import Any

import numpy as np

from fetch_hand_sim.episodes.runner import EpisodeRunner
from msgs_spec.codecs import check_frame, decode, message_stamp
from msgs_spec.topics import TopicSpec

# Goals beyond, in metres, would overflow in distances and rewards sooner or later.
FARTHEST_GOAL = 1000.0


def accept_goal(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, *, reads_header: bool = True
) -> None:
    """Replaces the goal of the running episode from the next tick on.

    Args:
        runner: Runs the episode.
        topic: `set_goal` of its task.
        message: What was received, of rclpy or of `schemas`.
        reads_header: Whether frame and stamp count; robots of interface version 1 ignored both.

    Raises:
        ValueError: If the goal is refused, and nothing has changed; the message is one line.
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
    """A goal of another episode comes too late, one of the future too early."""
    first, last = runner.current.first_stamp_ns, runner.stamp_ns
    if stamp_ns and not first <= stamp_ns <= last:
        raise ValueError(
            f'stamp {stamp_ns / 1e9:.3f} s given; allowed: 0, or simulated time of the running '
            f'episode, {first / 1e9:.3f} ... {last / 1e9:.3f} s'
        )
