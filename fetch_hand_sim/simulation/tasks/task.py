"""Base class of the tasks: reset, command, step and observe a batch of simulations.

Also redirects MuJoCo's warnings, stops its timers and handles batches in forked processes.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco import mjtWarning
from mujoco.batch import Batch
from numpy.typing import NDArray

from fetch_hand_sim.simulation.models import ListedPairs, find, free_joint
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array
from msgs_spec.observations import Readings, achieved_goal, observation
from msgs_spec.robots import command_from_action
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    RewardType,
    SuccessRule,
    TaskSpec,
    Timing,
    substeps_per_tick,
)
from msgs_spec.topics import sensor_topics

_LOGGER = logging.getLogger(__name__)
# MuJoCo resets a simulation after one of these warnings.
_THROWN_AWAY = [
    mjtWarning.mjWARN_BADQPOS.value,
    mjtWarning.mjWARN_BADQVEL.value,
    mjtWarning.mjWARN_BADQACC.value,
]
_THREADED: weakref.WeakSet[Batch] = weakref.WeakSet()


@functools.cache
def prepare_engine() -> None:
    """Send MuJoCo's warnings to `logging` and stop its step timers; repeated calls do nothing.

    A warning handler that is already installed stays.
    """
    if mujoco.get_mju_user_warning() is None:
        # The default handler writes MUJOCO_LOG.TXT into the working directory.
        mujoco.set_mju_user_warning(_log_warning)
    _stop_timers()


def _log_warning(message: str) -> None:
    _LOGGER.debug('MuJoCo: %s', message)


def _stop_timers() -> None:
    """Remove the clock that the Python bindings install to fill `MjData.timer`.

    MuJoCo reads this clock about twenty times per substep, 4-7 % of the step time of these models.
    The bindings offer no way to switch it off. Trajectories do not depend on it.
    """
    for library in Path(mujoco.__file__).parent.glob('libmujoco*'):
        try:
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), 'mjcb_time')
        except (OSError, ValueError):
            continue
        clock.value = None


def _keep_batches() -> None:
    """Never free the batches with threads in a forked process, which does not have the threads."""
    for batch in _THREADED:
        # A list of them would be freed when the process ends.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))
    _THREADED.clear()


os.register_at_fork(after_in_child=_keep_batches)

Ids = NDArray[np.intp]
Generators = Sequence[np.random.Generator]


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """Size and settings of a batch of simulations.

    `num_threads` 0 uses all processors. With `keeps_data`, each simulation keeps an `MjData`.
    `timing` names the length of episodes that is kept at other rates than 25 Hz: `seconds` or
    `ticks`.
    """

    num_envs: int = 1
    num_threads: int = 0
    control_hz: float = DEFAULT_CONTROL_HZ
    keeps_data: bool = False
    timing: Timing = 'seconds'


class Task(ABC):
    """A batch of simulations of one task; the first axis of all arrays is the simulation.

    Attributes:
        model: The compiled `mujoco.MjModel`; the batch steps with a copy.
        pairs: The `<pair>` elements of the model; `follow_model` updates those of changed geoms.
        substeps: Physics steps per action.
        tick_duration: Simulated seconds per action.
        draws_goals: Whether `reset` draws goals; otherwise they are zero until the user sets them.
        start_state: (state size,) `mjSTATE_INTEGRATION` before start and goal are drawn.
        joint_qpos: Indices of the robot's joints in qpos, (joints,).
        joint_dofs: Indices of the robot's joints in qvel, (joints,).
        object_qpos: Slice of the object's free joint in qpos, 7 values; None without an object.
        object_qvel: Slice of the object's free joint in qvel, 6 values; None without an object.
        ASSET: MJCF asset, for classes whose tasks share one.
    """

    ASSET: ClassVar[str]
    start_state: Array

    def __init__(
        self,
        spec: TaskSpec,
        model: mujoco.MjModel,
        batch: BatchConfig,
    ) -> None:
        prepare_engine()
        self.spec = spec
        self.substeps = substeps_per_tick(batch.control_hz)
        self.draws_goals = True
        self.model = model
        self.tick_duration = self.substeps * float(model.opt.timestep)
        threads = min(batch.num_threads or len(os.sched_getaffinity(0)), batch.num_envs)
        self.batch = Batch(model, batch.num_envs, threads, batch.keeps_data)
        if threads > 1:
            _THREADED.add(self.batch)
        self.pairs = ListedPairs(model)
        self._outputs: dict[str, Array] = {}
        self._qpos: Array = self.batch.bind('qpos')
        self._qvel: Array = self.batch.bind('qvel')
        self._actuator_force = self.output('qfrc_actuator')
        joints = [_scalar_joint(spec, model, name) for name in spec.robot.joints]
        self.joint_qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self.joint_dofs = np.array([int(joint.dofadr[0]) for joint in joints])
        self.object_qpos: slice | None
        self.object_qvel: slice | None
        self.object_qpos, self.object_qvel = free_joint(model, spec.object_name)
        # Functions of the task that return the vectors (N, topic.size) of a topic. Methods are
        # stored unbound: a task that holds itself would only be freed by the garbage collector,
        # which underestimates the memory of a batch.
        self._sensors: dict[str, Callable[[Any], Array]] = {'joint_states': Task._joint_states}

    @property
    def asset(self) -> str:
        """Path, inside the assets, of the MJCF file that the model was compiled from."""
        return self.ASSET

    @abstractmethod
    def reset(self, ids: Ids, generators: Generators) -> Array:
        """Begin episodes of simulations `ids`; return their goals (n, goal size).

        Args:
            ids: Sorted simulation indices, (n,).
            generators: One per index; the order of draws is that of Gymnasium-Robotics.
        """

    @abstractmethod
    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draw a goal (goal size,) for the present state of simulation `index`."""

    def sample_goals(self, ids: Ids, generators: Generators) -> Array:
        """Draw goals (n, goal size) of `ids` in turn, or return zeros if `draws_goals` is False."""
        if not self.draws_goals:
            return np.zeros((ids.size, self.spec.goal.size))
        pairs = zip(ids.tolist(), generators, strict=True)
        return np.array([self.sample_goal(index, generator) for index, generator in pairs])

    def commands_from_actions(self, actions: NDArray[np.floating]) -> NDArray[np.floating]:
        """Map actions (N, action size) in [-1, 1] to commands of the same shape."""
        return command_from_action(self.spec.robot, actions)

    @abstractmethod
    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Set actuators or mocap targets from commands (N, action size), clipped by the caller."""

    @abstractmethod
    def resting_commands(self) -> Array:
        """Return the commands (N, action size) that keep the robots as they are."""

    def goal_metric(self, success_rule: SuccessRule, reward_type: RewardType) -> GoalMetric:
        """Return the metric of the task: distances, success and reward."""
        return GoalMetric(self.spec, success_rule, reward_type)

    def take_diverged(self) -> NDArray[np.bool_]:
        """Return flags (N,) of the simulations that diverged since the last call."""
        # The last axis is (last info, number).
        warning = self.batch.warning
        lost: NDArray[np.bool_] = (warning[:, _THROWN_AWAY, 1] > 0).any(axis=1)
        if lost.any():
            # MuJoCo throws its counters away with the state: each loss is number one again.
            warning[:, _THROWN_AWAY] = 0
        return lost

    def step(self) -> None:
        """Advance all simulations by one tick with the commands applied last."""
        self.batch.step(nstep=self.substeps)

    def follow_model(self) -> None:
        """Apply changes of `model` to the batch and `tick_duration`; update `<pair>` elements."""
        self.pairs.follow(self.model)
        self.batch.set_models(self.model)
        self.tick_duration = self.substeps * float(self.model.opt.timestep)

    def take_model(self, model: mujoco.MjModel, pairs: ListedPairs) -> None:
        """Copy `model` into `self.model`; use `pairs`, its `<pair>` elements, from now on."""
        self.batch.set_models(model)
        self.batch.get_model(0, self.model)
        self.pairs = pairs
        self.follow_model()

    def output(self, name: str) -> Array:
        """Return a read-only view (N, ...) of a derived field of `MjData`, such as `xpos`.

        Sensors of the model are disabled until `sensordata` is requested.
        """
        if name == 'sensordata':
            self.model.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_SENSOR.value
            self.batch.set_models(self.model)
        self._outputs[name] = self.batch.bind(name)
        return self._outputs[name]

    def add_sensor(self, name: str, function: Callable[[], Array]) -> None:
        """Set the function that measures a topic, or raise ValueError for another name.

        Args:
            name: One of `msgs_spec.topics.sensor_topics`.
            function: Returns the present vectors (N, topic.size) in a new array. A method of this
                task is stored without a reference to the task.
        """
        allowed = [topic.name for topic in sensor_topics(self.spec)]
        if name not in allowed:
            raise ValueError(
                f'{self.spec.name} has no sensor {name!r}; allowed: {", ".join(allowed)}'
            )
        method: Any = function
        is_own = getattr(method, '__self__', None) is self
        self._sensors[name] = method.__func__ if is_own else lambda _: function()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the measured topics."""
        return tuple(self._sensors)

    def physics_state(self) -> dict[str, Array]:
        """Return copies by name: `state` (N, state size), and derived fields requested by `output`.

        After a step, these derived fields (N, ...) are one substep older than the state.
        """
        outputs = {name: values.copy() for name, values in self._outputs.items()}
        return {'state': self.batch.state.copy(), **outputs}

    def set_physics_state(self, state: dict[str, Array]) -> None:
        """Restore a result of `physics_state`, bit for bit."""
        self.batch.state[:] = state['state']
        # Fills the `MjData` that simulations keep, but changes the warm start.
        self.batch.forward()
        self.batch.state[:] = state['state']
        for name in self._outputs:
            self._write_output(name, slice(None), state[name])

    def new_data(self, state: Array) -> mujoco.MjData:
        """Return a new `MjData` in a state (state size,); `mj_forward` adds the derived values."""
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
        return data

    def read_data(self, index: int, data: mujoco.MjData) -> None:
        """Copy the state of simulation `index` into `data`.

        With `keeps_data`, all values that MuJoCo derives from the state, such as contacts, are
        copied, too.
        """
        self.batch.get_data(index, data)
        # The `MjData` of a copy that has not stepped yet is newer than the task's outputs.
        for name, values in self._outputs.items():
            getattr(data, name)[:] = values[index]

    def write_data(self, index: int, data: mujoco.MjData) -> None:
        """Set the state and the derived fields of simulation `index` to those of `data`."""
        self.batch.state[index] = integration_state(self.model, data)
        for name in self._outputs:
            self._write_output(name, index, getattr(data, name))

    def _write_output(self, name: str, where: int | slice, values: Array) -> None:
        # Outputs are read-only for users, because the next step overwrites them.
        output = self._outputs[name]
        output.flags.writeable = True
        output[where] = values
        output.flags.writeable = False

    def readings(self, names: Iterable[str] = ()) -> Readings:
        """Return the present sensor readings of topics, by default of all, in new arrays."""
        return {name: self._sensors[name](self) for name in names or self._sensors}

    def observe(self) -> tuple[Array, Array]:
        """Return the observations (N, observation size) and achieved goals (N, goal size)."""
        return self.observe_from(self.readings(self.spec.observed_topics))

    def observe_from(self, readings: Readings) -> tuple[Array, Array]:
        """Return observations and achieved goals of sensor readings, with the same leading axes."""
        goal = achieved_goal(self.spec, readings)
        return observation(self.spec, readings, self.tick_duration), goal

    def _joint_states(self) -> Array:
        """Return all positions, then velocities, then efforts of the joints, (N, 3 * joints)."""
        return np.concatenate(
            [
                self._qpos[:, self.joint_qpos],
                self._qvel[:, self.joint_dofs],
                self._actuator_force[:, self.joint_dofs],
            ],
            axis=1,
        )


