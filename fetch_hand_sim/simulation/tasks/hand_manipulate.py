"""The eight manipulation tasks: turn a block, an egg or a pen in the hand.

Trajectories equal those of a new environment of `manipulate.py` of Gymnasium-Robotics 1.4.2. That
code does not restore controls and warm start between episodes, so later episodes with a seed differ
from the first. Here every reset starts from the initial state.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Literal

import mujoco
import numpy as np
from mujoco.batch import SimulationError
from numpy.typing import NDArray

from fetch_hand_sim.simulation.tasks.hand import HandTask, load_hand_model
from fetch_hand_sim.simulation.tasks.task import BatchConfig, Generators, Ids, integration_state
from msgs_spec.arrays import Array
from msgs_spec.robots import resting_command
from msgs_spec.rotations import (
    euler_to_quaternion,
    quaternion_from_axis_angle,
    quaternion_multiply,
    quaternion_to_euler,
    quaternion_to_matrix,
)
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TaskSpec, substeps_per_tick

_OBJECT_SITE = 'object:center'
# An object with a lower centre after settling has fallen off the palm, m.
PALM_HEIGHT = 0.04
_SETTLING_TICKS = 10
# Attempts to place the object; the thirteen tasks rarely need a second one.
_MOST_TRIES = 1000
_POSITION_SCATTER = 0.005
# Box around the object that contains the goals of the `Full` tasks, m.
TARGET_RANGE = np.array([(-0.04, 0.04), (-0.06, 0.02), (0.0, 0.06)])
_Z_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class ManipulateConfig:
    """Differences between the manipulation tasks.

    Attributes:
        asset: MJCF file below the assets folder of Gymnasium-Robotics.
        target_rotation: Goals are turned about the z axis (`z`), about the z axis with any face up
            (`parallel`) or about any axis (`xyz`).
        randomizes_rotation: Whether the object starts with a random rotation.
    """

    asset: str
    target_rotation: Literal['z', 'parallel', 'xyz']
    randomizes_rotation: bool = True


_BLOCK, _EGG, _PEN = (f'hand/manipulate_{name}.xml' for name in ('block', 'egg', 'pen'))

MANIPULATE_CONFIGS = {
    'HandManipulateBlockRotateZ': ManipulateConfig(_BLOCK, 'z'),
    'HandManipulateBlockRotateParallel': ManipulateConfig(_BLOCK, 'parallel'),
    'HandManipulateBlockRotateXYZ': ManipulateConfig(_BLOCK, 'xyz'),
    'HandManipulateBlockFull': ManipulateConfig(_BLOCK, 'xyz'),
    'HandManipulateEggRotate': ManipulateConfig(_EGG, 'xyz'),
    'HandManipulateEggFull': ManipulateConfig(_EGG, 'xyz'),
    'HandManipulatePenRotate': ManipulateConfig(_PEN, 'xyz', False),
    'HandManipulatePenFull': ManipulateConfig(_PEN, 'xyz', False),
}


class HandManipulateTask(HandTask):
    """The tasks in which the hand turns a block, an egg or a pen.

    Attributes:
        parallel_quaternions: (24, 4) wxyz, the rotations that map a cube to itself.
    """

    def __init__(
        self, spec: TaskSpec, batch: BatchConfig, config: ManipulateConfig | None = None
    ) -> None:
        self.config = config or MANIPULATE_CONFIGS[spec.name]
        model = load_hand_model(self.config.asset)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.start_state = integration_state(model, data)
        self._start_qpos = data.qpos.copy()
        super().__init__(spec, model, batch)
        assert self.object_qpos is not None and self.object_qvel is not None
        self._object_start = self._start_qpos[self.object_qpos]
        self._object_qpos = self._qpos[:, self.object_qpos]
        self._object_qvel = self._qvel[:, self.object_qvel]
        self._sensors |= {
            'object_pose': lambda task: task._object_qpos.copy(),
            'object_twist': HandManipulateTask._object_twist,
            'object_joint': HandManipulateTask._object_joint,
        }
        self._object_site = model.site(_OBJECT_SITE).id
        self._resting_command = resting_command(spec.robot)
        self.parallel_quaternions = euler_to_quaternion(_parallel_rotations())
        self.batch.state[:] = self.start_state
        per_tick = substeps_per_tick(DEFAULT_CONTROL_HZ)
        self._settling = _SETTLING_TICKS * (self.substeps if batch.timing == 'ticks' else per_tick)

    @property
    def asset(self) -> str:
        """Path of the MJCF file below the assets folder of Gymnasium-Robotics."""
        return self.config.asset

    def reset(self, ids: Ids, generators: Generators) -> Array:
        """Drop the object on the palm until it stays there; return drawn goals (len(ids), 7).

        If an attempt diverges or the object falls, the next attempt keeps the controls and warm
        start of the failed one, as in Gymnasium-Robotics. RuntimeError after 1000 attempts.
        """
        self.batch.state[ids] = self.start_state
        generator_of = dict(zip(ids.tolist(), generators, strict=True))
        left = ids
        for _ in range(_MOST_TRIES):
            self._start_again(left)
            self._object_qpos[left] = [self._sample_start(generator_of[i]) for i in left.tolist()]
            self._ctrl[left] = self._resting_command
            lost = self._settle(left)
            height = self._site_xpos[left, self._object_site, 2]
            left = left[~(height > PALM_HEIGHT) | lost[left]]
            if not left.size:
                return self.sample_goals(ids, generators)
        raise RuntimeError(f'{self.spec.name}: the object fell off the palm {_MOST_TRIES} times')

    def _settle(self, ids: Ids) -> NDArray[np.bool_]:
        """Let objects come to rest, for ten ticks; return flags (N,) of diverged simulations."""
        self.take_diverged()
        failed = np.zeros(self.batch.nsim, dtype=np.bool_)
        for advance in (partial(self.batch.step, nstep=self._settling), self.batch.forward):
            try:
                advance(ids)
            except SimulationError as error:
                failed[error.ids] = True
        return failed | self.take_diverged()

    def _start_again(self, ids: Ids) -> None:
        self.batch.bind('time')[ids] = 0.0
        self._qpos[ids] = self._start_qpos
        self._qvel[ids] = 0.0
        self.batch.forward(ids)

    def _sample_start(self, generator: np.random.Generator) -> Array:
        """Draw the start pose (7,) of the object in the world: position, m, and quaternion wxyz."""
        position, quaternion = self._object_start[:3].copy(), self._object_start[3:]
        if self.config.randomizes_rotation:
            offset = self._sample_rotation(generator)
            quaternion = quaternion_multiply(quaternion, offset)
        position += generator.normal(size=3, scale=_POSITION_SCATTER)
        return np.concatenate([position, quaternion / np.linalg.norm(quaternion)])

    def _sample_rotation(self, generator: np.random.Generator) -> Array:
        """Draw a random rotation of the kind `target_rotation`, a quaternion wxyz (4,)."""
        angle = generator.uniform(-np.pi, np.pi)
        if self.config.target_rotation == 'xyz':
            axis = generator.uniform(-1.0, 1.0, size=3)
            return quaternion_from_axis_angle(axis, angle)
        about_z = quaternion_from_axis_angle(_Z_AXIS, angle)
        if self.config.target_rotation == 'z':
            return about_z
        faces = self.parallel_quaternions
        return quaternion_multiply(about_z, faces[generator.integers(len(faces))])

    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draw a goal pose (7,) with the object's position in simulation `index`, randomly turned.

        In the `Full` tasks, in which the position counts, the goal is also randomly shifted.
        """
        position = self._object_qpos[index, :3].copy()
        if self.spec.position_counts:
            position += generator.uniform(TARGET_RANGE[:, 0], TARGET_RANGE[:, 1])
        quaternion = self._sample_rotation(generator)
        return np.concatenate([position, quaternion / np.linalg.norm(quaternion)])

    def _object_twist(self) -> Array:
        """Return the object's linear and angular velocity in world axes, (N, 6), m/s and rad/s."""
        rotation = quaternion_to_matrix(self._object_qpos[:, 3:])
        angular = np.einsum('nij,nj->ni', rotation, self._object_qvel[:, 3:])
        return np.concatenate([self._object_qvel[:, :3], angular], axis=1)

    def _object_joint(self) -> Array:
        """Return qpos (7) and qvel (6) of the object's free joint in MuJoCo's order, (N, 13)."""
        return np.concatenate([self._object_qpos, self._object_qvel], axis=1)


def _parallel_rotations() -> Array:
    """Return the 24 rotations that map a cube to itself, as Euler angles xyz (24, 3), rad.

    The order is that of Gymnasium-Robotics.
    """
    quarter = np.pi / 2
    products = list(itertools.product([0.0, quarter, -quarter, np.pi], repeat=3))
    turns = np.round(quaternion_to_euler(euler_to_quaternion(products)) / quarter)
    # Half a turn back is half a turn forward.
    turns[:, [0, 2]] = np.where(turns[:, [0, 2]] == -2, 2, turns[:, [0, 2]])
    _, first = np.unique(turns, axis=0, return_index=True)
    return np.asarray(turns[np.sort(first)] * quarter)
