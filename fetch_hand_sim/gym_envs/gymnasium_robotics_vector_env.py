"""A batch of the environments that code written for Gymnasium-Robotics expects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.gym_envs.gymnasium_robotics_env import (
    CAMERAS,
    SIZE,
    RobotEnv,
    as_reference,
    make_env,
    task_with_goals,
)
from fetch_hand_sim.gym_envs.vector_env import FetchHandVectorEnv
from fetch_hand_sim.simulation import Observation
from fetch_hand_sim.simulation.tasks.hand_manipulate import MANIPULATE_CONFIGS
from msgs_spec.arrays import Array, Flags
from msgs_spec.tasks import task_spec


class GymnasiumRoboticsVectorEnv(FetchHandVectorEnv):
    """N copies of a reference's task, as a `SyncVectorEnv` of single ones shows them.

    Args:
        task: The task.
        num_envs: Number of copies N.
        target_position: As `ManipulateEnv` has it.
        target_rotation: As `ManipulateEnv` has it.
        width: Pixels of a picture.
        height: Pixels of a picture.
        default_camera_config: Attributes of `mujoco.MjvCamera` that differ from the reference's.
        **arguments: As `FetchHandVectorEnv` has them.

    Raises:
        ValueError: If an argument is not allowed.
        TypeError: If the task has no such argument.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        target_position: str | None = None,
        target_rotation: str | None = None,
        width: int = SIZE,
        height: int = SIZE,
        default_camera_config: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        if task in MANIPULATE_CONFIGS:
            task = task_with_goals(task, target_position, target_rotation)
        elif target_position is not None or target_rotation is not None:
            raise TypeError(f'{task} takes neither target_position nor target_rotation')
        camera = {**CAMERAS[task_spec(task).robot.name], **(default_camera_config or {})}
        super().__init__(
            task,
            num_envs=num_envs,
            width=width,
            height=height,
            default_camera_config=camera,
            **arguments,
        )

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts episodes; options but `reset_mask` are ignored, as the reference does."""
        known = None
        if isinstance(options, dict) and 'reset_mask' in options:
            known = {'reset_mask': options['reset_mask']}
        return super().reset(seed=seed, options=known)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Array, Flags, Flags, dict[str, Any]]:
        """Advances as `FetchHandVectorEnv` does, with the reference's type of successes."""
        observation, reward, terminated, truncated, info = super().step(actions)
        for each in (info, info.get('final_info', {})):
            if 'is_success' in each:
                each['is_success'] = each['is_success'].astype(np.float32)
        return observation, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: ArrayLike, goal: ArrayLike, info: Any = None) -> Any:
        """Reward of goals of any batch shape: float32 if sparse, a number for a single goal."""
        reward = super().compute_reward(achieved_goal, goal, info)[()]
        return as_reference(reward, self.reward_type)

    def attributes(self, name: str) -> tuple[Any, ...]:
        """As `FetchHandVectorEnv`; also what is stated of the task, such as `initial_qpos`."""
        try:
            return super().attributes(name)
        except AttributeError:
            if name not in self._single.stated:
                raise
            return (getattr(self._single, name),) * self.num_envs

    @cached_property
    def _single(self) -> RobotEnv:
        """One environment, for the attributes that all have in common; made at first use."""
        return make_env(self.spec_of_task.name, control_hz=self.simulation.control_hz)
