"""A single `gymnasium.Env` on a `Simulation` with one copy."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.spaces import action_space, observation_space
from fetch_hand_sim.simulation import Observation, Simulation
from fetch_hand_sim.simulation.rendering import SceneRenderer, simulation_frame
from fetch_hand_sim.simulation.rewards import RewardType, SuccessRule
from fetch_hand_sim.simulation.scene import Scene
from msgs_spec.tasks import DEFAULT_CONTROL_HZ

Array = NDArray[np.float64]


class FetchHandEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task with dictionary observations, for hindsight experience replay.

    Episodes never terminate; `gymnasium.make` truncates them after the task's number of steps. Give
    it the keyword arguments of this class.

    Attributes:
        spec_of_task: The task as data.
        simulation: The simulation behind it.
    """

    metadata = {  # noqa: RUF012 - as in gymnasium.Env
        'render_modes': ['rgb_array'],
        'render_fps': int(DEFAULT_CONTROL_HZ),
    }

    def __init__(
        self,
        task: str,
        reward_type: RewardType = 'sparse',
        success_rule: SuccessRule = 'gymnasium',
        control_hz: float = DEFAULT_CONTROL_HZ,
        render_mode: str | None = None,
    ) -> None:
        """Compiles the model.

        Args:
            task: One of the thirteen tasks (`msgs_spec.tasks.TASKS`).
            reward_type: `sparse` (-1 or 0) or `dense` (minus the distance).
            success_rule: `gymnasium` (released code) or `paper` (its text).
            control_hz: Actions per simulated second: 500/n for n = 1 ... 40.
            render_mode: `rgb_array` or None.

        Raises:
            ValueError: If an argument is not allowed; the message says what is.
        """
        if render_mode not in (None, *self.metadata['render_modes']):
            raise ValueError(f'render_mode {render_mode!r} is not known; allowed: None, rgb_array')
        self.simulation = Simulation(
            task,
            num_envs=1,
            num_threads=1,
            reward_type=reward_type,
            success_rule=success_rule,
            control_hz=control_hz,
        )
        self.spec_of_task = self.simulation.spec
        self.metadata = {**self.metadata, 'render_fps': control_hz}
        self.observation_space = observation_space(self.spec_of_task)
        self.action_space = action_space(self.spec_of_task)
        self.render_mode = render_mode
        self._renderer: SceneRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Starts the random generator again; None lets it go on.
            options: None or empty; there are none.

        Returns:
            The observation, and an empty dictionary.

        Raises:
            TypeError: If options is not a dictionary.
            ValueError: If there are options.
            gymnasium.error.Error: If the seed is no integer or negative.
        """
        check_reset_options(options, allowed=())
        super().reset(seed=seed)
        observation = self.simulation.reset(seed=[self.np_random])
        return _first(observation), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances one tick.

        Args:
            action: (action size,) in [-1, 1].

        Returns:
            Observation, reward, terminated (never), truncated (only if MuJoCo lost the simulation:
            the observation is then the first of a new episode) and a dictionary with `is_success`
            and `diverged`.

        Raises:
            ValueError: If the action has a wrong shape, is not finite or out of range.
        """
        result = self.simulation.step(np.asarray(action)[None])
        diverged = bool(result.diverged[0])
        info = {'is_success': float(result.success[0]), 'diverged': diverged}
        return _first(result.observation), float(result.reward[0]), False, diverged, info

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Array:
        """Reward of goals of any batch shape (..., goal size)."""
        return self.simulation.compute_reward(achieved_goal, desired_goal, info)

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture (480, 640, 3) of the robot and its goal; None without a render mode.

        Raises:
            RuntimeError: If there is no OpenGL.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = SceneRenderer(Scene(self.spec_of_task.name))
        return self._renderer.render(simulation_frame(self.simulation))

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def check_reset_options(options: Any, allowed: tuple[str, ...]) -> None:
    """Refuses options of `reset` that are not there, before anything has moved.

    Raises:
        TypeError: If options is neither a dictionary nor None.
        ValueError: If an option is not allowed.
    """
    if options is None:
        return
    if not isinstance(options, dict):
        raise TypeError(f'options of reset are a dictionary or None, not {options!r}')
    for name in options:
        if name not in allowed:
            known = ', '.join(allowed) or 'none'
            raise ValueError(f'reset option {name!r} is not known; allowed: {known}')


def _first(observation: Observation) -> Observation:
    return {name: rows[0] for name, rows in observation.items()}
