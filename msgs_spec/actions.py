"""Normalised actions of the benchmark and commands in ROS units, and what makes a command valid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.robots import RobotSpec


def command_limits(robot: RobotSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper limits of the command, (action_size,) each, in command units."""
    return (
        np.array([part.lower for part in robot.command]),
        np.array([part.upper for part in robot.command]),
    )


def command_from_action(robot: RobotSpec, action: ArrayLike) -> NDArray[Any]:
    """Maps actions in [-1, 1] to commands, clipping what lies outside.

    Fetch: the action itself; its floating type is kept, because Gymnasium-Robotics scales it in
    that type. Hand, and every robot with other limits: through the middle and half width of each
    range, for the hand absolute joint positions (`hand_env.py`).

    Args:
        robot: The robot.
        action: (..., action_size), normalised.

    Returns:
        (..., action_size) in command units.
    """
    clipped = np.asarray(np.clip(np.asarray(action), -1.0, 1.0))
    if _is_normalised(robot):
        return clipped
    lower, upper = command_limits(robot)
    command = (upper + lower) / 2.0 + clipped * ((upper - lower) / 2.0)
    return np.asarray(np.clip(command, lower, upper))


def action_from_command(robot: RobotSpec, command: ArrayLike) -> NDArray[np.float64]:
    """Maps commands (..., action_size) to the actions in [-1, 1] that give them, clipped."""
    values = np.asarray(command, dtype=np.float64)
    if not _is_normalised(robot):
        lower, upper = command_limits(robot)
        values = (values - (upper + lower) / 2.0) / ((upper - lower) / 2.0)
    return np.clip(values, -1.0, 1.0)


def _is_normalised(robot: RobotSpec) -> bool:
    """Whether commands are actions."""
    return all(part.lower == -1.0 and part.upper == 1.0 for part in robot.command)


def resting_command(robot: RobotSpec) -> NDArray[np.float64]:
    """The command of the zero action: the gripper stays, each hand joint goes mid-range."""
    return np.asarray(command_from_action(robot, np.zeros(robot.action_size)), dtype=np.float64)


def clip_command(robot: RobotSpec, command: ArrayLike) -> NDArray[np.float64]:
    """Commands (..., action_size) within the limits of the robot."""
    lower, upper = command_limits(robot)
    return np.clip(np.asarray(command, dtype=np.float64), lower, upper)
