"""Apply `Disturbances` to a batch: commands, physics, pushes, start states and sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
# Seconds after which lost tracking comes back.
_LOST_SECONDS = 0.5
_PHYSICS = [each.name for each in fields(PhysicsDisturbance)]
# Group and field of each range from which an episode draws once.
_SPANS = {
    'action_latency': ('action', 'latency'),
    'joint_latency': ('joints', 'latency'),
    'object_latency': ('object', 'latency'),
    'object_period': ('object', 'period'),
    **{name: ('physics', name) for name in _PHYSICS if name != 'gravity_tilt'},
    'gravity_tilt': ('physics', 'gravity_tilt'),
}
# In the order in which an episode draws them.
VARIATIONS = (*_SPANS, 'gravity_direction')
# Topics with poses of sites, which are computed from the joint sensors.
_LED = {
    'end_effector_pose': ('robot0:grip',),
    'fingertip_poses': tuple(f'robot0:S_{name}' for name in FINGERTIPS),
}
_OBJECT_TOPICS = ('object_pose', 'object_twist', 'object_joint')


class Disturber:
    """Applies disturbances to N simulations of one task.

    Each episode has a random generator for its disturbances. Its numbers follow from the seed of
    the episode, and do not change the draws of start and goal.

    Attributes:
        variations: Values in the running episodes, (N,) each, such as a factor on friction or a
            latency in ticks, by the names in `VARIATIONS`.
    """

    def __init__(self, task: Task, disturbances: Disturbances) -> None:
        self.disturbances = disturbances
        self._task = task
        count, size = task.batch.nsim, task.spec.robot.action_size
        self._all = np.arange(count)
        self.variations = {name: np.zeros(count) for name in VARIATIONS}
        is_angle = np.array([unit == 'rad' for unit in task.spec.robot.joint_units])
        self._angles = np.flatnonzero(is_angle)
        angle_dofs = task.joint_dofs[self._angles]
        # The white noise and the bias of everything that has errors, side by side.
        widths = {'action': size, 'joint': angle_dofs.size, 'velocity': angle_dofs.size}
        widths |= {'object': 6, 'push': 3}
        ends = np.cumsum(list(widths.values())).tolist()
        self._columns = {
            name: slice(end - width, end)
            for (name, width), end in zip(widths.items(), ends, strict=True)
        }
        self._bias_sizes = np.zeros(ends[-1])
        self._bias_sizes[self._columns['action']] = disturbances.action.bias
        self._bias_sizes[self._columns['joint']] = disturbances.joints.bias
        tracked = disturbances.object
        self._bias_sizes[self._columns['object']] = np.repeat(
            [tracked.bias, tracked.rotation_bias], 3
        )
        self._streams: list[np.random.Generator | None] = [None] * count
        self._tick = np.zeros(count, np.int64)
        self._normal = np.zeros((count, _BLOCK, ends[-1]))
        self._uniform = np.zeros((count, _BLOCK, 5))
        self._biases = np.zeros((count, ends[-1]))
        self._start_shift = np.zeros((count, 2))
        self._start_joints = np.zeros((count, angle_dofs.size))
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
        joints = disturbances.joints
        self._moves_joint_readings = bool(joints.noise or joints.bias or joints.resolution)
        # Of each topic the motion of each site, the joints that move it and their velocities.
        self._levers: dict[str, list[tuple[SiteMotion, Ids, Ids]]] = {}
        for name, sites in _LED.items():
            if name in task.sensors and self._moves_joint_readings:
                motions = [SiteMotion(task, task.model.site(site).id) for site in sites]
                moving = [np.flatnonzero(np.isin(angle_dofs, each.dofs)) for each in motions]
                self._levers[name] = [
                    (motion, joints, angle_dofs[joints])
                    for motion, joints in zip(motions, moving, strict=True)
                ]

    # Episodes

    def allow(self, given: Mapping[str, Any]) -> dict[str, float]:
        """Check variations that a user sets for an episode; return their values by name.

        To vary physics, every simulation gets its own copies of the model fields.

        Raises:
            ValueError: If a name or value is not allowed.
        """
        named = entries('variation', given, VARIATIONS)
        wanted = {name: _variation(name, value) for name, value in named.items()}
        for name in wanted.keys() & set(_PHYSICS):
            self._physics.allow(name)
        return wanted

    @property
    def varies_physics(self) -> bool:
        """True if the physics of a simulation may differ from `task.model`."""
        return bool(self._physics.names)

    def start_nominal(self, ids: Ids) -> None:
        """Undo variations of physics in simulations `ids`; call it before a start is drawn."""
        self._physics.restore(ids)

    def start(
        self,
        ids: Ids,
        streams: Sequence[np.random.Generator],
        given: Mapping[int, Mapping[str, float]],
    ) -> None:
        """Draw and apply the disturbances of new episodes whose start state the task has set.

        Args:
            ids: The simulations, (n,).
            streams: A random generator for each of them.
            given: Values in place of drawn ones, by simulation index and name of the variation.
        """
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
        scatter = stream.standard_normal(self._bias_sizes.size + 6)
        # The bias of the object is drawn last.
        scatter[self._columns['object']] = scatter[-6:]
        self._biases[index] = self._bias_sizes * scatter[:-6]
        self._start_shift[index] = stream.uniform(-1.0, 1.0, 2)
        self._start_joints[index] = stream.standard_normal(self._angles.size)

    def _drawn(self, name: str, share: float) -> float:
        """Return a value in the range of a variation: lowest for `share` 0, highest for 1."""
        if name == 'gravity_direction':
            return share * 2.0 * np.pi
        group, field_name = _SPANS[name]
        values = getattr(self.disturbances, group)
        kind = next(each.metadata['kind'] for each in fields(values) if each.name == field_name)
        value = getattr(values, field_name)
        return float(kind.drawn(value if kind.is_range else (0.0, value), share))

    def _draw_block(self, index: int) -> None:
        stream = self._streams[index]
        assert stream is not None, 'every episode has begun'
        self._normal[index] = stream.standard_normal(self._normal.shape[1:])
        self._uniform[index] = stream.random(self._uniform.shape[1:])

    def _shift_start(self, ids: Ids) -> bool:
        """Shift objects and joints in `ids`, whose episodes start; return whether any has moved."""
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
        """Start a tick; return the disturbed commands (N, action size), in the same units."""
        self._tick += 1
        for index in np.flatnonzero(self._tick % _BLOCK == 0).tolist():
            self._draw_block(index)
        action = self.disturbances.action
        self._sent = np.roll(self._sent, 1, axis=0)
        self._sent[0] = commands
        delay = self.variations['action_latency'].astype(np.intp)
        arrived = self._sent[delay, self._all]
        kept = self._applied
        dropped = np.zeros_like(kept) if self._task.spec.robot.has_gripper_command else kept
        arrived = np.where((self._chance(0) < action.drop)[:, None], dropped, arrived)
        self._applied = np.where((self._chance(1) < action.repeat)[:, None], kept, arrived)
        moved = self._error('action', action.noise)
        if not moved.any():
            return self._applied.astype(commands.dtype)
        half = (self._upper - self._lower) / 2.0
        disturbed = np.clip(self._applied + half * moved, self._lower, self._upper)
        return disturbed.astype(commands.dtype)

    def _chance(self, number: int) -> Array:
        """Return random numbers (N,) of this tick, uniform in [0, 1), for a kind of random event.

        `number` is the event: 0 lost command, 1 repeated command, 2 push, 3 lost tracking of the
        object, 4 missing measurement of the object.
        """
        return np.asarray(self._uniform[self._all, self._tick % _BLOCK, number])

    def _error(self, name: str, noise: float | Array) -> Array:
        """Return the error of signal `name` at this tick, (N, components): bias plus white noise.

        `name` is `action`, `joint`, `velocity`, `object` or `push`. `noise`, the standard deviation
        of the white noise, is one value or one for each component, in the unit of the signal.
        """
        columns = self._columns[name]
        white = self._normal[self._all, self._tick % _BLOCK, columns]
        return np.asarray(noise * white + self._biases[:, columns])

    def push(self, forces: Array) -> bool:
        """Add pushes in world axes to `forces` (N, bodies, 6) in place; return True if any acts."""
        pushes = self.disturbances.pushes
        if not pushes.force:
            return False
        pushed = self._chance(2) < pushes.rate * self._task.tick_duration
        force = self._error('push', pushes.force * self._weight)
        forces[pushed, self._pushed_body, :3] += force[pushed]
        return bool(pushed.any())

    # Sensors

    def sense(self) -> None:
        """Measure all sensors with errors and delays, once per tick; `readings` returns them."""
        self._sense(self._all, is_first=False)

    def readings(self) -> Readings:
        """Return the last measurements of the disturbed sensors, in new arrays."""
        return {name: values.copy() for name, values in self._held.items()}

    def true_readings(self) -> Readings:
        """Return what sensors without disturbances measure in the present state, in new arrays."""
        if not self._is_true_current:
            return self._task.readings()
        return {name: past[0].copy() for name, past in self._true.items()}

    def note_written_state(self) -> None:
        """Make `true_readings` measure again; call it after the user has changed the state."""
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

    def _delayed(self, name: str, latency: str) -> Array:
        return self._true[name][self.variations[latency].astype(np.intp), self._all]

    def _sense_joints(self, ids: Ids, true: Readings) -> None:
        joints = self.disturbances.joints
        measured = {
            name: self._delayed(name, 'joint_latency')
            for name in true
            if name not in _OBJECT_TOPICS
        }
        states, count = measured['joint_states'], len(self._task.spec.robot.joints)
        if joints.velocity_noise:
            states[:, count + self._angles] += self._error('velocity', joints.velocity_noise)
        if self._moves_joint_readings:
            error = self._error('joint', joints.noise)
            if joints.resolution:
                exact = states[:, self._angles] + error
                error += joints.resolution * np.round(exact / joints.resolution) - exact
            states[:, self._angles] += error
            for name, levers in self._levers.items():
                for number, (motion, moving, dofs) in enumerate(levers):
                    start = 7 * number
                    shift, _ = motion.twist(dofs, error[:, moving])
                    measured[name][:, start : start + 3] += shift
        for name, values in measured.items():
            self._held[name][ids] = values[ids]

    def _sense_object(self, ids: Ids, true: Readings, is_first: bool) -> None:
        names = [name for name in _OBJECT_TOPICS if name in true]
        if not names:
            return
        tracked = self.disturbances.object
        if not is_first:
            self._lost = np.maximum(self._lost - 1, 0)
            lost_ticks = round(_LOST_SECONDS / self._task.tick_duration)
            self._lost[(self._chance(3) < tracked.lost) & (self._lost == 0)] = lost_ticks
        is_fresh = self._tick % np.maximum(self.variations['object_period'], 1) == 0
        is_fresh &= (self._chance(4) >= tracked.stale) & (self._lost == 0)
        fresh = ids if is_first else ids[is_fresh[ids]]
        error = self._error('object', np.repeat([tracked.noise, tracked.rotation_noise], 3))
        for name in names:
            values = self._delayed(name, 'object_latency')
            if name != 'object_twist' and error.any():
                values[:, :3] += error[:, :3]
                values[:, 3:7] = _turned(values[:, 3:7], error[:, 3:])
            self._held[name][fresh] = values[fresh]

    # Copies

    def state(self) -> dict[str, Any]:
        """Return the complete state for `pickle` and `copy.deepcopy`; its arrays are not copied."""
        return {name: getattr(self, name) for name in _STATE} | {'varied': self._physics.names}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state that `state` returned."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._is_true_current = False
        for name in state['varied']:
            self._physics.allow(name)
        self._physics.restore(self._all)
        self._physics.apply(self._all, self.variations)


_STATE = (
    *('variations', '_streams', '_tick', '_normal', '_uniform', '_biases'),
    *('_sent', '_applied', '_lost', '_true', '_held'),
)


def _variation(name: str, value: Any) -> float:
    """Return the value of a variation as a float; raise ValueError if it is not allowed."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise ValueError(f'variation {name}={value!r:.40}; allowed: one finite number')
    if name != 'gravity_direction':
        group, field_name = _SPANS[name]
        Disturbances.from_dict({group: {field_name: value}})
    return float(value)


