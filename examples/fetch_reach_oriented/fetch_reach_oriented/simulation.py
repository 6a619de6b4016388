"""The physics of the task: FetchReach's arm and table, other goals, a gripper that turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.tasks.fetch import FETCH_CONFIGS, FetchTask
from fetch_hand_sim.simulation.tasks.task import Array, BatchConfig
from fetch_reach_oriented.specification import TURN_STEP
from msgs_spec.robots import GRIPPER_STEP
from msgs_spec.rotations import quaternion_from_axis_angle, quaternion_multiply
from msgs_spec.tasks import TaskSpec

# Goals are turned by at most this angle about any axis, radians.
_LARGEST_TURN = np.pi / 3


class FetchReachOrientedTask(FetchTask):
    """FetchReachOriented."""

    ASSET = FETCH_CONFIGS['FetchReach'].asset

    def __init__(self, spec: TaskSpec, batch: BatchConfig) -> None:
        """Starts as FetchReach does."""
        super().__init__(spec, batch, FETCH_CONFIGS['FetchReach'])
        self.batch.forward()
        self._start_rotation = self.gripper_rotation[0].copy()

    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draws a point as FetchReach does, and a turn of the gripper."""
        point = super().sample_goal(index, generator)
        axis, angle = generator.normal(size=3), generator.uniform(-_LARGEST_TURN, _LARGEST_TURN)
        turn = quaternion_from_axis_angle(axis, angle)
        return np.concatenate([point, quaternion_multiply(turn, self._start_rotation)])

    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Moves and turns the mocap body to which the gripper is welded."""
        turn = TURN_STEP * self.lead_scale * commands[:, 3:].astype(np.float64)
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        # sin(angle / 2) / angle, also at zero.
        share = np.sinc(angle / (2.0 * np.pi)) / 2.0
        rotation = np.concatenate([np.cos(angle / 2.0), share * turn], axis=1)
        target = quaternion_multiply(rotation, self.gripper_rotation)
        self.move_gripper(GRIPPER_STEP * self.lead_scale * commands[:, :3], target)
