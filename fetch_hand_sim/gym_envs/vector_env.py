"""A `gymnasium.vector.VectorEnv` on a `Simulation` with any number of copies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.env import check_reset_options
from fetch_hand_sim.gym_envs.spaces import action_space, observation_space
from fetch_hand_sim.simulation import Observation, Simulation
from fetch_hand_sim.simulation.rewards import RewardType, SuccessRule
from msgs_spec.tasks import DEFAULT_CONTROL_HZ

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class FetchHandVectorEnv(VectorEnv[Observation, NDArray[np.float32], Any]):
    """N copies of one task, stepped together on all processors.

    An environment whose episode ended starts again at the next step, which ignores its action and
    rewards it with 0 (Gymnasium's `AutoresetMode.NEXT_STEP`). It equals a `SyncVectorEnv` of N
    single environments bit for bit.
    """

    metadata = {  # noqa: RUF012 - as in gymnasium.vector.VectorEnv
        'autoreset_mode': AutoresetMode.NEXT_STEP,
        'render_modes': [],
    }

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        num_threads: int = 0,
        reward_type: RewardType = 'sparse',
        success_rule: SuccessRule = 'gymnasium',
        control_hz: float = DEFAULT_CONTROL_HZ,
    ) -> None:
        """Compiles the model and prepares the copies.

        Args:
            task: One of the thirteen tasks (`msgs_spec.tasks.TASKS`).
            num_envs: Number of copies N.
            max_episode_steps: Steps per episode; None for the task's own number.
            num_threads: Threads that step them; 0 for all processors.
            reward_type: `sparse` (-1 or 0) or `dense` (minus the distance).
            success_rule: `gymnasium` (released code) or `paper` (its text).
            control_hz: Actions per simulated second: 500/n for n = 1 ... 40.

        Raises:
            ValueError: If an argument is not allowed; the message says what is.
        """
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f'max_episode_steps must be at least 1, not {max_episode_steps}')
        self.simulation = Simulation(
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            reward_type=reward_type,
            success_rule=success_rule,
            control_hz=control_hz,
        )
        spec = self.simulation.spec
        self.num_envs = num_envs
        self.single_observation_space = observation_space(spec)
        self.single_action_space = action_space(spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episode_steps = max_episode_steps or spec.episode_ticks
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: One seed (environment i takes seed + i), one per environment, or None: the random
                generators go on.
            options: `reset_mask`, booleans (N,): which environments start again; default all.

        Returns:
            The observations of all environments, and an empty dictionary.

        Raises:
            TypeError: If options is not a dictionary, the mask is no boolean array or a seed is no
                integer.
            ValueError: If an option is unknown, the mask has another shape, a seed is negative or
                there are too many or too few.
        """
        mask = self._reset_mask(options)
        ids = np.flatnonzero(mask)
        seeds = seed
        if seed is not None and not isinstance(seed, int | np.integer):
            if len(seed) != self.num_envs:
                raise ValueError(
                    f'{self.num_envs} environments take as many seeds, not {len(seed)}'
                )
            seeds = [seed[i] for i in ids.tolist()]
        observation = self.simulation.reset(seed=seeds, ids=ids)
        self._elapsed[mask] = 0
        self._ended[mask] = False
        return observation, {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Array, Flags, Flags, dict[str, Any]]:
        """Advances every environment by one tick, or starts it again if its episode had ended.

        Args:
            actions: (N, action size) in [-1, 1].

        Returns:
            Observations, rewards, terminated (never), truncated (at the end of an episode, or when
            MuJoCo lost the simulation) and a dictionary with `is_success` and `diverged`, masked by
            `_is_success` and `_diverged` where an episode only started.

        Raises:
            ValueError: If the actions have a wrong shape, are not finite or out of range.
        """
        started = self._ended
        result = self.simulation.step(actions)
        observation, reward = result.observation, result.reward
        success, diverged = result.success, result.diverged & ~started
        if started.any():
            observation = self.simulation.reset(ids=started)
            reward = np.where(started, 0.0, reward)
            success = success & ~started
        self._elapsed = np.where(started, 0, self._elapsed + 1)
        self._ended = (self._elapsed >= self._episode_steps) | diverged
        info = {
            'is_success': success.astype(np.float64),
            '_is_success': ~started,
            'diverged': diverged,
            '_diverged': ~started,
        }
        terminated = np.zeros(self.num_envs, dtype=bool)
        return observation, reward, terminated, self._ended.copy(), info

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Array:
        """Reward of goals of any batch shape (..., goal size)."""
        return self.simulation.compute_reward(achieved_goal, desired_goal, info)

    def _reset_mask(self, options: Any) -> Flags:
        check_reset_options(options, allowed=('reset_mask',))
        if not options:
            return np.ones(self.num_envs, dtype=bool)
        mask = options['reset_mask']
        if not isinstance(mask, np.ndarray) or mask.dtype != bool:
            raise TypeError(f'reset_mask is a boolean array, not {mask!r}')
        if mask.shape != (self.num_envs,):
            raise ValueError(f'reset_mask has shape ({self.num_envs},), not {mask.shape}')
        return mask