def _turned(quaternion: Array, turn: Array) -> Array:
    """Rotate quaternions (N, 4) wxyz by rotation vectors (N, 3), rad, in world axes."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    rotation = np.concatenate([np.cos(angle / 2.0), np.sin(angle / 2.0) * axis], axis=1)
    return quaternion_multiply(rotation, quaternion)


# Physics of single simulations, by the batch's own model fields


class VariedPhysics:
    """Gives each simulation its own copies of model fields such as friction, and varies them.

    Attributes:
        names: The variations that `apply` uses.
    """

    def __init__(self, task: Task, physics: PhysicsDisturbance) -> None:
        self._task = task
        model, body = task.model, first_body(task.model, (task.spec.object_name,))
        table = first_body(model, ('table0',))
        is_hand = not task.spec.robot.has_gripper_command
        # Model fields that each variation changes, and their rows; empty if the task lacks them.
        self._rows: dict[str, dict[str, Any]] = {
            'friction': {'geom_friction': range(model.ngeom), 'pair_friction': range(model.npair)},
            'object_mass': {},
            'object_size': {},
            'gain': dict.fromkeys(('actuator_gainprm', 'actuator_biasprm'), range(model.nu)),
            'force_limit': {'actuator_forcerange': range(model.nu)},
            'damping': {'dof_damping': task.joint_dofs.tolist()} if is_hand else {},
            'gravity_tilt': {'opt.gravity': range(3)},
            'table_height': {'body_pos': [table]} if table else {},
        }
        if body:
            first, boxes = int(model.body_dofadr[body]), int(model.body_bvhadr[body])
            self._rows['object_mass'] = {
                'body_mass': [body],
                'body_inertia': [body],
                'body_subtreemass': [0, body],
                'body_invweight0': [body],
                'dof_invweight0': range(first, first + 6),
            }
            geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
            self._rows['object_size'] = {
                **dict.fromkeys(('geom_size', 'geom_rbound', 'geom_aabb'), geoms),
                'bvh_aabb': range(boxes, boxes + int(model.body_bvhnum[body])),
            }
        self._live: dict[str, Array] = {}
        self._nominal: dict[str, Array] = {}
        self.names: list[str] = []
        for each in fields(physics):
            # A preset names what some tasks lack; it is then left out.
            if getattr(physics, each.name) != each.default and self._has(each.name):
                self.allow(each.name)

    def _has(self, name: str) -> bool:
        return any(len(rows) for rows in self._rows[name].values())

    def allow(self, name: str) -> None:
        """Add a variation to `names`; ValueError if the task lacks it or the model was shared."""
        if name in self.names:
            return
        if not self._has(name):
            raise ValueError(f'{self._task.spec.name} has no {name} to vary')
        for field in self._rows[name].keys() - self._live.keys():
            try:
                self._live[field] = self._task.batch.expand(field)
            except mujoco.FatalError:
                raise ValueError(
                    f'{name} cannot vary after the model was shared or changed; vary it by the '
                    'disturbances with which the simulation is made'
                ) from None
            self._nominal[field] = self._live[field][0].copy()
        self.names.append(name)

    def restore(self, ids: Ids) -> None:
        """Undo all variations in the simulations `ids`."""
        for field, values in self._live.items():
            values[ids] = self._nominal[field]

    def apply(self, ids: Ids, variations: Mapping[str, Array]) -> bool:
        """Vary the physics of simulations `ids` by `variations`, (N,) each; call `restore` first.

        Return False if `names` is empty, so that nothing varies.
        """
        for name in self.names:
            factors, live = variations[name][ids], self._live
            for field, rows in self._rows[name].items():
                values, places = live[field], np.ix_(ids, rows)
                factor = factors.reshape((-1,) + (1,) * (values.ndim - 1))
                if field == 'opt.gravity':
                    values[ids] = self._tilted(factors, variations['gravity_direction'][ids])
                elif field == 'body_pos':
                    values[ids, rows[0], 2] += factors
                elif field == 'body_subtreemass':
                    values[places] += (factor - 1.0) * self._nominal['body_mass'][rows[1]]
                elif field.endswith('invweight0'):
                    # `mj_setConst` derives these for a free body.
                    values[places] /= factor
                else:
                    values[places] *= factor
        return bool(self.names)

    def _tilted(self, tilt: Array, direction: Array) -> Array:
        """Return gravity (n, 3), m/s^2, tilted by `tilt` towards azimuth `direction`, both rad."""
        strength = float(np.linalg.norm(self._nominal['opt.gravity']))
        across = np.sin(tilt) * strength
        return np.stack(
            [across * np.cos(direction), across * np.sin(direction), -np.cos(tilt) * strength],
            axis=1,
        )


def first_body(model: mujoco.MjModel, names: tuple[str | None, ...]) -> int:
    """Return the index of the first body of `names` that the model has, or 0 if it has none."""
    numbers = (find(model, mujoco.mjtObj.mjOBJ_BODY, str(name)) for name in names)
    return next((number for number in numbers if number > 0), 0)