def _scalar_joint(spec: TaskSpec, model: mujoco.MjModel, name: str) -> Any:
    """Return `model.joint(name)`; raise ValueError unless it is a hinge or slide joint."""
    kinds = (mujoco.mjtJoint.mjJNT_SLIDE.value, mujoco.mjtJoint.mjJNT_HINGE.value)
    number = find(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if number < 0 or model.jnt_type[number] not in kinds:
        known = [model.joint(n).name for n in range(model.njnt) if model.jnt_type[n] in kinds]
        raise ValueError(
            f'{spec.name}: the model has no hinge or slide joint {name!r}, which its robot names; '
            f'allowed: {", ".join(known) or "none"}'
        )
    return model.joint(number)


def integration_state(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Return the state `mjSTATE_INTEGRATION` of `data`, the format of the rows of `Batch.state`."""
    spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    return state


class SiteMotion:
    """Computes the velocity of a site from joint velocities and the last computed Jacobian."""

    def __init__(self, task: Task, site: int) -> None:
        model, body = task.model, int(task.model.site_bodyid[site])
        self._position: Array = task.output('site_xpos')[:, site]
        self._center = task.output('subtree_com')[:, int(model.body_rootid[body])]
        self._cdof = task.output('cdof')
        dofs: list[int] = []
        while body:
            first, count = int(model.body_dofadr[body]), int(model.body_dofnum[body])
            dofs.extend(range(first, first + count))
            body = int(model.body_parentid[body])
        # Degrees of freedom that move the site, ascending.
        self.dofs = np.array(sorted(dofs), dtype=np.intp)

    def twist(self, dofs: NDArray[np.intp], velocity: Array) -> tuple[Array, Array]:
        """Return linear and angular world velocity, (N, 3) each: `mj_jacSite` times `velocity`.

        The sum has a fixed order, so batches of any size give the same bits.

        Args:
            dofs: Indices of degrees of freedom that move the site, (n,).
            velocity: Velocities of these degrees of freedom, (N, n).
        """
        spatial = (self._cdof[:, dofs] * velocity[:, :, None]).sum(axis=1)
        angular, lever = spatial[:, :3], self._position - self._center
        # `np.cross` gives the same bits, but takes longer.
        moment = angular[:, [1, 2, 0]] * lever[:, [2, 0, 1]]
        moment -= angular[:, [2, 0, 1]] * lever[:, [1, 2, 0]]
        return spatial[:, 3:] + moment, angular
