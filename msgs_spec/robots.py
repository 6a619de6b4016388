"""Robot specifications: order of joints, units and limits of commands, normalised actions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.arrays import Array

# Metres at 25 Hz by which a gripper action of 1 moves the mocap target ahead of the gripper:
# Plappert et al. 2018, section 1.1, and `fetch_env.py` of Gymnasium-Robotics.
GRIPPER_STEP = 0.05
# Prefix of the joint names in the MJCF, and on the network by default.
JOINT_PREFIX = 'robot0:'
# Stands for `JOINT_PREFIX` in the parameter `joint_prefix`: YAML reads `robot0:` as a mapping, so
# neither `-p joint_prefix:=robot0:` nor `ros2 param load` can carry it.
MODEL_PREFIX = 'model'
LONGEST_JOINT_PREFIX = 64


@dataclass(frozen=True, slots=True)
class CommandPart:
    """One number of the command vector, for an axis or a joint.

    Attributes:
        lower: Smallest value after clipping.
        upper: Largest value after clipping.
        unit: SI unit; for Fetch, the meaning of the dimensionless value, such as 'x 0.05 m'.
    """

    name: str
    lower: float
    upper: float
    unit: str


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """A robot as data: its joints and its command.

    Attributes:
        name: `fetch`, `shadow_hand`, or the name of a third-party robot.
        joints: Scalar joints, named and ordered as in `joint_states`.
        joint_units: 'm' or 'rad' for each joint.
        command: Parts of the command; the normalised action has the same parts.
        has_gripper_command: Whether commands move a gripper and are dimensionless, as for Fetch.
            Otherwise they are absolute joint positions.
    """

    name: str
    joints: tuple[str, ...]
    joint_units: tuple[str, ...]
    command: tuple[CommandPart, ...]
    has_gripper_command: bool

    @property
    def action_size(self) -> int:
        """Length of action and command: 4 for Fetch, 20 for the hand."""
        return len(self.command)

    def with_joint_prefix(self, prefix: str) -> RobotSpec:
        """Return a copy with `prefix`, such as `rh_`, in place of `robot0:` in the joint names."""

        def renamed(name: str) -> str:
            is_joint = name.startswith(JOINT_PREFIX)
            return prefix + name.removeprefix(JOINT_PREFIX) if is_joint else name

        joints = tuple(map(renamed, self.joints))
        command = tuple(replace(part, name=renamed(part.name)) for part in self.command)
        return replace(self, joints=joints, command=command)


def check_joint_prefix(prefix: str) -> None:
    """Raise ValueError if a prefix has more than `LONGEST_JOINT_PREFIX` characters."""
    if len(prefix) > LONGEST_JOINT_PREFIX:
        raise ValueError(
            f'joint_prefix of {len(prefix)} characters; allowed: up to {LONGEST_JOINT_PREFIX}'
        )


def read_joint_prefix(robot: RobotSpec, prefix: str) -> str:
    """Return the prefix of joint names for the value `prefix` of the parameter `joint_prefix`.

    `model` gives `robot0:`. Other values are returned as they are, or raise ValueError if no joint
    of the robot begins with `robot0:`.
    """
    if prefix in (MODEL_PREFIX, JOINT_PREFIX):
        return JOINT_PREFIX
    if robot.with_joint_prefix(prefix).joints == robot.joints:
        raise ValueError(
            f'joint_prefix {prefix!r} replaces {JOINT_PREFIX}, but no joint of {robot.name} begins '
            f'with it; allowed: {MODEL_PREFIX!r}'
        )
    return prefix


_FETCH_NAMES = (
    'slide0 slide1 slide2 torso_lift_joint head_pan_joint head_tilt_joint shoulder_pan_joint '
    'shoulder_lift_joint upperarm_roll_joint elbow_flex_joint forearm_roll_joint wrist_flex_joint '
    'wrist_roll_joint r_gripper_finger_joint l_gripper_finger_joint'
).split()
_FETCH_SLIDING = (
    'slide0 slide1 slide2 torso_lift_joint r_gripper_finger_joint l_gripper_finger_joint'
).split()

FETCH = RobotSpec(
    name='fetch',
    joints=tuple(f'{JOINT_PREFIX}{name}' for name in _FETCH_NAMES),
    joint_units=tuple('m' if name in _FETCH_SLIDING else 'rad' for name in _FETCH_NAMES),
    command=(
        CommandPart('x', -1.0, 1.0, 'x 0.05 m'),
        CommandPart('y', -1.0, 1.0, 'x 0.05 m'),
        CommandPart('z', -1.0, 1.0, 'x 0.05 m'),
        CommandPart('gripper', -1.0, 1.0, '-1 closes, 1 opens'),
    ),
    has_gripper_command=True,
)

# Control ranges of the actuators in `hand/shared.xml`, rad; a test compares them with the compiled
# model.
_HAND_COMMAND_RANGES = (
    ('robot0:WRJ1', -0.489, 0.14),
    ('robot0:WRJ0', -0.698, 0.489),
    ('robot0:FFJ3', -0.349, 0.349),
    ('robot0:FFJ2', 0.0, 1.571),
    ('robot0:FFJ1', 0.0, 1.571),
    ('robot0:MFJ3', -0.349, 0.349),
    ('robot0:MFJ2', 0.0, 1.571),
    ('robot0:MFJ1', 0.0, 1.571),
    ('robot0:RFJ3', -0.349, 0.349),
    ('robot0:RFJ2', 0.0, 1.571),
    ('robot0:RFJ1', 0.0, 1.571),
    ('robot0:LFJ4', 0.0, 0.785),
    ('robot0:LFJ3', -0.349, 0.349),
    ('robot0:LFJ2', 0.0, 1.571),
    ('robot0:LFJ1', 0.0, 1.571),
    ('robot0:THJ4', -1.047, 1.047),
    ('robot0:THJ3', 0.0, 1.222),
    ('robot0:THJ2', -0.209, 0.209),
    ('robot0:THJ1', -0.524, 0.524),
    ('robot0:THJ0', -1.571, 0.0),
)

_HAND_JOINTS = tuple(
    f'robot0:{name}'
    for name in (
        'WRJ1 WRJ0 FFJ3 FFJ2 FFJ1 FFJ0 MFJ3 MFJ2 MFJ1 MFJ0 RFJ3 RFJ2 RFJ1 RFJ0 '
        'LFJ4 LFJ3 LFJ2 LFJ1 LFJ0 THJ4 THJ3 THJ2 THJ1 THJ0'
    ).split()
)

SHADOW_HAND = RobotSpec(
    name='shadow_hand',
    joints=_HAND_JOINTS,
    joint_units=('rad',) * len(_HAND_JOINTS),
    command=tuple(
        CommandPart(name, lower, upper, 'rad') for name, lower, upper in _HAND_COMMAND_RANGES
    ),
    has_gripper_command=False,
)

# Order of the fingertips in `achieved_goal`, `desired_goal` and `fingertip_poses` (MJCF sites
# `robot0:S_<name>`).
FINGERTIPS = ('fftip', 'mftip', 'rftip', 'lftip', 'thtip')


# Commands and actions


def command_limits(robot: RobotSpec) -> tuple[Array, Array]:
    """Return lower and upper limits of the command, (action_size,) each, in command units."""
    return (
        np.array([part.lower for part in robot.command]),
        np.array([part.upper for part in robot.command]),
    )


def command_from_action(robot: RobotSpec, action: ArrayLike) -> NDArray[Any]:
    """Map actions (..., action_size), clipped to [-1, 1], to commands of the same shape.

    -1 and 1 map to the limits of the command. If these are -1 and 1, as for Fetch, the command
    keeps the floating type of the action, because Gymnasium-Robotics scales it in that type.
    """
    clipped = np.asarray(np.clip(np.asarray(action), -1.0, 1.0))
    lower, upper = command_limits(robot)
    if (lower == -1.0).all() and (upper == 1.0).all():
        return clipped
    command = (upper + lower) / 2.0 + clipped * ((upper - lower) / 2.0)
    return np.asarray(np.clip(command, lower, upper))


def action_from_command(robot: RobotSpec, command: ArrayLike) -> Array:
    """Map commands (..., action_size) to actions, clipped to [-1, 1], of the same shape."""
    values = np.asarray(command, dtype=np.float64)
    lower, upper = command_limits(robot)
    return np.clip((values - (upper + lower) / 2.0) / ((upper - lower) / 2.0), -1.0, 1.0)


def resting_command(robot: RobotSpec) -> Array:
    """Return the command of action 0: Fetch stays where it is; hand joints move to mid-range."""
    return np.asarray(command_from_action(robot, np.zeros(robot.action_size)), dtype=np.float64)


def clip_command(robot: RobotSpec, command: ArrayLike) -> Array:
    """Clip commands (..., action_size) to the limits of the robot."""
    lower, upper = command_limits(robot)
    return np.clip(np.asarray(command, dtype=np.float64), lower, upper)
