"""The tasks as data: goals, observations, lengths, thresholds.

Thirteen are those of Plappert et al. 2018; other packages add theirs (`foreign_tasks.py`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from numbers import Integral, Real
from typing import Any, Literal, get_args

from msgs_spec.arrays import Array
from msgs_spec.foreign_tasks import foreign_tasks
from msgs_spec.hints import did_you_mean
from msgs_spec.robots import (
    FETCH,
    FINGERTIPS,
    JOINT_PREFIX,
    SHADOW_HAND,
    CommandPart,
    RobotSpec,
)

# One physics substep, seconds, and the paper's 20 substeps per action (25 Hz).
PHYSICS_TIMESTEP = 0.002
DEFAULT_CONTROL_HZ = 25.0

# What `GoalMetric` of the simulation says of them.
RewardType = Literal['sparse', 'dense']
SuccessRule = Literal['gymnasium', 'paper']
# What an action frequency other than 25 Hz leaves as it is: the seconds of an episode and the speed
# of a gripper, or the ticks of an episode and the step of a gripper, as robots had it up to 1.0.
Timing = Literal['seconds', 'ticks']
REWARD_TYPES: tuple[RewardType, ...] = get_args(RewardType)
SUCCESS_RULES: tuple[SuccessRule, ...] = get_args(SuccessRule)
TIMINGS: tuple[Timing, ...] = get_args(Timing)


class GoalKind(Enum):
    """What a goal vector means.

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
    """A named run of numbers in the vector of an observation, a topic or a command.

    Attributes:
        name: What the numbers are.
        size: How many.
        unit: Their unit, in the order given.
    """

    name: str
    size: int
    unit: str


@dataclass(frozen=True, slots=True)
class TaskFormulas:
    """How observation and achieved goal of a task follow from what its sensors say.

    All take any leading batch shape and give fresh arrays. Readings are vectors by name of their
    topic, as `topics` lays them out.

    Attributes:
        topics: Names of the topics they read.
        observation: Readings and seconds of one control period -> (..., observation size).
        achieved_goal: Readings -> (..., goal size).
    """

    topics: tuple[str, ...]
    observation: Callable[[Mapping[str, Array], float], Array]
    achieved_goal: Callable[[Mapping[str, Array]], Array]


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """One task as policies and tools see it.

    Attributes:
        name: `FetchReach`, ... as in the paper.
        robot: The robot that does it.
        goal: What its goals are.
        observation: Parts of the observation vector, in order.
        episode_ticks: Steps per episode; those of `TASKS` at 25 Hz.
        object_name: `object0` (Fetch), `object` (hand), or None where there is none.
        distance_threshold: Success within this distance, metres.
        rotation_threshold: Success within this rotation, radians; None where there is no rotation.
        reference_id: The environment of Gymnasium-Robotics 1.4.2 that this task equals, or None.
        achieved_goal: Name of the part of the observation that is the achieved goal.
        position_counts: Whether the position of a pose goal counts (False for the Rotate tasks).
        ignores_z_rotation: Whether the rotation about the object's own z axis does not count (pen).
        object_symmetry: `cube`, or `revolution` for an object that is the same turned about its z
            axis or upside down; None where the goal is no pose.
        formulas: None for the thirteen and for a task that is observed as one of them.
        looks_like: Which of the thirteen it is to the eye: the view, where goals lie and how they
            turn. A task that is made from one of them with `dataclasses.replace` keeps it; None for
            what is usual with the robot.
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
        """Whether there is an object beside the robot."""
        return self.object_name is not None

    def with_joint_prefix(self, prefix: str) -> TaskSpec:
        """Returns the task of a robot whose joints' names begin with another prefix."""
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
    """Returns the task called `name`.

    Args:
        name: One of `TASKS`.
        joint_prefix: What the names of its joints begin with on the network.
        control_hz: Action frequency, Hz. At another than 25 Hz an episode has as many steps as fill
            the same time, rounded.

    Raises:
        ValueError: If there is none, the message lists all of them; or the rate is not allowed.
    """
    try:
        task = TASKS[name]
    except (KeyError, TypeError):
        hint = did_you_mean(str(name), TASKS.keys())
        raise ValueError(f'unknown task {name!r}; allowed: {", ".join(TASKS)}{hint}') from None
    if control_hz != DEFAULT_CONTROL_HZ:
        substeps = task.episode_ticks * substeps_per_tick(DEFAULT_CONTROL_HZ)
        ticks = round(substeps / substeps_per_tick(control_hz))
        task = replace(task, episode_ticks=max(1, ticks))
    return task.with_joint_prefix(joint_prefix)


def substeps_per_tick(control_hz: float) -> int:
    """Returns the whole number of physics substeps in one control period.

    Args:
        control_hz: Action frequency in Hz, between 12.5 and 500.

    Raises:
        ValueError: If the period is not a whole number of substeps; the message names the nearest
            valid rates.
    """
    if not isinstance(control_hz, Real):
        raise ValueError(f'control_hz {control_hz!r} is no number; allowed: 12.5 ... 500')
    smallest, largest = 1, 40
    period = 1.0 / (control_hz * PHYSICS_TIMESTEP) if control_hz > 0 else float('inf')
    substeps = round(period) if period < 1e9 else 10**9
    if smallest <= substeps <= largest and abs(period - substeps) < 1e-6:
        return substeps
    lower = min(max(int(period) if period < 1e9 else largest, smallest), largest)
    # Above 500 Hz there is none on the other side.
    upper = min(lower + 1, largest) if period > smallest else lower
    rates = sorted({1.0 / (n * PHYSICS_TIMESTEP) for n in (lower, upper)})
    nearest = ' and '.join(f'{rate:.9g}' for rate in rates)
    raise ValueError(
        f'control_hz {control_hz:g} is not a whole number of {PHYSICS_TIMESTEP * 1e3:g} ms '
        f'substeps; allowed: 500/n Hz for n = {smallest} ... {largest} (12.5 ... 500), nearest: '
        f'{nearest}'
    )


