"""Base class of the hand tasks: 20 position actuators, 24 joints, 5 fingertips."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.models import list_geom_pairs, load_spec, skip_unread_stages
from fetch_hand_sim.simulation.tasks.task import BatchConfig, Task, weakly
from msgs_spec.arrays import Array
from msgs_spec.robots import FINGERTIPS, command_from_action
from msgs_spec.tasks import TaskSpec


def load_hand_model(asset: str) -> mujoco.MjModel:
    """Compile a hand model, tuned to step faster along the same trajectories."""
    mjcf = load_spec(asset)
    list_geom_pairs(mjcf)
    model = mjcf.compile()
    skip_unread_stages(model)
    return model


def fingertip_sites(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the site indices of the fingertips in the order of goals."""
    return np.array([model.site(f'robot0:S_{name}').id for name in FINGERTIPS], dtype=np.intp)


class HandTask(Task):
    """Base of the hand tasks."""

    def __init__(self, spec: TaskSpec, model: mujoco.MjModel, batch: BatchConfig) -> None:
        super().__init__(spec, model, batch)
        self._ctrl: Array = self.batch.bind('ctrl')
        self._scaled_robot = spec.robot
        self._compiled_ranges = model.actuator_ctrlrange.copy()
        self._site_xpos: Array = self.output('site_xpos')
        self._xquat = self.output('xquat')
        self._fingertip_sites = fingertip_sites(model)
        self._fingertip_bodies = model.site_bodyid[self._fingertip_sites]
        self._sensors['fingertip_poses'] = weakly(self._fingertip_poses)

    def follow_model(self) -> None:
        """Follow the model; actions span `actuator_ctrlrange` once it was written to."""
        super().follow_model()
        ranges = self.model.actuator_ctrlrange
        self._scaled_robot = self.spec.robot
        if (ranges != self._compiled_ranges).any():
            parts = zip(self.spec.robot.command, ranges.tolist(), strict=True)
            command = tuple(replace(part, lower=low, upper=high) for part, (low, high) in parts)
            self._scaled_robot = replace(self.spec.robot, command=command)

    def commands_from_actions(self, actions: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return joint angles (N, 20), rad, of actions in [-1, 1]."""
        return command_from_action(self._scaled_robot, actions)

    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Set the position actuators to absolute joint angles, rad."""
        self._ctrl[:] = commands

    def resting_commands(self) -> Array:
        """Return the present targets of the actuators, rad."""
        return self._ctrl.copy()

    def _fingertip_poses(self) -> Array:
        """Return fingertip positions, m, and orientations wxyz (those of the bodies), (N, 35)."""
        positions = self._site_xpos[:, self._fingertip_sites]
        quaternions = self._xquat[:, self._fingertip_bodies]
        return np.concatenate([positions, quaternions], axis=2).reshape(self.batch.nsim, -1)
