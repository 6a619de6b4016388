"""What a task is made of, as data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum

from msgs_spec.arrays import Array
from msgs_spec.robots import JOINT_PREFIX, RobotSpec


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
