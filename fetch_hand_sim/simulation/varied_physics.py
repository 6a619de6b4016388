"""Physics of single simulations that differs from the model, by the batch's own model fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.tasks import Task
from msgs_spec.arrays import Array
from msgs_spec.disturbances import PhysicsDisturbance

Ids = NDArray[np.intp]
_OBJECTS = ('object0', 'object')
_TABLE = 'table0'
# Model fields that each variation changes.
_FIELDS = {
    'friction': ('geom_friction', 'pair_friction'),
    'object_mass': (
        'body_mass',
        'body_inertia',
        'body_subtreemass',
        'body_invweight0',
        'dof_invweight0',
    ),
    'object_size': ('geom_size', 'geom_rbound', 'geom_aabb', 'bvh_aabb'),
    'gain': ('actuator_gainprm', 'actuator_biasprm'),
    'force_limit': ('actuator_forcerange',),
    'damping': ('dof_damping',),
    'gravity_tilt': ('opt.gravity',),
    'table_height': ('body_pos',),
}


class VariedPhysics:
    """Writes the variations of each simulation into its own copy of some model fields."""

    def __init__(self, task: Task, physics: PhysicsDisturbance) -> None:
        self._task = task
        self._body = first_body(task.model, _OBJECTS)
        self._table = first_body(task.model, (_TABLE,))
        self._live: dict[str, Array] = {}
        self._nominal: dict[str, Array] = {}
        off = PhysicsDisturbance()
        self._names = [name for name in _FIELDS if getattr(physics, name) != getattr(off, name)]
        # A preset names what some tasks lack; it is then left out.
        self._names = [name for name in self._names if self._has(name)]
        for name in self._names:
            self._expand(name)

    def _has(self, name: str) -> bool:
        if name.startswith('object_'):
            return self._body > 0
        if name == 'table_height':
            return self._table > 0
        if name in ('gain', 'force_limit'):
            return bool(self._task.model.nu)
        return name != 'damping' or not self._task.spec.robot.has_gripper_command

    @property
    def names(self) -> tuple[str, ...]:
        """The variations that are possible."""
        return tuple(self._names)

    def allow(self, name: str) -> None:
        """Make a variation possible that is off by default, or raise ValueError."""
        if name in self._names:
            return
        if not self._has(name):
            raise ValueError(f'{self._task.spec.name} has no {name} to vary')
        self._expand(name)
        self._names.append(name)

    def _expand(self, name: str) -> None:
        for field in _FIELDS[name]:
            if field not in self._live:
                try:
                    self._live[field] = self._task.batch.expand(field)
                except mujoco.FatalError:
                    raise ValueError(
                        f'{name} cannot vary after the model was shared or changed; vary it by the '
                        'disturbances with which the simulation is made'
                    ) from None
                self._nominal[field] = self._live[field][0].copy()

    def restore(self, ids: Ids) -> None:
        """Give simulations the physics of the model."""
        for field, values in self._live.items():
            values[ids] = self._nominal[field]

    def apply(self, ids: Ids, variations: Mapping[str, Array]) -> bool:
        """Write variations (N,) of simulations in nominal physics; return whether any are on."""
        for name in self._names:
            change: Callable[[Ids, Mapping[str, Array]], None]
            change = getattr(self, f'_vary_{name}', None) or self._factor(name)
            change(ids, variations)
        return bool(self._names)

    def _factor(self, name: str) -> Callable[[Ids, Mapping[str, Array]], None]:
        def change(ids: Ids, variations: Mapping[str, Array]) -> None:
            for field in _FIELDS[name]:
                values = self._live[field]
                shape = (-1,) + (1,) * (values.ndim - 1)
                values[ids] *= variations[name][ids].reshape(shape)

        return change

    def _vary_object_mass(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        factor, body, live = variations['object_mass'][ids], self._body, self._live
        added = (factor - 1.0) * self._nominal['body_mass'][body]
        live['body_mass'][ids, body] *= factor
        live['body_inertia'][ids, body] *= factor[:, None]
        live['body_subtreemass'][ids, body] += added
        live['body_subtreemass'][ids, 0] += added
        # `mj_setConst` derives these for a free body.
        live['body_invweight0'][ids, body] /= factor[:, None]
        first = int(self._task.model.body_dofadr[body])
        live['dof_invweight0'][ids, first : first + 6] /= factor[:, None]

    def _vary_object_size(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        model, factor = self._task.model, variations['object_size'][ids]
        geoms = np.flatnonzero(model.geom_bodyid == self._body)
        boxes = int(model.body_bvhadr[self._body]) + np.arange(int(model.body_bvhnum[self._body]))
        rows: dict[str, Any] = {
            'geom_size': geoms,
            'geom_rbound': geoms,
            'geom_aabb': geoms,
            'bvh_aabb': boxes,
        }
        for field, places in rows.items():
            values = self._live[field]
            shape = (-1,) + (1,) * (values.ndim - 1)
            values[np.ix_(ids, places)] *= factor.reshape(shape)

    def _vary_damping(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        dofs = joint_dofs(self._task)
        self._live['dof_damping'][np.ix_(ids, dofs)] *= variations['damping'][ids][:, None]

    def _vary_gravity_tilt(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        tilt, direction = variations['gravity_tilt'][ids], variations['gravity_direction'][ids]
        strength = float(np.linalg.norm(self._nominal['opt.gravity']))
        across = np.sin(tilt) * strength
        self._live['opt.gravity'][ids] = np.stack(
            [across * np.cos(direction), across * np.sin(direction), -np.cos(tilt) * strength],
            axis=1,
        )

    def _vary_table_height(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        shift = variations['table_height'][ids]
        self._live['body_pos'][ids, self._table, 2] += shift


def joint_dofs(task: Task) -> NDArray[np.intp]:
    """Return the degree of freedom of each joint of the robot, (joints,)."""
    model = task.model
    return np.array([int(model.joint(name).dofadr[0]) for name in task.spec.robot.joints])


def first_body(model: mujoco.MjModel, names: tuple[str, ...]) -> int:
    """Return the number of the first of these bodies that the model has, or 0."""
    numbers = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY.value, name) for name in names)
    return next((number for number in numbers if number > 0), 0)
