"""What every task does on a batch of simulations: reset, command, step, observe."""

from __future__ import annotations

import inspect
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar
from weakref import WeakMethod

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from fetch_hand_sim.simulation.engine import keep_in_forks, prepare_engine
from fetch_hand_sim.simulation.model_tuning import ListedPairs
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array
from msgs_spec.observations import Readings, achieved_goal, observation, observed_topics
from msgs_spec.robots import command_from_action
from msgs_spec.tasks import RewardType, SuccessRule, TaskSpec, Timing
from msgs_spec.topics import sensor_topics

Ids = NDArray[np.intp]
Generators = Sequence[np.random.Generator]


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """How many simulations of a task, and how they are stepped.

    Attributes:
        num_envs: Number of simulations N.
        num_threads: Threads that step them; 0 for all processors that the process may use.
        substeps: Physics steps per action.
        keeps_data: Whether each simulation keeps an `MjData` of its own, so that all that MuJoCo
            computes can be read, at the cost of its memory.
        timing: What stays at another rate than 25 Hz.
    """

    num_envs: int = 1
    num_threads: int = 0
    substeps: int = 20
    keeps_data: bool = False
    timing: Timing = 'seconds'

    @property
    def threads(self) -> int:
        """Threads of the pool: never more than simulations."""
        return min(self.num_threads or _processors(), self.num_envs)


def _processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class PhysicsState:
    """All that the next tick and the next observation depend on.

    Attributes:
        rows: (N, state size), `mjSTATE_INTEGRATION` of each simulation.
        outputs: What MuJoCo derived in its last pass and the task reads, by the name in `MjData`,
            each (N, ...): after a step it is one substep older than the rows.
    """

    rows: Array
    outputs: dict[str, Array]


