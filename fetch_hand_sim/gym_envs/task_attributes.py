"""Common parts of the single and the vector environment: arguments, spaces and settings."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from inspect import signature
from itertools import compress
from numbers import Real
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.pictures import Pictures
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.arguments import each_of
from fetch_hand_sim.simulation.rendering import HEIGHT, WIDTH
from msgs_spec.disturbances import Disturbances
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, RewardType, SuccessRule, TaskSpec
from msgs_spec.text import entries, one_line, one_of

# Metres or radians.
_LARGEST_THRESHOLD = 1e6
RESET_OPTIONS = ('goal', 'variation', 'start')


class TaskAttributes:
    """Base of the environments: rewards for any goals, and settings that users may change.

    Args:
        task: One of the tasks (`msgs_spec.tasks.TASKS`).
        reward_type: `sparse` (-1 or 0) or `dense` (minus the distance).
        success_rule: `gymnasium` (as in the released code) or `paper` (as in the text of Plappert
            et al. 2018).
        control_hz: Actions per simulated second: 500/n for n = 1 ... 40. For rates other than 25 Hz
            use `fetch_hand_sim.make`, which keeps the duration of episodes.
        render_mode: One of `metadata['render_modes']` or None.
        width: Pixels of a picture.
        height: Pixels of a picture.
        default_camera_config: Attributes of `mujoco.MjvCamera`, such as `distance` (m),
            `azimuth`, `elevation` (degrees) and `lookat` (m); None for the task's view.
        distance_threshold: Success threshold of the distance, m; None for the task's own.
        rotation_threshold: Success threshold of the rotation, rad; None for the task's own.
        disturbances: Delays, noise and changed physics: a preset (`hardware`, `hardware*0.5`), a
            mapping, a JSON or YAML file or `Disturbances`; None for an undisturbed robot.
        **batch: Further arguments of `Simulation`, for subclasses.

    Raises:
        ValueError: If an argument is not allowed.
    """

    metadata: dict[str, Any]
    # Size of the batch, as arguments of `Simulation`.
    _batch: Mapping[str, Any] = {}
    _spec: EnvSpec | None = None
    # Methods of other environments that nothing calls here, and a hint.
    _uncalled: tuple[str, ...] = ()
    _hint = ''

    def __init__(
        self,
        task: str,
        reward_type: RewardType = 'sparse',
        success_rule: SuccessRule = 'gymnasium',
        control_hz: float = DEFAULT_CONTROL_HZ,
        render_mode: str | None = None,
        width: int = WIDTH,
        height: int = HEIGHT,
        default_camera_config: Mapping[str, Any] | None = None,
        distance_threshold: float | None = None,
        rotation_threshold: float | None = None,
        disturbances: Disturbances | Mapping[str, Any] | str | None = None,
        **batch: Any,
    ) -> None:
        for name in self._uncalled:
            if hasattr(self, name):
                raise TypeError(f'{name} would have no effect here; {self._hint}')
        if render_mode is not None:
            one_of(render_mode, self.metadata['render_modes'], 'render_mode')
        if 'num_envs' in self._batch.keys() & batch.keys():
            raise TypeError('num_envs is for fetch_hand_sim.make_vec; make returns one environment')
        allowed = {**signature(TaskAttributes).parameters, **signature(Simulation).parameters}
        del allowed['batch']
        for name in batch:
            one_of(name, list(allowed), 'no argument')
        self.simulation = Simulation(
            task,
            reward_type=reward_type,
            success_rule=success_rule,
            control_hz=control_hz,
            disturbances=disturbances,
            **{**self._batch, **batch},
        )
        self.spec_of_task = self.simulation.spec
        # Pictures per second of a film that shows every step.
        fps = int(control_hz) if control_hz == int(control_hz) else control_hz
        self.metadata = {**self.metadata, 'render_fps': fps}
        self.observation_space: spaces.Space[Any] = observation_space(self.spec_of_task)
        self.action_space: spaces.Space[Any] = action_space(self.spec_of_task)
        self.render_mode = render_mode
        self.width, self.height = width, height
        self._pictures = Pictures(self.simulation, width, height, default_camera_config)
        if distance_threshold is not None:
            self.distance_threshold = distance_threshold
        if rotation_threshold is not None:
            self.rotation_threshold = rotation_threshold

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; TypeError if it replaces a method that this class never calls."""
        if name in self._uncalled:
            raise TypeError(f'{name} would have no effect here; {self._hint}')
        super().__setattr__(name, value)

    def __copy__(self) -> Self:
        """Return a deep copy, so that copies share neither physics nor random generators."""
        return copy.deepcopy(self)

    @property
    def spec(self) -> EnvSpec | None:
        """The spec from which Gymnasium made the environment; None without one."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and (registered := gymnasium.registry.get(spec.id)) is not None:
            task = spec.kwargs.get('task')
            if registered.kwargs.get('task', task) != task:
                raise ValueError(
                    f'{spec.id} is {registered.kwargs["task"]}, not {task}, which has an id of its '
                    'own'
                )
        self._spec = spec

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Any:
        """Return rewards (...) of goals (..., goal size) with any leading axes.

        If a subclass overrides this method, `step` returns its rewards.
        """
        return self.simulation.compute_reward(achieved_goal, desired_goal, info)

    def overrides(self, name: str) -> bool:
        """Return whether a subclass or the user has replaced the method `name`."""
        module = getattr(getattr(type(self), name), '__module__', '')
        return name in self.__dict__ or not module.startswith('fetch_hand_sim.')

    def compute_terminated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """Return False, because tasks have no terminal state; a subclass may override this."""
        return False

    def compute_truncated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """Return True if the simulation diverged at the step that returned `info`.

        Returns:
            A boolean; an array (N,) for N infos, or for the info of a vector environment.
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
        """Success threshold of the distance to the goal, m."""
        return self.simulation.metric.spec.distance_threshold

    @distance_threshold.setter
    def distance_threshold(self, threshold: float) -> None:
        self._set_threshold('distance_threshold', threshold)

    @property
    def rotation_threshold(self) -> float | None:
        """Success threshold of the rotation to the goal, rad; None if rotations do not count."""
        return self.simulation.metric.spec.rotation_threshold

    @rotation_threshold.setter
    def rotation_threshold(self, threshold: float) -> None:
        if self.rotation_threshold is None:
            raise ValueError(f'{self.spec_of_task.name} has no rotation_threshold')
        self._set_threshold('rotation_threshold', threshold)

    def _set_threshold(self, name: str, value: float) -> None:
        if not (isinstance(value, Real) and 0.0 <= value < _LARGEST_THRESHOLD):
            shown = one_line(repr(value), 40)
            raise ValueError(f'{name} {shown}; allowed: 0 ... {_LARGEST_THRESHOLD:g}')
        metric = self.simulation.metric
        changed: dict[str, Any] = {name: float(value)}
        self.simulation.metric = metric.with_changes(spec=replace(metric.spec, **changed))

    def _read_options(
        self, options: Any, mask: NDArray[np.bool_], *others: str
    ) -> dict[str, list[Any]]:
        """Return `goal`, `variation` and `start` for `Simulation.reset`, or raise ValueError.

        Args:
            options: A dictionary or None. An option is one value for all environments or N values.
            mask: (N,) True for the environments that start. Each returned list has one entry for
                each of these.
            others: Names of further allowed options, which the caller reads.
        """
        given = entries('options', {} if options is None else options, (*RESET_OPTIONS, *others))
        return {
            name: list(compress(each_of(name, given.get(name), mask.size), mask))
            for name in RESET_OPTIONS
        }


def observation_space(spec: TaskSpec) -> spaces.Space[Any]:
    """Return the dictionary space of observation, achieved and desired goal, float64, unbounded."""
    sizes = {'observation': spec.observation_size}
    sizes |= dict.fromkeys(('achieved_goal', 'desired_goal'), spec.goal.size)
    return spaces.Dict(
        {name: spaces.Box(-np.inf, np.inf, (size,), np.float64) for name, size in sizes.items()}
    )


def action_space(spec: TaskSpec) -> spaces.Space[Any]:
    """Return the space of normalised actions in [-1, 1], float32."""
    return spaces.Box(-1.0, 1.0, shape=(spec.robot.action_size,), dtype=np.float32)


def clip_actions(actions: NDArray[Any]) -> NDArray[Any]:
    """Clip actions to [-1, 1] as Gymnasium-Robotics does; NaN stays and is rejected later.

    The dtype stays, because the Fetch tasks scale actions in the precision of the given dtype.
    """
    return np.clip(actions, -1.0, 1.0) if actions.dtype.kind in 'fiu' else actions
