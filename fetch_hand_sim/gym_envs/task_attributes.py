"""Rewards and thresholds of a task, for one environment and for a batch."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.arguments import finite_goals, nearest_quaternions, numbers
from msgs_spec.arrays import Array
from msgs_spec.tasks import GoalKind, RewardType, TaskSpec
from msgs_spec.text import one_line

# Metres or radians.
_LARGEST_THRESHOLD = 1e6


class TaskAttributes:
    """Rewards for any goals, and settings that may be changed between steps."""

    spec_of_task: TaskSpec
    simulation: Simulation
    _spec: EnvSpec | None = None

    def __copy__(self) -> Self:
        """As `copy.deepcopy`: two environments have no physics or generators in common."""
        return copy.deepcopy(self)

    @property
    def spec(self) -> EnvSpec | None:
        """The spec from which Gymnasium made the environment; None without one."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            _check_task(spec)
        self._spec = spec

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Any:
        """Reward of goals of any batch shape (..., goal size).

        A subclass may have another; its steps are rewarded by it.
        """
        return self.simulation.compute_reward(achieved_goal, desired_goal, info)

    def overrides(self, name: str) -> bool:
        """True if a subclass or the user has replaced the method `name`.

        Steps and resets then call it, as those of Gymnasium-Robotics do.
        """
        module = getattr(getattr(type(self), name), '__module__', '')
        return name in self.__dict__ or not module.startswith('fetch_hand_sim.')

    def compute_terminated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """Never: a reached goal is to be kept; a subclass may end episodes there."""
        return False

    def compute_truncated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """True if the simulation diverged at the step that returned `info`.

        Returns:
            A boolean; an array (N,) for N infos, or for those of a batch of N.
        """
        if info is None or isinstance(info, Mapping):
            lost = np.asarray((info or {}).get('diverged', False), dtype=bool)
            return lost if lost.ndim else bool(lost)
        each = [self.compute_truncated(achieved_goal, desired_goal, one) for one in info]
        return np.array(each, dtype=bool)

    @property
    def dt(self) -> float:
        """Simulated seconds per step."""
        return self.simulation.tick_duration

    @property
    def reward_type(self) -> str:
        """`sparse` or `dense`."""
        return self.simulation.metric.reward_type

    @reward_type.setter
    def reward_type(self, reward_type: RewardType) -> None:
        self.simulation.metric = self.simulation.metric.with_changes(reward_type=reward_type)

    @property
    def distance_threshold(self) -> float:
        """Success within this distance, metres."""
        return self.simulation.metric.spec.distance_threshold

    @distance_threshold.setter
    def distance_threshold(self, threshold: float) -> None:
        self._set_threshold('distance_threshold', threshold)

    @property
    def rotation_threshold(self) -> float | None:
        """Success within this rotation, radians; None where rotations do not count."""
        return self.simulation.metric.spec.rotation_threshold

    @rotation_threshold.setter
    def rotation_threshold(self, threshold: float) -> None:
        if self.rotation_threshold is None:
            raise ValueError(f'{self.spec_of_task.name} has no rotation_threshold')
        self._set_threshold('rotation_threshold', threshold)

    def set_thresholds(self, distance: float | None, rotation: float | None) -> None:
        """Set the thresholds that are not None, m and rad, or raise ValueError."""
        if distance is not None:
            self.distance_threshold = distance
        if rotation is not None:
            self.rotation_threshold = rotation

    def _set_threshold(self, name: str, value: float) -> None:
        if not (isinstance(value, Real) and 0.0 <= value < _LARGEST_THRESHOLD):
            raise ValueError(
                f'{name} must be 0 ... {_LARGEST_THRESHOLD:g}, not {one_line(value, 40)}'
            )
        metric = self.simulation.metric
        changed: dict[str, Any] = {name: float(value)}
        self.simulation.metric = metric.with_changes(spec=replace(metric.spec, **changed))


def _check_task(spec: EnvSpec) -> None:
    """Raise ValueError if the argument `task` is not the task of the id."""
    registered = gymnasium.registry.get(spec.id)
    task = spec.kwargs.get('task')
    if registered is not None and registered.kwargs.get('task', task) != task:
        raise ValueError(
            f'{spec.id} is {registered.kwargs["task"]}, not {task}, which has an id of its own'
        )


def check_reset_options(options: Any, allowed: tuple[str, ...]) -> None:
    """Raise TypeError or ValueError for invalid options of `reset`."""
    if options is None:
        return
    if not isinstance(options, dict):
        raise TypeError(f'options of reset are a dictionary or None, not {options!r}')
    for name in options:
        if name not in allowed:
            known = ', '.join(allowed) or 'none'
            raise ValueError(f'reset option {name!r} is not known; allowed: {known}')


def given_by_options(options: Any, mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return `variation` and `start` in options of `reset`, for `Simulation.reset`.

    Each is one for all or a list of N; `mask` (N,) marks the environments that start.
    """
    given = {}
    for name in ('variation', 'start'):
        value = (options or {}).get(name)
        if isinstance(value, list | tuple):
            if len(value) != mask.size:
                raise ValueError(f'{name}: {len(value)} values; allowed: one, or {mask.size}')
            value = [each for each, starts in zip(value, mask, strict=True) if starts]
        given[name] = value
    return given


def goals_of_options(options: Any, mask: NDArray[np.bool_], spec: TaskSpec) -> Array | None:
    """The goals that options of `reset` ask for; checked before anything has moved.

    Args:
        options: A dictionary with `goal`, (goal size,) for all or (N, goal size), or without.
        mask: (N,) which environments start.

    Returns:
        (n, goal size), of the n that start, unit quaternions; None where goals are drawn.
    """
    if not options or 'goal' not in options:
        return None
    one = (spec.goal.size,)
    shape = (mask.size, *one)
    given = numbers(options['goal'], f'a goal of {spec.name}', f'{one} or {shape}')
    if given.shape not in (one, shape):
        raise ValueError(f'a goal of {spec.name} has shape {one} or {shape}, not {given.shape}')
    goals = finite_goals(np.broadcast_to(given, shape)[mask], int(mask.sum()), spec)
    return nearest_quaternions(goals, goals) if spec.goal is GoalKind.POSE else goals


def observation_space(spec: TaskSpec) -> spaces.Space[Any]:
    """`observation`, `achieved_goal` and `desired_goal`, float64, unbounded, SI units."""
    return spaces.Dict(
        {
            'observation': _unbounded(spec.observation_size),
            'achieved_goal': _unbounded(spec.goal.size),
            'desired_goal': _unbounded(spec.goal.size),
        }
    )


def action_space(spec: TaskSpec) -> spaces.Space[Any]:
    """The normalised action in [-1, 1], float32."""
    return spaces.Box(-1.0, 1.0, shape=(spec.robot.action_size,), dtype=np.float32)


def clip_actions(actions: NDArray[Any]) -> NDArray[Any]:
    """Actions in [-1, 1], as Gymnasium-Robotics takes them; what is no number stays, refused later.

    The type stays too: the Fetch tasks scale actions in it.
    """
    return np.clip(actions, -1.0, 1.0) if actions.dtype.kind in 'fiu' else actions


def _unbounded(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape=(size,), dtype=np.float64)