class Task(ABC):
    """One task on a batch of simulations.

    Subclasses fill in the physics of a family. All arrays have the simulation as leading axis.

    Args:
        spec: The task.
        model: Its compiled model.
        batch: How many simulations, and how they are stepped.

    Attributes:
        spec: The task as data.
        model: The compiled `mujoco.MjModel`; the batch steps with a copy.
        batch: The simulations.
        pairs: Whose contacts follow what is written into geoms.
        substeps: Physics steps per action.
        tick_duration: Simulated seconds per action.
        draws_goals: Whether `reset` draws goals; else they are zero until somebody sets them.
        start_state: (state size,) `mjSTATE_INTEGRATION` in which episodes start, before anything
            is drawn.
        ASSET: The MJCF asset, of a class whose tasks all have the same.
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
        self.substeps = batch.substeps
        self.draws_goals = True
        self.model = model
        self.tick_duration = batch.substeps * float(model.opt.timestep)
        self.batch = Batch(model, batch.num_envs, batch.threads, batch.keeps_data)
        keep_in_forks(self.batch)
        self.pairs = ListedPairs(model)
        self._outputs: dict[str, Array] = {}
        self._qpos: Array = self.batch.bind('qpos')
        self._qvel: Array = self.batch.bind('qvel')
        self._actuator_force = self.output('qfrc_actuator')
        joints = [_scalar_joint(spec, model, name) for name in spec.robot.joints]
        self._joint_qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._joint_dofs = np.array([int(joint.dofadr[0]) for joint in joints])
        # What reads the vectors (N, topic.size) of a topic; families add theirs.
        self._sensors: dict[str, Callable[[], Array]] = {'joint_states': weakly(self._joint_states)}
        self._observed = observed_topics(spec)

    @property
    def asset(self) -> str:
        """The MJCF asset that the model was compiled from."""
        return self.ASSET

    @abstractmethod
    def reset(self, ids: Ids, generators: Generators) -> Array:
        """Starts simulations `ids` again and samples their goals.

        Args:
            ids: Sorted simulation indices, (n,).
            generators: One generator per index; draws in the order of the reference.

        Returns:
            The desired goals, (n, goal size).
        """

    @abstractmethod
    def sample_goal(self, index: int, generator: np.random.Generator) -> Array:
        """Draws a goal (goal size,) for simulation `index` as it is now."""

    def sample_goals(self, ids: Ids, generators: Generators) -> Array:
        """Draws goals (n, goal size), one simulation after the other."""
        if not self.draws_goals:
            return np.zeros((ids.size, self.spec.goal.size))
        pairs = zip(ids.tolist(), generators, strict=True)
        return np.array([self.sample_goal(index, generator) for index, generator in pairs])

    def commands_from_actions(self, actions: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the commands of actions (N, action size) in [-1, 1]."""
        return command_from_action(self.spec.robot, actions)

    @abstractmethod
    def apply_commands(self, commands: NDArray[np.floating]) -> None:
        """Writes commands (N, action size), in command units and within limits, to the physics."""

    @abstractmethod
    def resting_commands(self) -> Array:
        """Returns the commands (N, action size) that change nothing about what the robots hold."""

    @abstractmethod
    def goal_metric(self, success_rule: SuccessRule, reward_type: RewardType) -> GoalMetric:
        """Returns the distances, success rule and reward of the task."""

    def step(self) -> None:
        """Advances all simulations by one tick under the commands applied last."""
        self.batch.step(nstep=self.substeps)

    def follow_model(self) -> None:
        """Steps with the model as it is, its time step included; contacts follow their geoms."""
        self.pairs.follow(self.model)
        self.batch.set_models(self.model)
        self.tick_duration = self.substeps * float(self.model.opt.timestep)

    def take_model(self, model: mujoco.MjModel, pairs: ListedPairs | None) -> None:
        """Steps with a model that was changed before.

        Args:
            model: The model.
            pairs: Its `pairs`; None where nobody knows: all of it is as it is meant, then.
        """
        self.batch.set_models(model)
        self.batch.get_model(0, self.model)
        if pairs is None:
            self.pairs.note(self.model)
        else:
            self.pairs = pairs
        self.follow_model()

    def output(self, name: str) -> Array:
        """Binds a derived field of `MjData`, (N, ...), live and read-only: `xpos`, `cdof`, ...

        Sensors of the model are off until somebody binds `sensordata`.
        """
        if name == 'sensordata':
            self.model.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_SENSOR.value
            self.batch.set_models(self.model)
        self._outputs[name] = self.batch.bind(name)
        return self._outputs[name]

    def add_sensor(self, name: str, function: Callable[[], Array]) -> None:
        """Says what a topic reads, in place of what said it before.

        Args:
            name: Of the topic, one of `msgs_spec.topics.sensor_topics`.
            function: Returns its vectors (N, topic.size) as they are now, a fresh array. A method
                of the task does not keep the task alive.

        Raises:
            ValueError: If the task has no such topic; the message lists those it has.
        """
        allowed = [topic.name for topic in sensor_topics(self.spec)]
        if name not in allowed:
            raise ValueError(
                f'{self.spec.name} has no sensor {name!r}; allowed: {", ".join(allowed)}'
            )
        is_own = inspect.ismethod(function) and function.__self__ is self
        self._sensors[name] = weakly(function) if is_own else function

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the topics that something says."""
        return tuple(self._sensors)

    def physics_state(self) -> PhysicsState:
        """Returns a copy of the state and of what was derived from it."""
        outputs = {name: values.copy() for name, values in self._outputs.items()}
        return PhysicsState(self.batch.state.copy(), outputs)

    def set_physics_state(self, state: PhysicsState) -> None:
        """Goes on from a state as `physics_state` gave it, to the same bits."""
        self.batch.state[:] = state.rows
        # Fills the data that simulations keep; its warm start is not theirs.
        self.batch.forward()
        self.batch.state[:] = state.rows
        for name in self._outputs:
            self._write_output(name, slice(None), state.outputs[name])

    def new_data(self, state: Array) -> mujoco.MjData:
        """Returns an `MjData` in a state (state size,), nothing derived from it yet."""
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
        return data

    def read_data(self, index: int, data: mujoco.MjData) -> None:
        """Writes simulation `index` into `data`; what is derived needs `keeps_data`."""
        self.batch.get_data(index, data)
        # Of a copy that has not stepped yet, what it keeps is newer than what the task reads.
        for name, values in self._outputs.items():
            getattr(data, name)[:] = values[index]

    def write_data(self, index: int, data: mujoco.MjData) -> None:
        """Lets simulation `index` go on from `data`, as if it had stepped that itself."""
        self.batch.state[index] = integration_state(self.model, data)
        for name in self._outputs:
            self._write_output(name, index, getattr(data, name))

    def _write_output(self, name: str, where: int | slice, values: Array) -> None:
        # Read-only since the next call overwrites it; until then it is what the task reads.
        output = self._outputs[name]
        output.flags.writeable = True
        output[where] = values
        output.flags.writeable = False

    def readings(self, names: Iterable[str] = ()) -> Readings:
        """Returns what the sensors say, fresh arrays.

        Args:
            names: Topics to read; none for all that the task has.
        """
        return {name: self._sensors[name]() for name in names or self._sensors}

    def observe(self) -> tuple[Array, Array]:
        """Returns the observations (N, observation size) and achieved goals (N, goal size)."""
        return self.observe_from(self.readings(self._observed))

    def observe_from(self, readings: Readings) -> tuple[Array, Array]:
        """Returns the same from what the sensors said."""
        goal = achieved_goal(self.spec, readings)
        return observation(self.spec, readings, self.tick_duration), goal

    def _joint_states(self) -> Array:
        """Positions, velocities and efforts of the robot's scalar joints, (N, 3 * joints)."""
        return np.concatenate(
            [
                self._qpos[:, self._joint_qpos],
                self._qvel[:, self._joint_dofs],
                self._actuator_force[:, self._joint_dofs],
            ],
            axis=1,
        )


def _scalar_joint(spec: TaskSpec, model: mujoco.MjModel, name: str) -> Any:
    """A joint of the robot in its model, which slides or turns about one axis.

    Raises:
        ValueError: If there is none of this name; the message lists those there are.
    """
    kinds = (mujoco.mjtJoint.mjJNT_SLIDE.value, mujoco.mjtJoint.mjJNT_HINGE.value)
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT.value, name)
    if number < 0 or model.jnt_type[number] not in kinds:
        known = [model.joint(n).name for n in range(model.njnt) if model.jnt_type[n] in kinds]
        raise ValueError(
            f'{spec.name}: the model has no hinge or slide joint {name!r}, which its robot names; '
            f'allowed: {", ".join(known) or "none"}'
        )
    return model.joint(number)


def weakly(sensor: Callable[[], Array]) -> Callable[[], Array]:
    """A method that does not keep its object alive, for an object that keeps the method.

    A task would else wait for the garbage collector, which does not see how large a batch is.
    """
    method = WeakMethod(sensor)

    def read() -> Array:
        bound = method()
        assert bound is not None, 'only the object itself calls it'
        return bound()

    return read


def integration_state(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Returns everything that decides a simulation's future, as `Batch.state` holds it."""
    spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    return state


def joint_qpos_slice(model: mujoco.MjModel, name: str) -> slice:
    """Where a free joint's seven coordinates lie in qpos."""
    address = int(model.joint(name).qposadr[0])
    return slice(address, address + 7)


def joint_qvel_slice(model: mujoco.MjModel, name: str) -> slice:
    """Where a free joint's six velocities lie in qvel."""
    address = int(model.joint(name).dofadr[0])
    return slice(address, address + 6)