# What Gymnasium takes in an id and every system in a file name.
_NAME = re.compile(r'\w[\w.-]*')
_LONGEST_NAME = 64


def _accept(name: str, spec: Any) -> TaskSpec:
    """Returns what another package calls a task, if it is one."""
    if not isinstance(spec, TaskSpec):
        raise ValueError(f'no TaskSpec but {type(spec).__name__}')
    if spec.name != name:
        raise ValueError(f'the task calls itself {spec.name!r}')
    if name in TASKS:
        raise ValueError('one of the thirteen has this name')
    if not _NAME.fullmatch(name) or len(name) > _LONGEST_NAME:
        raise ValueError(
            f'a name has letters, digits, _, - and . only, {_LONGEST_NAME} at most, not {name!r}'
        )
    _require_sound(spec)
    if spec.formulas is None and not any(_is_observed_as(spec, known) for known in TASKS.values()):
        raise ValueError('it has no formulas')
    achieved = [part.size for part in spec.observation if part.name == spec.achieved_goal]
    if achieved != [spec.goal.size]:
        raise ValueError(
            f'achieved_goal {spec.achieved_goal!r} must be the name of one part of the observation '
            f'with {spec.goal.size} values'
        )
    # Kept by `replace`, it would take the place of the environment of that id.
    return replace(spec, reference_id=None)


def _require_sound(spec: TaskSpec) -> None:
    """Refuses what would fail where nobody thinks of this task any more."""
    if not isinstance(spec.robot, RobotSpec):
        raise ValueError(f'robot is no RobotSpec but {type(spec.robot).__name__}')
    if not isinstance(spec.goal, GoalKind):
        raise ValueError(f'goal is no GoalKind but {type(spec.goal).__name__}')
    try:
        hash(spec)
    except TypeError as error:
        raise ValueError(f'{error}: its fields take tuples, not lists or arrays') from None
    _require_parts('observation', spec.observation)
    _require_robot(spec.robot)
    positive = {
        'distance_threshold': spec.distance_threshold,
        'rotation_threshold': 1.0 if spec.rotation_threshold is None else spec.rotation_threshold,
        'episode_ticks': spec.episode_ticks,
    }
    for name, value in positive.items():
        kind = 'whole number' if name == 'episode_ticks' else 'number'
        if not isinstance(value, Integral if kind == 'whole number' else Real):
            raise ValueError(f'{name} {value!r}; allowed: a {kind} of more than 0')
        if not 0.0 < value < float('inf'):
            raise ValueError(f'{name} {value}; allowed: more than 0')
    choices = {'object_symmetry': (None, 'cube', 'revolution'), 'looks_like': (None, *TASKS)}
    for name, allowed in choices.items():
        if (given := getattr(spec, name)) not in allowed:
            hint = did_you_mean(str(given), filter(None, allowed))
            raise ValueError(f'{name} {given!r}; allowed: {", ".join(map(str, allowed))}{hint}')
    if not isinstance(spec.formulas, TaskFormulas | None):
        raise ValueError(f'formulas is no TaskFormulas but {type(spec.formulas).__name__}')


def _require_parts(name: str, parts: Any) -> None:
    """Refuses what is not a tuple of `VectorPart` with whole sizes."""
    for part in parts:
        if not isinstance(part, VectorPart):
            raise ValueError(f'{name} has {part!r:.60}, which is no VectorPart')
        if not isinstance(part.size, Integral) or part.size < 1:
            raise ValueError(f'{name} {part.name} has size {part.size!r}; allowed: 1 or more')


def _require_robot(robot: RobotSpec) -> None:
    """Refuses a robot without joints, or whose units or limits are none."""
    units = robot.joint_units
    if not robot.joints or len(units) != len(robot.joints) or not {'m', 'rad'}.issuperset(units):
        raise ValueError(
            f'{robot.name} has {len(robot.joints)} joints with units {units!r:.60}; allowed: one '
            "joint or more, and 'm' or 'rad' for each"
        )
    for part in robot.command:
        if not isinstance(part, CommandPart):
            raise ValueError(f'command has {part!r:.60}, which is no CommandPart')
        limits = part.lower, part.upper
        if not all(isinstance(limit, Real) for limit in limits):
            raise ValueError(f'command {part.name} has limits {limits}; allowed: two numbers')
        if not -float('inf') < part.lower < part.upper < float('inf'):
            raise ValueError(
                f'command {part.name} has limits {part.lower:g} ... {part.upper:g}; allowed: '
                'finite, the lower below the upper'
            )


def _is_observed_as(spec: TaskSpec, known: TaskSpec) -> bool:
    """Whether the formulas of one of the thirteen make what a task says it observes."""
    names = ('robot', 'goal', 'observation', 'object_name', 'achieved_goal')
    return all(getattr(spec, name) == getattr(known, name) for name in names)


# Their packages import this module: all that they need of it is above.
TASKS.update(foreign_tasks(_accept))
