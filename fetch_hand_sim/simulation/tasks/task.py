"""What every task does on a batch of simulations: reset, command, step, observe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from fetch_hand_sim.simulation.engine import prepare_engine
from fetch_hand_sim.simulation.rewards import GoalMetric, RewardType, SuccessRule
from msgs_spec.observations import Readings, achieved_goal, observation, observed_topics
from msgs_spec.tasks import TaskSpec

Array = NDArray[np.float64]
Ids = NDArray[np.intp]
Generators = Sequence[np.random.Generator]


class Task(ABC):
    """One task on `num_envs` simulations.

    Subclasses fill in the physics of a family. All arrays have the simulation as leading axis.
    """

    def __init__(
        self,
        spec: TaskSpec,
        model: mujoco.MjModel,
        *,
        num_envs: int,
        num_threads: int,
        substeps: int,
    ) -> None:
        """Compiles the model and starts the batch.

        Args:
            spec: The task.
            model: Its compiled model.
            num_envs: Number of simulations.
            num_threads: Threads that step them; 0 for all processors.
            substeps: Physics steps per action.
        """
        prepare_engine()
        self.spec = spec
        self.substeps = substeps
        self.model = model
        self.tick_duration = substeps * float(model.opt.timestep)
        self.batch = Batch(model, num_envs, min(num_threads, num_envs) if num_threads else 0)
        self._qpos: Array = self.batch.bind('qpos')
        self._qvel: Array = self.batch.bind('qvel')
        self._actuator_force: Array = self.batch.bind('qfrc_actuator')
        joints = [model.joint(name) for name in spec.robot.joints]
        self._joint_qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._joint_dofs = np.array([int(joint.dofadr[0]) for joint in joints])
        # What reads the vectors (N, topic.size) of a topic; families add theirs.
        self._sensors: dict[str, Callable[[], Array]] = {'joint_states': self._joint_states}
        self._observed = observed_topics(spec)

    @property
    @abstractmethod
    def asset(self) -> str:
        """The MJCF asset that the model was compiled from."""

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
