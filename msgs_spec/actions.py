"""Conversion between normalised actions and commands in ROS units, and command limits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.robots import RobotSpec


def command_limits(robot: RobotSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lower and upper limits of the command, (action_size,) each, in command units."""
    return (
        np.array([part.lower for part in robot.command]),
        np.array([part.upper for part in robot.command]),
    )


def command_from_action(robot: RobotSpec, action: ArrayLike) -> NDArray[Any]:
    """Map actions (..., action_size), clipped to [-1, 1], to commands of the same shape.

    Fetch: the command is the action. Its floating type is kept, because Gymnasium-Robotics scales
    it in that type. Other robots: -1 and 1 are the limits of the command, as in `hand_env.py`.
    """
    clipped = np.asarray(np.clip(np.asarray(action), -1.0, 1.0))
    if _is_normalised(robot):
        return clipped
    lower, upper = command_limits(robot)
    command = (upper + lower) / 2.0 + clipped * ((upper - lower) / 2.0)
    return np.asarray(np.clip(command, lower, upper))


def action_from_command(robot: RobotSpec, command: ArrayLike) -> NDArray[np.float64]:
    """Map commands (..., action_size) to actions, clipped to [-1, 1]."""
    values = np.asarray(command, dtype=np.float64)
    if not _is_normalised(robot):
        lower, upper = command_limits(robot)
        values = (values - (upper + lower) / 2.0) / ((upper - lower) / 2.0)
    return np.clip(values, -1.0, 1.0)


def _is_normalised(robot: RobotSpec) -> bool:
    """Return whether commands equal actions."""
    return all(part.lower == -1.0 and part.upper == 1.0 for part in robot.command)


def resting_command(robot: RobotSpec) -> NDArray[np.float64]:
    """Return the command of the zero action: the gripper stays, hand joints go mid-range."""
    return np.asarray(command_from_action(robot, np.zeros(robot.action_size)), dtype=np.float64)


def clip_command(robot: RobotSpec, command: ArrayLike) -> NDArray[np.float64]:
    """Clip commands (..., action_size) to the limits of the robot."""
    lower, upper = command_limits(robot)
    return np.clip(np.asarray(command, dtype=np.float64), lower, upper)
