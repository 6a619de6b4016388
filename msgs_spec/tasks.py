"""The tasks as data, with their goals, observations, lengths and thresholds.

Thirteen tasks come from Plappert et al. 2018. Other packages may add a task by two entry points
with the name of the task. The entry point in group `fetch_hand_sim_tasks.specification` names a
`TaskSpec`, in a module that does not import MuJoCo. The entry point in group
`fetch_hand_sim_tasks.simulation` names the class that simulates the task. Invalid tasks are left
out with a warning; `fetch_hand_sim.simulation.check_task` finds subtle mistakes.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from importlib.metadata import EntryPoint, entry_points
from numbers import Real
from typing import Any, Literal, get_args

# Third-party tasks import it from here.
from msgs_spec.arrays import Array as Array
from msgs_spec.robots import FETCH, FINGERTIPS, JOINT_PREFIX, SHADOW_HAND, RobotSpec
from msgs_spec.text import one_line, one_of

# One physics substep, seconds, and the paper's 20 substeps per action (25 Hz).
PHYSICS_TIMESTEP = 0.002
DEFAULT_CONTROL_HZ = 25.0

# See `fetch_hand_sim.simulation.rewards.GoalMetric`.
RewardType = Literal['sparse', 'dense']
SuccessRule = Literal['gymnasium', 'paper']
# Quantities that other rates than 25 Hz keep: seconds of an episode and speed of the gripper, or
# ticks of an episode and gripper motion per tick (as up to version 1.0).
Timing = Literal['seconds', 'ticks']
REWARD_TYPES: tuple[RewardType, ...] = get_args(RewardType)
SUCCESS_RULES: tuple[SuccessRule, ...] = get_args(SuccessRule)
TIMINGS: tuple[Timing, ...] = get_args(Timing)


class GoalKind(Enum):
    """Kinds of goal vectors.

    POINT: position of the gripper or object, 3 values, metres, world.
    FINGERTIPS: five fingertip positions, 15 values, metres, world.
    POSE: object position and quaternion wxyz, 7 values, metres, world.
    """

    POINT = 3
    FINGERTIPS = 15
    POSE = 7

    @property
    def size(self) -> int:
        """Length of the goal vector."""
        return self.value


@dataclass(frozen=True, slots=True)
class VectorPart:
    """A name for `size` consecutive numbers of an observation, a topic or a command."""

    name: str
    size: int
    unit: str


@dataclass(frozen=True, slots=True)
class TaskFormulas:
    """Formulas for the observation and the achieved goal of a task.

    They accept any leading batch shape and return new arrays. Readings are vectors by topic, in the
    layout of `msgs_spec.topics`.

    Attributes:
        topics: Topics that the formulas read.
        observation: Function of readings and control period, s; returns (..., observation size).
        achieved_goal: Function of readings; returns (..., goal size).
    """

    topics: tuple[str, ...]
    observation: Callable[[Mapping[str, Array], float], Array]
    achieved_goal: Callable[[Mapping[str, Array]], Array]


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """One task as data.

    Attributes:
        observation: Parts of the observation vector, in order.
        episode_ticks: Steps per episode; `TASKS` contains the number at 25 Hz.
        object_name: `object0` (Fetch), `object` (hand), or None for tasks without an object.
        distance_threshold: Success threshold of the distance, m.
        rotation_threshold: Success threshold of the rotation, rad; None for goals without rotation.
        reference_id: Environment of Gymnasium-Robotics 1.4.2 that equals this task, or None.
        achieved_goal: Name of the observation part that is the achieved goal.
        position_counts: Whether the position of a pose goal counts (False for the Rotate tasks).
        ignores_z_rotation: Whether the rotation about the object's own z axis does not count (pen).
        object_symmetry: `cube` if the object looks the same on each face; `revolution` if it does
            when turned about its z axis or upside down; None unless goals are poses.
        formulas: Formulas of a third-party task; None if its observation is that of one of the
            thirteen tasks.
        looks_like: Name of one of the thirteen tasks, whose camera view and goal region this task
            has. A copy by `dataclasses.replace` keeps it. None for the usual view of the robot.
    """

    name: str
    robot: RobotSpec
    goal: GoalKind
    observation: tuple[VectorPart, ...]
    episode_ticks: int
    object_name: str | None
    distance_threshold: float
    rotation_threshold: float | None
    reference_id: str | None
    achieved_goal: str
    position_counts: bool = True
    ignores_z_rotation: bool = False
    object_symmetry: str | None = None
    formulas: TaskFormulas | None = None
    looks_like: str | None = None

    @property
    def achieved_goal_start(self) -> int:
        """Index at which the achieved goal begins in the observation vector."""
        names = [part.name for part in self.observation]
        return sum(part.size for part in self.observation[: names.index(self.achieved_goal)])

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return sum(part.size for part in self.observation)

    @property
    def has_object(self) -> bool:
        """True if the task has an object."""
        return self.object_name is not None

    @property
    def observed_topics(self) -> tuple[str, ...]:
        """Names of the topics that the observation depends on."""
        if self.formulas is not None:
            return self.formulas.topics
        if self.goal is GoalKind.FINGERTIPS:
            return ('joint_states', 'fingertip_poses')
        if self.goal is GoalKind.POSE:
            return ('joint_states', 'object_joint')
        robot = ('joint_states', 'end_effector_pose', 'end_effector_twist')
        return (*robot, 'object_pose', 'object_twist') if self.has_object else robot

    def with_joint_prefix(self, prefix: str) -> TaskSpec:
        """Return a copy of the task whose joint names have the prefix `prefix`."""
        if prefix == JOINT_PREFIX:
            return self
        return replace(self, robot=self.robot.with_joint_prefix(prefix))


_GRIPPER_STATE = VectorPart('gripper_state', 2, 'm, right and left finger')
_GRIPPER_VELOCITY = VectorPart('gripper_velocity', 2, 'm per tick')
_FETCH_REACH_OBSERVATION = (
    VectorPart('end_effector_position', 3, 'm'),
    _GRIPPER_STATE,
    VectorPart('end_effector_velocity', 3, 'm per tick'),
    _GRIPPER_VELOCITY,
)
_FETCH_OBJECT_OBSERVATION = (
    VectorPart('end_effector_position', 3, 'm'),
    VectorPart('object_position', 3, 'm'),
    VectorPart('object_relative_position', 3, 'm'),
    _GRIPPER_STATE,
    VectorPart('object_rotation', 3, 'rad, Euler xyz'),
    VectorPart('object_relative_velocity', 3, 'm per tick'),
    VectorPart('object_angular_velocity', 3, 'rad per tick'),
    VectorPart('end_effector_velocity', 3, 'm per tick'),
    _GRIPPER_VELOCITY,
)
_HAND_JOINT_PARTS = (
    VectorPart('joint_position', len(SHADOW_HAND.joints), 'rad'),
    VectorPart('joint_velocity', len(SHADOW_HAND.joints), 'rad/s'),
)
_HAND_REACH_OBSERVATION = (
    *_HAND_JOINT_PARTS,
    VectorPart('fingertip_positions', 3 * len(FINGERTIPS), 'm'),
)
_HAND_OBJECT_OBSERVATION = (
    *_HAND_JOINT_PARTS,
    VectorPart('object_velocity', 6, 'm/s in the world, rad/s in the object frame'),
    VectorPart('object_pose', 7, 'm, quaternion wxyz'),
)


def _fetch(name: str, has_object: bool = True) -> TaskSpec:
    return TaskSpec(
        name=name,
        robot=FETCH,
        goal=GoalKind.POINT,
        observation=_FETCH_OBJECT_OBSERVATION if has_object else _FETCH_REACH_OBSERVATION,
        episode_ticks=50,
        object_name='object0' if has_object else None,
        distance_threshold=0.05,
        rotation_threshold=None,
        reference_id=f'{name}-v4',
        achieved_goal='object_position' if has_object else 'end_effector_position',
        looks_like=name,
    )


def _hand_manipulate(
    name: str,
    distance_threshold: float = 0.01,
    position_counts: bool = False,
    ignores_z_rotation: bool = False,
) -> TaskSpec:
    return TaskSpec(
        name=name,
        robot=SHADOW_HAND,
        goal=GoalKind.POSE,
        observation=_HAND_OBJECT_OBSERVATION,
        episode_ticks=100,
        object_name='object',
        distance_threshold=distance_threshold,
        rotation_threshold=0.1,
        reference_id=f'{name}-v1',
        achieved_goal='object_pose',
        looks_like=name,
        position_counts=position_counts,
        ignores_z_rotation=ignores_z_rotation,
        object_symmetry='cube' if 'Block' in name else 'revolution',
    )


_HAND_REACH = TaskSpec(
    name='HandReach',
    robot=SHADOW_HAND,
    goal=GoalKind.FINGERTIPS,
    observation=_HAND_REACH_OBSERVATION,
    episode_ticks=50,
    object_name=None,
    distance_threshold=0.01,
    rotation_threshold=None,
    reference_id='HandReach-v3',
    achieved_goal='fingertip_positions',
    looks_like='HandReach',
)

TASKS: dict[str, TaskSpec] = {
    spec.name: spec
    for spec in (
        _fetch('FetchReach', has_object=False),
        _fetch('FetchPush'),
        _fetch('FetchSlide'),
        _fetch('FetchPickAndPlace'),
        _HAND_REACH,
        _hand_manipulate('HandManipulateBlockRotateZ'),
        _hand_manipulate('HandManipulateBlockRotateParallel'),
        _hand_manipulate('HandManipulateBlockRotateXYZ'),
        _hand_manipulate('HandManipulateBlockFull', position_counts=True),
        _hand_manipulate('HandManipulateEggRotate'),
        _hand_manipulate('HandManipulateEggFull', position_counts=True),
        _hand_manipulate('HandManipulatePenRotate', 0.05, ignores_z_rotation=True),
        _hand_manipulate('HandManipulatePenFull', 0.05, True, ignores_z_rotation=True),
    )
}


def task_spec(
    name: str, joint_prefix: str = JOINT_PREFIX, control_hz: float = DEFAULT_CONTROL_HZ
) -> TaskSpec:
    """Return a task by name; raise ValueError, which lists all tasks, if it is unknown.

    Args:
        joint_prefix: Prefix of the joint names in ROS messages.
        control_hz: Action frequency, Hz. Episodes have the same duration at all frequencies; the
            number of steps is rounded.
    """
    task = TASKS[one_of(name, list(TASKS), 'unknown task')]
    if control_hz != DEFAULT_CONTROL_HZ:
        substeps = task.episode_ticks * substeps_per_tick(DEFAULT_CONTROL_HZ)
        ticks = round(substeps / substeps_per_tick(control_hz))
        task = replace(task, episode_ticks=max(1, ticks))
    return task.with_joint_prefix(joint_prefix)


def substeps_per_tick(control_hz: float) -> int:
    """Return the number of physics substeps in one control period.

    `control_hz` is 12.5 ... 500 Hz. If the period is not a whole number of substeps, a ValueError
    names the nearest valid rates.
    """
    if not isinstance(control_hz, Real):
        raise ValueError(f'control_hz {control_hz!r:.60} given; allowed: 12.5 ... 500')
    try:
        control_hz = float(control_hz)
    except OverflowError:
        control_hz = math.inf
    fewest, most = 1, 40
    period = 1.0 / PHYSICS_TIMESTEP / control_hz if control_hz > 0 else math.inf
    clipped = min(max(period, fewest), most)
    substeps = round(clipped)
    if abs(period - substeps) < 1e-6:
        return substeps
    neighbours = (math.floor(clipped), math.ceil(clipped))
    rates = sorted({1.0 / (n * PHYSICS_TIMESTEP) for n in neighbours})
    nearest = ' and '.join(f'{rate:.9g}' for rate in rates)
    raise ValueError(
        f'control_hz {control_hz:g} is not a whole number of {PHYSICS_TIMESTEP * 1e3:g} ms '
        f'substeps; allowed: 500/n Hz for n = {fewest} ... {most} (12.5 ... 500), nearest: '
        f'{nearest}'
    )


# Tasks of other packages

SPECS = 'fetch_hand_sim_tasks.specification'
SIMULATIONS = 'fetch_hand_sim_tasks.simulation'

_LOGGER = logging.getLogger(__name__)
# Names become Gymnasium ids and file names.
_NAME = re.compile(r'\w[\w.-]{0,63}')
# Package of each accepted task.
_PACKAGES: dict[str, str] = {}


def third_party_tasks() -> dict[str, TaskSpec]:
    """Return the tasks that entry points of installed packages add, by name.

    A task that fails to load or is invalid is left out with a warning.
    """
    tasks: dict[str, TaskSpec] = {}
    for entry_point in entry_points(group=SPECS):
        name = entry_point.name
        try:
            if name in tasks or name in TASKS:
                raise ValueError('another task has this name')
            tasks[name] = _accept(name, entry_point.load())
            _PACKAGES[name] = _package(entry_point)
        except (Exception, SystemExit) as error:  # third-party code
            _LOGGER.warning('task %s is left out: %s', name, _failure(entry_point, error))
    return tasks


def _accept(name: str, spec: Any) -> TaskSpec:
    """Return `spec` without `reference_id`; raise an error if it is no valid task called `name`."""
    if not isinstance(spec, TaskSpec):
        raise ValueError(f'{type(spec).__name__} given; allowed: a TaskSpec')
    if spec.name != name:
        raise ValueError(f'its TaskSpec has the name {spec.name!r}; allowed: {name!r}')
    if not _NAME.fullmatch(name):
        raise ValueError(f'name {name!r:.80}; allowed: up to 64 letters, digits, _, - and .')
    # Specifications are keys of caches.
    hash(spec)
    # A copy of a reference task (`dataclasses.replace`) would else take over its environment id.
    return replace(spec, reference_id=None)


def third_party_simulation(name: str) -> Any:
    """Return the class that simulates a third-party task; ValueError if missing or broken."""
    found = list(entry_points(group=SIMULATIONS, name=name))
    if not found:
        raise ValueError(
            f'task {name} has no simulation: no installed package has an entry point of this name '
            f'in {SIMULATIONS!r}'
        )
    # Several packages may use the name: prefer the package of the specification.
    own = [each for each in found if _package(each) == _PACKAGES.get(name)]
    entry_point = (own or found)[0]
    try:
        return entry_point.load()
    except (Exception, SystemExit) as error:
        raise ValueError(f'task {name}: {_failure(entry_point, error)}') from error


def _package(entry_point: EntryPoint) -> str:
    return entry_point.dist.name if entry_point.dist is not None else 'a package'


def _failure(entry_point: EntryPoint, error: BaseException) -> str:
    return f'{_package(entry_point)}: {entry_point.value}: {one_line(error, longest=1000)}'


# Third-party packages import this module, so this line comes last.
TASKS.update(third_party_tasks())
