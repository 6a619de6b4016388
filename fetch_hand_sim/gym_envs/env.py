"""The single environment: a `gymnasium.Env` that steps a `Simulation` with one copy."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.pictures import RENDER_MODES, Image
from fetch_hand_sim.gym_envs.task_attributes import TaskAttributes, clip_actions
from fetch_hand_sim.simulation import Observation, Simulation
from fetch_hand_sim.simulation.arguments import finite_numbers
from fetch_hand_sim.simulation.models import compiled_bytes
from msgs_spec.arrays import Array
from msgs_spec.tasks import DEFAULT_CONTROL_HZ


class FetchHandEnv(TaskAttributes, gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task with dictionary observations, for hindsight experience replay.

    Episodes never terminate; `gymnasium.make` truncates them after the task's number of steps.
    The arguments are those of `TaskAttributes`, also for `gymnasium.make`. Copies by `pickle` or
    `copy` have their own physics and continue from the same state, bit for bit.

    A subclass may override these methods of Gymnasium-Robotics, or a user may set them on the
    object: `_sample_goal()`, `_get_obs()`, `_is_success(achieved_goal, desired_goal)`, and
    `compute_terminated`, `compute_truncated` and `compute_reward` (achieved_goal, desired_goal,
    info). `reset` and `step` then call them in the order of Gymnasium-Robotics.

    Raises:
        ValueError: If an argument is not allowed.
    """

    metadata = {  # noqa: RUF012 - as in gymnasium.Env
        'render_modes': RENDER_MODES,
        'render_fps': int(DEFAULT_CONTROL_HZ),
    }

    _batch = {'num_envs': 1, 'num_threads': 1, 'keeps_data': True}  # noqa: RUF012

    @cached_property
    def _physics(self) -> SharedPhysics:
        return SharedPhysics(self.simulation)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the random generator; None continues it.
            options: `goal`, (goal size,): the desired goal, instead of a drawn one. As in
                `Simulation.set_goal`, quaternions are normalised and moved to the hemisphere
                nearest to the object's. All other draws follow from the seed.
                `variation`, a dictionary: physics values of this episode in place of drawn ones,
                such as `{'friction': 0.7}`. It needs `disturbances`; `Simulation.variation`
                returns all names.
                `start`, a dictionary: `joints`, `joint_velocities`, `object_pose` and
                `object_velocity`, each optional, as `Simulation.reset` takes them.

        Returns:
            The observation, and an empty dictionary.

        Raises:
            ValueError: If an option is unknown or invalid; the environment stays as it was.
            gymnasium.error.Error: If the seed is no integer or negative.
        """
        given = self._read_options(options, np.ones(1, dtype=bool))
        random, used = (
            (self.np_random, self.np_random_seed) if seed is None else seeding.np_random(seed)
        )
        self._physics.send()
        self.simulation.goals = self.simulation.goals.copy()
        draws_goals = self._draws_goals()
        observation = _first(self.simulation.reset(seed=[random], **given))
        # As `gymnasium.Env.reset` does, but not before the simulation has accepted the options.
        self._np_random, self._np_random_seed = random, used
        self._physics.receive()
        if not draws_goals and given['goal'][0] is None:
            self.goal = self._sample_goal()
        if not draws_goals or self.overrides('_get_obs'):
            observation = self._get_obs()
        self._show()
        return observation, {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one step.

        Args:
            action: (action size,), clipped to [-1, 1]; infinite values, too.

        Returns:
            Observation, reward, terminated (always False), truncated (True if MuJoCo diverged; the
            observation is then the first of a new episode) and a dictionary with `is_success` and
            `diverged`. Overridden methods may return other values.

        Raises:
            ValueError: If the action has a wrong shape or contains NaN.
            gymnasium.error.ResetNeeded: If `reset` was never called.
        """
        given = np.asarray(action)
        if given.shape != self.action_space.shape:
            raise ValueError(
                f'an action of {self.spec_of_task.name} has shape {self.action_space.shape}, '
                f'not {given.shape}'
            )
        self._physics.send()
        draws_goals = self._draws_goals()
        result = self.simulation.step(clip_actions(given[None]))
        self._physics.receive()
        diverged = bool(result.diverged[0])
        if diverged and not draws_goals:
            self.goal = self._sample_goal()
        self._show()
        if not draws_goals or any(self.overrides(name) for name in _EVALUATION):
            return self._evaluate(diverged)
        info = {'is_success': float(result.success[0]), 'diverged': diverged}
        observation, reward = _first(result.observation), result.reward[0]
        if self.overrides('compute_reward'):
            goals = observation['achieved_goal'], observation['desired_goal']
            reward = self.compute_reward(*goals, info)
        return observation, float(reward), False, diverged, info

    def _evaluate(self, diverged: bool) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Return the result of a step, from `_get_obs`, `_is_success` and the `compute_` methods.

        If `diverged`, the result is truncated: the simulation has already begun a new episode.
        """
        observation = self._get_obs()
        goals = observation['achieved_goal'], self.goal
        info = {'is_success': self._is_success(*goals), 'diverged': diverged}
        terminated = bool(self.compute_terminated(*goals, info))
        truncated = bool(self.compute_truncated(*goals, info)) or diverged
        return observation, float(self.compute_reward(*goals, info)), terminated, truncated, info

    @property
    def model(self) -> Any:
        """The compiled `mujoco.MjModel`; changes take effect in the environment's next call."""
        return self._physics.model

    @property
    def data(self) -> Any:
        """The live `mujoco.MjData`; changes take effect in the environment's next call."""
        return self._physics.data

    @property
    def dt(self) -> float:
        """Simulated seconds per step, which depend on `model.opt.timestep`."""
        self._physics.send()
        return super().dt

    @property
    def goal(self) -> Array:
        """The desired goal of this episode, (goal size,); a view, valid until the next reset."""
        return np.asarray(self.simulation.goals[0])

    @goal.setter
    def goal(self, goal: ArrayLike) -> None:
        size = (self.spec_of_task.goal.size,)
        given = finite_numbers(f'goal of {self.spec_of_task.name}', goal, size)
        # References to the old array keep their values.
        self.simulation.goals = given[None].copy()

    def render(self) -> Image | None:
        """Render a picture of the robot and its goal.

        Returns:
            `rgb_array`: (height, width, 3) bytes. `depth_array`: (height, width), metres from the
            camera plane. `human`: None, after drawing into a window. None without a render mode.

        Raises:
            RuntimeError: If there is no OpenGL or, for `human`, no display, or if another thread
                rendered the first picture and the OpenGL backend does not allow that.
        """
        if self.render_mode is None:
            return None
        self._physics.send()
        return self._pictures.render(self.render_mode)

    def close(self) -> None:
        """Close renderer and window."""
        self._pictures.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for `pickle`, with changes of `model` and `data`, without OpenGL."""
        self._physics.send()
        return self.__dict__.copy()

    def _draws_goals(self) -> bool:
        """Return True, and let the simulation draw goals, unless `_sample_goal` is overridden."""
        draws_goals = not self.overrides('_sample_goal')
        self.simulation.task.draws_goals = draws_goals
        return draws_goals

    def _get_obs(self) -> Observation:
        self._physics.send()
        return _first(self.simulation.observe())

    def _is_success(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> Any:
        return self.simulation.compute_success(achieved_goal, desired_goal).astype(np.float64)[()]

    def _sample_goal(self) -> Array:
        self._physics.send()
        return self.simulation.task.sample_goal(0, self.np_random)

    def _show(self) -> None:
        if self.render_mode == 'human':
            self.render()


# Methods that a step calls if a subclass overrides one of them.
_EVALUATION = ('_get_obs', '_is_success', 'compute_terminated', 'compute_truncated')


def _first(observation: Observation) -> Observation:
    return {name: rows[0] for name, rows in observation.items()}


class SharedPhysics:
    """The MuJoCo model and data of an environment, which users may read and change.

    Changes take effect in the next call of the environment. Nothing is copied before a user first
    reads `model` or `data`.
    """

    # The model when it was first shared, if its physics vary.
    _unchanged: bytes | None = None

    def __init__(self, simulation: Simulation) -> None:
        """Share simulation 0 of a `Simulation` that was created with `keeps_data=True`."""
        self._simulation = simulation
        self._data: mujoco.MjData | None = None
        self._shares_model = False

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model; always the same object."""
        if not self._shares_model and self._simulation.varies_physics:
            self._unchanged = compiled_bytes(self._simulation.model)
        self._shares_model = True
        return self._simulation.model

    @property
    def data(self) -> mujoco.MjData:
        """The state and the values that MuJoCo derived from it last; always the same object."""
        if self._data is None:
            self._data = mujoco.MjData(self._simulation.model)
            self.receive()
        return self._data

    @property
    def is_shared(self) -> bool:
        """True once the user has read `model` or `data`, and so can change or render them."""
        return self._shares_model or self.shares_data

    @property
    def shares_data(self) -> bool:
        """True once the user has read `data`, and so can change or render it."""
        return self._data is not None

    def move_sites(self, sites: list[int], positions: Array) -> None:
        """Move marker sites with indices (n,) to positions (n, 3) in their body frames, m."""
        is_unchanged = self._is_unchanged()
        self._simulation.model.site_pos[sites] = positions
        if is_unchanged:
            self._unchanged = compiled_bytes(self._simulation.model)

    def _is_unchanged(self) -> bool:
        if self._unchanged is None or not self._simulation.varies_physics:
            return False
        return self._unchanged == compiled_bytes(self._simulation.model)

    def send(self) -> None:
        """Copy changes of `model` and `data` to the simulation; call it before a computation."""
        if self._shares_model and not self._is_unchanged():
            self._simulation.apply_model_changes()
        if self._data is not None:
            self._simulation.write_data(0, self._data)

    def receive(self) -> None:
        """Copy the state of the simulation into `data`; call it after a computation."""
        if self._data is not None:
            self._simulation.read_data(0, self._data)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for `pickle` without `data`; a copy rebuilds `data` on first use."""
        return self.__dict__ | {'_data': None}
