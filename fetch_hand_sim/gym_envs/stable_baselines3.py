"""A `VecEnv` for Stable-Baselines3; needs `pip install 'fetch_hand_sim[sb3]'`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from fetch_hand_sim.gym_envs.task_attributes import RESET_OPTIONS
from fetch_hand_sim.gym_envs.vector_env import FetchHandVectorEnv
from fetch_hand_sim.simulation import Observation
from msgs_spec.text import entries


class FetchHandVecEnv(VecEnv):
    """N copies of one task for Stable-Baselines3, stepped together on all processors.

    It behaves as a `DummyVecEnv` of N single environments: the step that ends an episode starts
    the next one, and `info['terminal_observation']` is the last observation. Wrap it in a
    `VecMonitor` for the returns of episodes. `arguments` are those of `FetchHandVectorEnv` except
    `autoreset_mode`.
    """

    def __init__(self, task: str, num_envs: int = 1, **arguments: Any) -> None:
        self.batch = FetchHandVectorEnv(
            task, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments
        )
        super().__init__(
            num_envs, self.batch.single_observation_space, self.batch.single_action_space
        )
        # Films of `VecVideoRecorder` take their speed from it.
        self.metadata = dict(self.batch.metadata)
        self._actions: NDArray[np.float32] | None = None

    def reset(self) -> Observation:
        """Start all episodes, with the seeds and options that `seed` and `set_options` set.

        Both are used once. Options are `goal`, `variation` and `start`, as in `FetchHandEnv.reset`.

        Raises:
            ValueError: If an option is unknown or invalid. All options are cleared then.
        """
        options = self._options
        self._reset_options()
        named = [entries('options', each, RESET_OPTIONS) for each in options]
        given = {name: [each.get(name) for each in named] for name in RESET_OPTIONS}
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, _ = self.batch.reset(seed=seeds, options=given)
        self._reset_seeds()
        return observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the actions (N, action size) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments with the stored actions; return what `VecEnv.step` returns."""
        assert self._actions is not None, 'step_async comes before step_wait'
        observation, reward, terminated, truncated, info = self.batch.step(self._actions)
        ended = terminated | truncated
        # The info of the last step of an ended episode.
        last = info.get('final_info', info)
        columns = {
            name: np.where(ended, last[name], info.get(name, last[name]))
            for name in ('is_success', 'diverged')
        }
        columns['TimeLimit.truncated'] = truncated & ~terminated
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        infos: list[dict[str, Any]] = [dict(zip(columns, row, strict=True)) for row in rows]
        for index in np.flatnonzero(ended).tolist():
            infos[index]['terminal_observation'] = info['final_obs'][index]
        return observation, reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """Close the renderer."""
        self.batch.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of every environment; N times None without a render mode."""
        return self.batch.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment in `indices`; methods are not called."""
        values = self.batch.attributes(attr_name)
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set `goal` of the environments in `indices`, or an attribute that all environments share.

        Shared are `reward_type`, `distance_threshold` and `rotation_threshold`. A new value of
        these for only some of the environments raises ValueError.
        """
        values = list(self.batch.attributes(attr_name))
        for index in self._get_indices(indices):
            values[index] = value
        self.batch.set_attr(attr_name, values)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method once for all N environments; return one result for each in `indices`."""
        results = self.batch.call(method_name, *method_args, **method_kwargs)
        return [results[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each environment: members of a batch have no wrappers."""
        return [False for _ in self._get_indices(indices)]
