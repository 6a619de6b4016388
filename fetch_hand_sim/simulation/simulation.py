"""`Simulation`: any number of copies of one task, stepped together.

The ROS node and `gymnasium.make` use one copy, the trainer 64 and more. A `Simulation` does not
count steps and never ends an episode; the calling code does. `_start` begins episodes, `_advance`
applies commands and steps, `observe` measures.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from mujoco.batch import SimulationError
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation.arguments import (
    Seeds,
    StartState,
    each_of,
    finite_numbers,
    generators,
    nearest_quaternions,
    read_start,
    require_whole,
    selected_simulations,
)
from fetch_hand_sim.simulation.disturber import Disturber
from fetch_hand_sim.simulation.models import asset_path, find
from fetch_hand_sim.simulation.tasks import make_task
from fetch_hand_sim.simulation.tasks.task import BatchConfig
from msgs_spec.arrays import Array
from msgs_spec.disturbances import Disturbances, read_disturbances
from msgs_spec.observations import Readings, achieved_goal
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    TIMINGS,
    GoalKind,
    RewardType,
    SuccessRule,
    Timing,
)
from msgs_spec.text import one_line, one_of

Observation = dict[str, Array]
# One mapping for all simulations, or one or None for each.
EachGiven = Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None
_Read = TypeVar('_Read')

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StepResult:
    """Result of one step of N simulations, in new arrays.

    Attributes:
        observation: `observation`, `achieved_goal`, `desired_goal`, each (N, ...).
        reward: (N,), sparse -1 or 0; dense -distance (m), poses -(10 x distance + rotation (rad)).
        success: (N,) booleans, at this step.
        diverged: (N,) booleans: MuJoCo diverged and the simulation was reset. Observation, reward
            and success are then those of the new episode.
    """

    observation: Observation
    reward: Array
    success: NDArray[np.bool_]
    diverged: NDArray[np.bool_]


class Simulation:
    """N copies of one task on a pool of threads; pickles and copies include the state.

    Call `reset` before `step`. A forked process has no worker threads: a batch with several threads
    raises an error there, but a deep copy of it works.

    Args:
        task: One of the tasks (`msgs_spec.tasks.TASKS`).
        num_envs: Number of copies N, 1 or more.
        num_threads: Threads that step the copies, at most N; 0 for one per processor that the
            process may use (`taskset`, `os.sched_setaffinity`).
        reward_type: `sparse` or `dense`.
        success_rule: `gymnasium` (as in the released code) or `paper` (as in the text of Plappert
            et al. 2018).
        control_hz: Actions per simulated second: 500/n for n = 1 ... 40.
        keeps_data: Whether each copy keeps its own `MjData`; `read_data` then includes all values
            that MuJoCo derives from the state.
        timing: What stays the same at rates other than 25 Hz. `seconds`: the duration of an episode
            and the speed of the Fetch gripper. `ticks`: the steps of an episode and the gripper's
            distance per step, as in Gymnasium-Robotics.
        disturbances: Delays, noise and changed physics, in any form that
            `msgs_spec.disturbances.read_disturbances` accepts. `observation` then contains the
            measurements of disturbed sensors; `achieved_goal`, rewards and success follow the true
            state.

    Attributes:
        task: The `Task`, which computes the physics.
        spec: The task as data, with `episode_ticks` at this rate.
        metric: `GoalMetric` for rewards and success; users may replace it between steps.
        divergences: Number of divergences of all copies so far.

    Raises:
        ValueError: If an argument is not allowed; the message lists the allowed values.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        num_threads: int = 0,
        reward_type: RewardType = 'sparse',
        success_rule: SuccessRule = 'gymnasium',
        control_hz: float = DEFAULT_CONTROL_HZ,
        keeps_data: bool = False,
        timing: Timing = 'seconds',
        disturbances: Disturbances | Mapping[str, Any] | str | None = None,
    ) -> None:
        require_whole('num_envs', num_envs, lowest=1)
        require_whole('num_threads', num_threads)
        if not isinstance(keeps_data, bool):
            raise ValueError(f'keeps_data {keeps_data!r:.60}; allowed: True or False')
        one_of(timing, TIMINGS, 'timing')
        self._batch = BatchConfig(num_envs, num_threads, control_hz, keeps_data, timing)
        self.task = make_task(task, self._batch)
        self._model_may_change = False
        self.spec = self.task.spec
        self.num_envs = num_envs
        self.control_hz = control_hz
        self.timing = timing
        self.metric = self.task.goal_metric(success_rule, reward_type)
        self.divergences = 0
        self.goals = np.zeros((num_envs, self.spec.goal.size))
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._all = np.arange(num_envs)
        self._is_pushed = False
        self._is_started = np.zeros(num_envs, dtype=np.bool_)
        self._process = os.getpid()
        self._disturber: Disturber | None = None
        self.disturbances = disturbances

    def __repr__(self) -> str:
        """Return the class, the task and the number of copies as text."""
        return f'{type(self).__name__}({self.spec.name!r}, num_envs={self.num_envs})'

    @property
    def goals(self) -> Array:
        """The desired goals, (N, goal size); values written here take effect in the next step.

        World frame; points and fingertips in m, poses in m and as quaternion wxyz.
        """
        return self._goals

    @goals.setter
    def goals(self, goals: ArrayLike) -> None:
        shape = (self.num_envs, self.spec.goal.size)
        wanted = finite_numbers(f'goals of {self.spec.name}', goals, shape)
        self._goals = wanted.astype(np.float64, copy=False)

    @property
    def model(self) -> Any:
        """The compiled `mujoco.MjModel`; call `apply_model_changes` after writing into it."""
        return self.task.model

    @property
    def asset(self) -> Path:
        """The MJCF file of the model."""
        return asset_path(self.task.asset)

    @property
    def is_started(self) -> NDArray[np.bool_]:
        """Flags (N,), True for simulations that have been reset."""
        return self._is_started.copy()

    @property
    def tick_duration(self) -> float:
        """Simulated seconds per step."""
        return self.task.tick_duration

    def data(self, index: int) -> Any:
        """Return a copy of simulation `index` as a `mujoco.MjData`, to render or inspect."""
        return self.task.batch.get_data(self._index(index))

    def read_data(self, index: int, data: Any) -> None:
        """Copy the state of simulation `index` into a `mujoco.MjData`.

        With `keeps_data`, all values that MuJoCo derives from the state, such as contacts, are
        copied, too. Goals, random generators and divergence counters are no part of `MjData`.
        """
        self.task.read_data(self._index(index), self._fitting(data))

    def write_data(self, index: int, data: Any) -> None:
        """Set state and derived values of simulation `index` to those of a `mujoco.MjData`."""
        self.task.write_data(self._index(index), self._fitting(data))
        if self._disturber is not None:
            self._disturber.note_written_state()

    def apply_model_changes(self) -> None:
        """Use the changed `model` from now on; ValueError if disturbances vary the physics."""
        if self.varies_physics:
            raise ValueError(
                f'the model of {self.spec.name} cannot be changed while disturbances vary its '
                'physics; leave out the group physics'
            )
        self._model_may_change = True
        self.task.follow_model()

    def generator(self, index: int) -> np.random.Generator:
        """Return the random generator itself that draws starts and goals of simulation `index`."""
        generator = self._generators[self._index(index)]
        if generator is None:
            generator = self._generators[index] = seeding.np_random(None)[0]
        return generator

    def reset(
        self,
        seed: Seeds = None,
        ids: ArrayLike | None = None,
        variation: EachGiven = None,
        start: EachGiven = None,
        goal: ArrayLike | Sequence[ArrayLike | None] | None = None,
    ) -> Observation:
        """Start new episodes.

        Args:
            seed: One seed (simulation i takes seed + i), one per simulation of `ids` in their
                order, or None to continue the random generators. The same seed gives the same
                draws as in Gymnasium-Robotics. A random generator in place of a seed replaces
                that of the simulation.
            ids: Indices or a boolean mask (N,) of the simulations; None for all.
            variation: Values for these episodes in place of drawn ones, by the names of
                `Simulation.variation`; for simulations with `disturbances`. One mapping for all, or
                one or None for each simulation of `ids`.
            start: Start states in place of drawn ones: one mapping for all, or one or None for each
                simulation of `ids`. Its keys are some of `joints`, `joint_velocities` (numbers by
                name, or all in the order of `joint_states`; rad or m, per second), `object_pose`
                (7,), m and quaternion wxyz, and, only with a pose, `object_velocity` (6,), linear
                m/s and angular rad/s, both world. Joints and objects with a given position start at
                rest unless a velocity is given, too. `disturbances` may shift the start.
            goal: Desired goals in place of drawn ones, as `set_goal` takes them: (goal size,) for
                all, or one or None for each simulation of `ids`. Drawn starts stay the same.

        Returns:
            The observations of all N simulations.

        Raises:
            ValueError: If a seed is invalid, ids or seeds do not match the simulations, or a
                variation, start or goal is unknown or impossible. No simulation is reset then.
            RuntimeError: If the object never stays on the palm, or this process was forked and
                lacks the threads of the batch.
        """
        selected = self._select(ids)
        variations = self._each_given('variation', variation, selected, self._allowed_variation)
        starts = self._each_given(
            'start', start, selected, lambda each: read_start(each, self.task)
        )
        goals = self._each_given('goal', goal, selected, self._read_goal)
        fresh = generators(seed, selected)
        for index, generator in zip(selected.tolist(), fresh, strict=True):
            self._generators[index] = generator or self._generators[index]
        if selected.size:
            self._start(np.sort(selected), variations, starts)
        if goals:
            self.set_goal(list(goals.values()), list(goals))
        return self.observe()

    def step(self, actions: ArrayLike) -> StepResult:
        """Advance every simulation by one step.

        Args:
            actions: (N, action size) in [-1, 1], float32 or float64.

        Raises:
            ValueError: If the shape is wrong, or a value is not finite or out of range; the state
                is unchanged then.
            gymnasium.error.ResetNeeded: If a simulation has never been reset.
            RuntimeError: If this process was forked and lacks the threads of the batch.
        """
        checked = self._finite('actions', actions)
        if checked.size and (np.abs(checked) > 1.0).any():
            env, part = np.argwhere(np.abs(checked) > 1.0)[0].tolist()
            raise ValueError(
                f'actions[{env}, {part}] is {checked[env, part]}; allowed: numbers in [-1, 1]'
            )
        return self._result(self._advance(self.task.commands_from_actions(checked)))

    def step_commands(self, commands: ArrayLike) -> StepResult:
        """Advance every simulation by one step, with commands in ROS units; see `step`.

        Args:
            commands: (N, action size), already clipped by `msgs_spec.robots.clip_command`; this
                method does not clip. Fetch: as actions. Hand: absolute joint positions in radians.
        """
        return self._result(self.advance(commands))

    def advance(self, commands: ArrayLike) -> NDArray[np.bool_]:
        """Advance as `step_commands` does, but return only flags (N,) of diverged simulations."""
        return self._advance(self._finite('commands', commands))

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Array:
        """Return rewards (...,) for achieved and desired goals (..., goal size) of any batch shape.

        `info` is ignored; it is part of Gymnasium's interface.
        """
        return self.metric.reward(achieved_goal, desired_goal, info)

    def compute_success(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike
    ) -> NDArray[np.bool_]:
        """Return success (...,) for goals (..., goal size), as `compute_reward` takes them."""
        return self.metric.success(achieved_goal, desired_goal)

    def set_goal(self, goals: ArrayLike, ids: ArrayLike | None = None) -> None:
        """Replace desired goals; ValueError if a shape or value is invalid.

        Quaternions are normalised and moved to the hemisphere nearest to the object's quaternion,
        because the `gymnasium` success rule distinguishes q from -q.

        Args:
            goals: (n, goal size), finite, in the order of `ids`; units and frame as in `goals`.
            ids: The n simulations; None for all.
        """
        selected = self._select(ids)
        shape = (selected.size, self.spec.goal.size)
        wanted = np.array(finite_numbers(f'goals of {self.spec.name}', goals, shape), np.float64)
        if self.spec.goal is GoalKind.POSE:
            wanted = nearest_quaternions(wanted, self.task.observe()[1][selected])
        self.goals[selected] = wanted

    def perturb(self, body: str, wrench: ArrayLike, index: int = 0) -> None:
        """Push a body of one simulation during the next step; ValueError for an invalid argument.

        Args:
            body: Name of a movable body of the model.
            wrench: (6,) force in N and torque in N m, world axes, at the centre of mass; it
                replaces an earlier one.
            index: The simulation.
        """
        values = finite_numbers('wrench', wrench, (6,))
        # MuJoCo crashes if the name is not text.
        number = find(self.model, mujoco.mjtObj.mjOBJ_BODY, str(body))
        if number < 1 or not self.model.body_weldid[number]:
            raise ValueError(f'no body {one_line(body, 40)!r} that can move')
        self._pushes[self._index(index), number] = values
        self._is_pushed = True

    def resting_commands(self) -> Array:
        """Return the commands (N, action size) that leave the robots' present targets unchanged."""
        return self.task.resting_commands()

    @property
    def disturbances(self) -> Disturbances:
        """The disturbances; off by default."""
        return Disturbances() if self._disturber is None else self._disturber.disturbances

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances | Mapping[str, Any] | str | None) -> None:
        """Replace the disturbances (None: off); every simulation must be reset afterwards."""
        chosen = read_disturbances(disturbances)
        if self._disturber is not None:
            self._disturber.start_nominal(self._all)
        self._disturber = None if chosen.is_off else Disturber(self.task, chosen)
        self._is_started[:] = False

    @property
    def varies_physics(self) -> bool:
        """True if disturbances may change the physics of an episode."""
        return self._disturber is not None and self._disturber.varies_physics

    def variation(self, index: int) -> dict[str, float]:
        """Return the variations of the running episode by name; {} without disturbances."""
        index = self._index(index)
        if self._disturber is None:
            return {}
        return {name: float(values[index]) for name, values in self._disturber.variations.items()}

    def readings(self) -> Readings:
        """Return sensor readings, with disturbances, by topic in new arrays (N, topic.size)."""
        return self.true_readings() if self._disturber is None else self._disturber.readings()

    def true_readings(self) -> Readings:
        """Return the readings of undisturbed sensors, in the form of `readings`."""
        disturber = self._disturber
        return self.task.readings() if disturber is None else disturber.true_readings()

    def observe(self) -> Observation:
        """Return the present observation of all simulations, as in `StepResult`, in new arrays."""
        if self._disturber is None:
            return self._sensed(*self.task.observe())
        sensed, _ = self.task.observe_from(self._disturber.readings())
        return self._sensed(sensed, achieved_goal(self.spec, self._disturber.true_readings()))

    def observe_from(self, readings: Readings) -> Observation:
        """Return observation and achieved goal computed from a result of `readings`."""
        return self._sensed(*self.task.observe_from(readings))

    def __copy__(self) -> Simulation:
        """Return a deep copy, so that copies share neither physics nor random generators."""
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        """Return constructor arguments and complete state, for `pickle` and `copy.deepcopy`."""
        return {
            'arguments': {
                'task': self.spec.name,
                **asdict(self._batch),
                'disturbances': self.disturbances,
            },
            'disturbed': None if self._disturber is None else self._disturber.state(),
            'model': self.model if self._model_may_change else None,
            'pairs': self.task.pairs if self._model_may_change else None,
            'metric': self.metric,
            'physics': self.task.physics_state(),
            'goals': self.goals.copy(),
            'generators': self._generators,
            'divergences': self.divergences,
            'is_pushed': self._is_pushed,
            'is_started': self._is_started.copy(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Compile the model again and restore the state, bit for bit."""
        Simulation.__init__(self, **state['arguments'])
        if state['model'] is not None:
            self.task.take_model(state['model'], state['pairs'])
            self._model_may_change = True
        self.metric = state['metric']
        self.task.set_physics_state(state['physics'])
        self.task.take_diverged()
        if self._disturber is not None:
            self._disturber.set_state(state['disturbed'])
        self.goals[:] = state['goals']
        self._generators = state['generators']
        self.divergences = state['divergences']
        # The push itself is part of the physics.
        self._is_pushed = state['is_pushed']
        self._is_started[:] = state['is_started']

    def _each_given(
        self, name: str, given: Any, ids: NDArray[np.intp], read: Callable[[Any], _Read]
    ) -> dict[int, _Read]:
        """Parse the argument `name` of `reset` with `read`; return the values by simulation index.

        Simulations without a value are left out.
        """
        pairs = zip(ids.tolist(), each_of(name, given, ids.size), strict=True)
        return {index: read(value) for index, value in pairs if value is not None}

    def _read_goal(self, goal: ArrayLike) -> Array:
        shape = (self.spec.goal.size,)
        wanted = np.array(finite_numbers(f'goal of {self.spec.name}', goal, shape), np.float64)
        if self.spec.goal is GoalKind.POSE:
            nearest_quaternions(wanted[None], wanted[None])
        return wanted

    def _allowed_variation(self, variation: Any) -> dict[str, float]:
        if self._disturber is None:
            raise ValueError(
                f'variation {variation!r:.60} has no effect on an undisturbed robot; '
                "set disturbances, such as 'mild'"
            )
        return self._disturber.allow(variation)

    def _start(
        self,
        ids: NDArray[np.intp],
        variations: Mapping[int, Mapping[str, float]],
        starts: Mapping[int, StartState],
    ) -> None:
        """Start episodes of simulations `ids`, sorted (n,); some have given values, by index."""
        self._require_threads()
        own = [self.generator(i) for i in ids.tolist()]
        streams: list[np.random.Generator] = []
        if self._disturber is not None:
            # A far part of each generator's own sequence, which no number of draws reaches: start
            # and goal draw the same without disturbances.
            sources: list[Any] = [each.bit_generator for each in own]
            streams = [np.random.Generator(source.jumped()) for source in sources]
            self._disturber.start_nominal(ids)
        self.goals[ids] = self.task.reset(ids, own)
        if starts:
            batch = self.task.batch
            for index, start in starts.items():
                start.write(batch.bind('qpos')[index], batch.bind('qvel')[index])
            batch.forward(np.array(sorted(starts)))
        if self._disturber is not None:
            self._disturber.start(ids, streams, variations)
        self.task.take_diverged()
        self._is_started[ids] = True

    def _sensed(self, observation: Array, achieved_goal: Array) -> Observation:
        """Return the observation as a dictionary, with a copy of the desired goals."""
        return {
            'observation': observation,
            'achieved_goal': achieved_goal,
            'desired_goal': self.goals.copy(),
        }

    def _advance(self, commands: NDArray[np.floating]) -> NDArray[np.bool_]:
        if not self._is_started.all():
            waiting = np.flatnonzero(~self._is_started).tolist()
            raise ResetNeeded(f'call reset before step: simulations {waiting!s:.60} never were')
        finite_numbers('goals', self._goals, self._goals.shape)
        self._require_threads()
        if self._disturber is not None:
            commands = self._disturber.command(commands)
            self._is_pushed |= self._disturber.push(self._pushes)
        self.task.apply_commands(commands)
        try:
            self.task.step()
            failed = np.zeros(self.num_envs, dtype=bool)
        except SimulationError as error:
            failed = np.isin(self._all, error.ids)
        if self._is_pushed:
            self._pushes[:] = 0.0
            self._is_pushed = False
        diverged = failed | self.task.take_diverged()
        if self._disturber is not None:
            self._disturber.sense()
        if diverged.any():
            ids = np.flatnonzero(diverged)
            self.divergences += ids.size
            _LOGGER.warning(
                '%s: MuJoCo reports simulations %s as diverged; they start a new episode',
                self.spec.name,
                ids.tolist(),
            )
            self._start(ids, {}, {})
        return diverged

    def _result(self, diverged: NDArray[np.bool_]) -> StepResult:
        """Return the result of a step; reward and success follow the true state."""
        observation = self.observe()
        reward, success = self.metric.evaluate(observation['achieved_goal'], self.goals)
        return StepResult(observation, reward, success, diverged)

    @property
    def _pushes(self) -> Array:
        """External wrenches on the bodies, (N, bodies, 6); MuJoCo applies values written here."""
        pushes: Array = self.task.batch.bind('xfrc_applied')
        return pushes

    def _require_threads(self) -> None:
        """Raise RuntimeError in a forked process, which lacks the threads of the batch."""
        if self._process != os.getpid() and self.task.batch.nthread > 1:
            raise RuntimeError(
                'this process was forked and lacks the threads of the batch: create the batch '
                'here, copy it (copy.deepcopy), or use num_threads=1'
            )

    def _finite(self, name: str, values: ArrayLike) -> NDArray[np.floating]:
        shape = (self.num_envs, self.spec.robot.action_size)
        return finite_numbers(name, values, shape)

    def _fitting(self, data: Any) -> Any:
        """Return `data`; ValueError unless it is an `MjData` with a state of the same size."""
        size = self.task.batch.state.shape[1]
        kind = mujoco.mjtState.mjSTATE_INTEGRATION.value
        if not isinstance(data, mujoco.MjData) or mujoco.mj_stateSize(data.model, kind) != size:
            raise ValueError(
                f'data {type(data).__name__}; allowed: a mujoco.MjData of the model of '
                f'{self.spec.name}, with a state of {size} values'
            )
        return data

    def _index(self, index: int) -> int:
        """Return `index`; raise ValueError unless it is 0 ... N - 1."""
        require_whole('index', index, highest=self.num_envs - 1)
        return index

    def _select(self, ids: ArrayLike | None) -> NDArray[np.intp]:
        return self._all if ids is None else selected_simulations(ids, self.num_envs)
