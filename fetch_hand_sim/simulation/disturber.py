"""Apply `Disturbances` to a batch: commands, physics, pushes, start states and sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.models import find
from fetch_hand_sim.simulation.tasks import Task
from fetch_hand_sim.simulation.tasks.task import SiteMotion
from msgs_spec.arrays import Array
from msgs_spec.disturbances import MOST_TICKS, Disturbances, PhysicsDisturbance
from msgs_spec.observations import Readings
from msgs_spec.robots import FINGERTIPS, command_limits
from msgs_spec.rotations import quaternion_multiply
from msgs_spec.text import entries

Ids = NDArray[np.intp]
# Ticks whose random numbers are drawn at once.
_BLOCK = 64
# Tracking that is lost comes back after half a second.
_LOST_TICKS = 12
_PHYSICS = [each.name for each in fields(PhysicsDisturbance)]
# Group and field of each range from which an episode draws once.
_SPANS = {
    'action_latency': ('action', 'latency'),
    'joint_latency': ('joints', 'latency'),
    'object_latency': ('object', 'latency'),
    'object_period': ('object', 'period'),
    **{name: ('physics', name) for name in _PHYSICS if name != 'gravity_tilt'},
}
VARIATIONS = (*_SPANS, 'gravity_tilt', 'gravity_direction')
# Topics computed from the joint sensors, and the sites whose poses they hold.
_LED = {
    'end_effector_pose': ('robot0:grip',),
    'fingertip_poses': tuple(f'robot0:S_{name}' for name in FINGERTIPS),
}
_JOINT_TOPICS = ('joint_states', 'end_effector_pose', 'end_effector_twist', 'fingertip_poses')
_OBJECT_TOPICS = ('object_pose', 'object_twist', 'object_joint')


class Disturber:
    """The disturbances of N simulations of one task.

    All random numbers of an episode come from one stream that belongs to the episode's seed and is
    independent of the draws of start and goal.

    Attributes:
        variations: Values drawn for the running episodes, (N,) each, by the names in `VARIATIONS`.
    """

    def __init__(self, task: Task, disturbances: Disturbances) -> None:
        self.disturbances = disturbances
        self._task = task
        count, size = task.batch.nsim, task.spec.robot.action_size
        self._all = np.arange(count)
        self.variations = {name: np.zeros(count) for name in VARIATIONS}
        is_angle = np.array([unit == 'rad' for unit in task.spec.robot.joint_units])
        self._angles = np.flatnonzero(is_angle)
        self._widths = {
            'action': size,
            'joint': self._angles.size,
            'velocity': self._angles.size,
            'object': 6,
            'push': 3,
        }
        ends = np.cumsum(list(self._widths.values()))
        self._columns = {
            name: slice(int(end) - width, int(end))
            for (name, width), end in zip(self._widths.items(), ends, strict=True)
        }
        self._streams: list[np.random.Generator | None] = [None] * count
        self._tick = np.zeros(count, np.int64)
        self._normal = np.zeros((count, _BLOCK, int(ends[-1])))
        self._uniform = np.zeros((count, _BLOCK, 5))
        self._biases = {name: np.zeros((count, self._widths[name])) for name in self._widths}
        self._start_shift = np.zeros((count, 2))
        self._start_joints = np.zeros((count, self._angles.size))
        self._lower, self._upper = command_limits(task.spec.robot)
        self._sent = np.zeros((MOST_TICKS + 1, count, size))
        self._applied = np.zeros((count, size))
        self._lost = np.zeros(count, np.int64)
        self._true: dict[str, Array] = {}
        self._is_true_current = False
        self._held: dict[str, Array] = {}
        self._physics = VariedPhysics(task, disturbances.physics)
        names = (task.spec.object_name, 'robot0:gripper_link', 'robot0:palm')
        # The object, or the gripper or palm in tasks without one.
        self._pushed_body = first_body(task.model, names) or int(task.model.nbody - 1)
        gravity = float(np.linalg.norm(task.model.opt.gravity))
        self._weight = gravity * float(task.model.body_subtreemass[self._pushed_body])
        joints = self.disturbances.joints
        self._moves_joint_readings = bool(joints.noise or joints.bias or joints.resolution)
        self._levers: dict[str, list[_Lever]] = {
            name: [_Lever(task, site) for site in sites]
            for name, sites in _LED.items()
            if name in task.sensors and self._moves_joint_readings
        }

    # Episodes

    def allow(self, given: Mapping[str, Any]) -> dict[str, float]:
        """Make requested variations possible and return them as numbers, or raise ValueError."""
        named = entries('variation', given, VARIATIONS)
        wanted = {name: _variation(name, value) for name, value in named.items()}
        for name in wanted:
            if name in _PHYSICS:
                self._physics.allow(name)
        return wanted

    @property
    def varies_physics(self) -> bool:
        """True if simulations differ from the model."""
        return bool(self._physics.names)

    def start_nominal(self, ids: Ids) -> None:
        """Restore the model's physics, in which the task draws its start state."""
        self._physics.restore(ids)

    def start(
        self,
        ids: Ids,
        streams: Sequence[np.random.Generator],
        given: Mapping[int, Mapping[str, float]],
    ) -> None:
        """Begin episodes whose start state the task has set."""
        for index, stream in zip(ids.tolist(), streams, strict=True):
            self._streams[index] = stream
            self._draw_episode(index, stream, given.get(index, {}))
            self._draw_block(index)
        self._tick[ids] = 0
        self._lost[ids] = 0
        self._sent[:, ids] = self._task.resting_commands()[ids]
        self._applied[ids] = self._sent[0, ids]
        has_changed = self._physics.apply(ids, self.variations)
        has_changed |= self._shift_start(ids)
        if has_changed:
            self._task.batch.forward(ids)
        self._sense(ids, is_first=True)

    def _draw_episode(
        self, index: int, stream: np.random.Generator, given: Mapping[str, float]
    ) -> None:
        uniform = stream.random(len(VARIATIONS))
        for name, share in zip(VARIATIONS, uniform.tolist(), strict=True):
            self.variations[name][index] = given.get(name, self._drawn(name, share))
        spread = {
            'action': self.disturbances.action.bias,
            'joint': self.disturbances.joints.bias,
        }
        for name, values in self._biases.items():
            values[index] = spread.get(name, 0.0) * stream.standard_normal(self._widths[name])
        pose = self._biases['object'][index]
        pose[:] = stream.standard_normal(6)
        pose[:3] *= self.disturbances.object.bias
        pose[3:] *= self.disturbances.object.rotation_bias
        self._start_shift[index] = stream.uniform(-1.0, 1.0, 2)
        self._start_joints[index] = stream.standard_normal(self._angles.size)

    def _drawn(self, name: str, share: float) -> float:
        """A value from the range of a variation, `share` of the way through it."""
        if name == 'gravity_tilt':
            return share * self.disturbances.physics.gravity_tilt
        if name == 'gravity_direction':
            return share * 2.0 * np.pi
        group, field_name = _SPANS[name]
        values = getattr(self.disturbances, group)
        lowest, highest = getattr(values, field_name)
        kind = next(each.metadata['kind'] for each in fields(values) if each.name == field_name)
        if kind in ('ticks', 'period'):
            return float(lowest + int(share * (highest - lowest + 1)))
        if kind == 'factor':
            return float(lowest * (highest / lowest) ** share)
        return float(lowest + share * (highest - lowest))

    def _draw_block(self, index: int) -> None:
        stream = self._streams[index]
        assert stream is not None, 'every episode has begun'
        self._normal[index] = stream.standard_normal(self._normal.shape[1:])
        self._uniform[index] = stream.random(self._uniform.shape[1:])

    def _shift_start(self, ids: Ids) -> bool:
        """Move objects and joints of new episodes; return whether something has moved."""
        start, moved = self.disturbances.start, False
        qpos: Array = self._task.batch.bind('qpos')
        if self._task.object_qpos is not None:
            place = self._task.object_qpos.start
            lift = self.variations['table_height'][ids]
            if start.object_position or lift.any():
                shift = start.object_position * self._start_shift[ids]
                qpos[ids, place : place + 2] += shift
                qpos[ids, place + 2] += lift
                moved = True
        if start.joints and not self._task.spec.robot.has_gripper_command:
            places = self._task.joint_qpos[self._angles]
            qpos[np.ix_(ids, places)] += start.joints * self._start_joints[ids]
            moved = True
        return moved

    # Commands

    def command(self, commands: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return what reaches the motors in this tick, (N, action size), in the type given."""
        self._tick += 1
        for index in np.flatnonzero(self._tick % _BLOCK == 0).tolist():
            self._draw_block(index)
        action, row = self.disturbances.action, self._tick % _BLOCK
        self._sent = np.roll(self._sent, 1, axis=0)
        self._sent[0] = commands
        delay = self.variations['action_latency'].astype(np.intp)
        arrived = self._sent[delay, self._all]
        chance = self._uniform[self._all, row]
        kept = self._applied
        if self._task.spec.robot.has_gripper_command:
            dropped = np.zeros_like(kept)
        else:
            dropped = kept
        arrived = np.where((chance[:, 0] < action.drop)[:, None], dropped, arrived)
        self._applied = np.where((chance[:, 1] < action.repeat)[:, None], kept, arrived)
        noise = action.noise * self._normal[self._all, row, self._columns['action']]
        moved = noise + self._biases['action']
        if not moved.any():
            return self._applied.astype(commands.dtype)
        half = (self._upper - self._lower) / 2.0
        disturbed = np.clip(self._applied + half * moved, self._lower, self._upper)
        return disturbed.astype(commands.dtype)

    def push(self, forces: Array) -> bool:
        """Add the pushes of this tick to (N, bodies, 6) wrenches; return whether there are any."""
        pushes = self.disturbances.pushes
        if not pushes.force:
            return False
        row = self._tick % _BLOCK
        per_tick = pushes.rate * self._task.tick_duration
        pushed = self._uniform[self._all, row, 2] < per_tick
        force = pushes.force * self._weight * self._normal[self._all, row, self._columns['push']]
        forces[pushed, self._pushed_body, :3] += force[pushed]
        return bool(pushed.any())

    # Sensors

    def sense(self) -> None:
        """Take the measurements of this tick; `readings` returns them until the next."""
        self._sense(self._all, is_first=False)

    def readings(self) -> Readings:
        """Return what the disturbed sensors measured last, fresh arrays."""
        return {name: values.copy() for name, values in self._held.items()}

    def true_readings(self) -> Readings:
        """Return what undisturbed sensors measure now, fresh arrays."""
        if not self._is_true_current:
            return self._task.readings()
        return {name: past[0].copy() for name, past in self._true.items()}

    def note_written_state(self) -> None:
        """Read the true sensors again, because the user has changed the state."""
        self._is_true_current = False

    def _sense(self, ids: Ids, is_first: bool) -> None:
        true = self._task.readings()
        for name, values in true.items():
            if name not in self._true:
                self._true[name] = np.zeros((MOST_TICKS + 1, *values.shape))
                self._held[name] = values.copy()
            past = self._true[name]
            if is_first:
                past[:, ids] = values[ids]
            else:
                past[1:] = past[:-1].copy()
                past[0] = values
        self._is_true_current = True
        self._sense_joints(ids, true)
        self._sense_object(ids, true, is_first)
        for name in true.keys() - {*_JOINT_TOPICS, *_OBJECT_TOPICS}:
            self._held[name][ids] = true[name][ids]

    def _delayed(self, name: str, latency: str) -> Array:
        return self._true[name][self.variations[latency].astype(np.intp), self._all]

    def _sense_joints(self, ids: Ids, true: Readings) -> None:
        joints, row = self.disturbances.joints, self._tick % _BLOCK
        measured = {
            name: self._delayed(name, 'joint_latency') for name in _JOINT_TOPICS if name in true
        }
        states, count = measured['joint_states'], len(self._task.spec.robot.joints)
        if joints.velocity_noise:
            noise = self._normal[self._all, row, self._columns['velocity']]
            states[:, count + self._angles] += joints.velocity_noise * noise
        if self._moves_joint_readings:
            error = joints.noise * self._normal[self._all, row, self._columns['joint']]
            error += self._biases['joint']
            if joints.resolution:
                exact = states[:, self._angles] + error
                error += joints.resolution * np.round(exact / joints.resolution) - exact
            states[:, self._angles] += error
            for name, levers in self._levers.items():
                for number, lever in enumerate(levers):
                    start = 7 * number
                    measured[name][:, start : start + 3] += lever.displacement(error)
        for name, values in measured.items():
            self._held[name][ids] = values[ids]

    def _sense_object(self, ids: Ids, true: Readings, is_first: bool) -> None:
        names = [name for name in _OBJECT_TOPICS if name in true]
        if not names:
            return
        tracked, row = self.disturbances.object, self._tick % _BLOCK
        chance = self._uniform[self._all, row]
        if not is_first:
            self._lost = np.maximum(self._lost - 1, 0)
            self._lost[(chance[:, 3] < tracked.lost) & (self._lost == 0)] = _LOST_TICKS
        is_fresh = self._tick % np.maximum(self.variations['object_period'], 1) == 0
        is_fresh &= (chance[:, 4] >= tracked.stale) & (self._lost == 0)
        fresh = ids if is_first else ids[is_fresh[ids]]
        noise = self._normal[self._all, row, self._columns['object']]
        error = noise * np.repeat([tracked.noise, tracked.rotation_noise], 3)
        error = error + self._biases['object']
        for name in names:
            values = self._delayed(name, 'object_latency')
            if name != 'object_twist' and error.any():
                values[:, :3] += error[:, :3]
                values[:, 3:7] = _turned(values[:, 3:7], error[:, 3:])
            self._held[name][fresh] = values[fresh]

    # Copies

    def state(self) -> dict[str, Any]:
        """Return everything that decides the future, for `pickle` and `copy.deepcopy`."""
        return {name: getattr(self, name) for name in _STATE} | {'varied': self._physics.names}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state` returned."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._is_true_current = False
        for name in state['varied']:
            self._physics.allow(name)
        self._physics.restore(self._all)
        self._physics.apply(self._all, self.variations)


_STATE = (
    'variations',
    '_streams',
    '_tick',
    '_normal',
    '_uniform',
    '_biases',
    '_sent',
    '_applied',
    '_lost',
    '_true',
    '_held',
)


def _variation(name: str, value: Any) -> float:
    """Return the value of a variation, or raise a `ValueError` with the allowed range."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise ValueError(f'variation {name}={value!r:.40}; allowed: one finite number')
    if name != 'gravity_direction':
        group, field_name = _SPANS.get(name, ('physics', name))
        Disturbances.from_dict({group: {field_name: value}})
    return float(value)


def _turned(quaternion: Array, turn: Array) -> Array:
    """Turn quaternions (N, 4) wxyz by rotation vectors (N, 3), rad, world axes."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    rotation = np.concatenate([np.cos(angle / 2.0), np.sin(angle / 2.0) * axis], axis=1)
    return quaternion_multiply(rotation, quaternion)


class _Lever:
    """How far a site moves with the joints, to first order."""

    def __init__(self, task: Task, site_name: str) -> None:
        self._motion = SiteMotion(task, task.model.site(site_name).id)
        dofs = task.joint_dofs[np.array(task.spec.robot.joint_units) == 'rad']
        self._errors = np.flatnonzero(np.isin(dofs, self._motion.dofs))
        self._dofs = dofs[self._errors]

    def displacement(self, error: Array) -> Array:
        """Return the shift (N, 3), m, for errors (N, angles) of the joints, rad."""
        return self._motion.twist(self._dofs, error[:, self._errors])[0]


# Physics of single simulations, by the batch's own model fields

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
        self._body = first_body(task.model, (task.spec.object_name,))
        self._table = first_body(task.model, ('table0',))
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
            change: Callable[[Ids, Mapping[str, Array]], None] | None
            change = getattr(self, f'_vary_{name}', None)
            if change is not None:
                change(ids, variations)
            else:
                self._multiply(ids, variations[name], dict.fromkeys(_FIELDS[name]))
        return bool(self._names)

    def _multiply(
        self, ids: Ids, factors: Array, fields: Mapping[str, NDArray[np.integer] | None]
    ) -> None:
        """Multiply some rows of model fields, or all (None), by the factors (N,)."""
        for field, rows in fields.items():
            values = self._live[field]
            factor = factors[ids].reshape((-1,) + (1,) * (values.ndim - 1))
            values[ids if rows is None else np.ix_(ids, rows)] *= factor

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
        model = self._task.model
        geoms = np.flatnonzero(model.geom_bodyid == self._body)
        boxes = int(model.body_bvhadr[self._body]) + np.arange(int(model.body_bvhnum[self._body]))
        fields = dict.fromkeys(('geom_size', 'geom_rbound', 'geom_aabb'), geoms)
        self._multiply(ids, variations['object_size'], {**fields, 'bvh_aabb': boxes})

    def _vary_damping(self, ids: Ids, variations: Mapping[str, Array]) -> None:
        self._multiply(ids, variations['damping'], {'dof_damping': self._task.joint_dofs})

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


def first_body(model: mujoco.MjModel, names: tuple[str | None, ...]) -> int:
    """Return the number of the first of these bodies that the model has, or 0."""
    numbers = (find(model, mujoco.mjtObj.mjOBJ_BODY, str(name)) for name in names)
    return next((number for number in numbers if number > 0), 0)
