"""`Simulation`: any number of copies of one task, stepped together.

One copy serves the ROS node and `gymnasium.make`; sixty-four and more serve the trainer. It counts
no steps and ends no episodes: whoever drives it decides.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from mujoco.batch import SimulationError
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation.arguments import (
    Seeds,
    finite_goals,
    finite_numbers,
    generators,
    nearest_quaternions,
    require_whole,
    selected_simulations,
)
from fetch_hand_sim.simulation.disturber import Disturber
from fetch_hand_sim.simulation.divergence import DivergenceWatch
from fetch_hand_sim.simulation.first_reset import (
    require_as_declared,
    require_goals,
    require_metric,
)
from fetch_hand_sim.simulation.models import asset_path
from fetch_hand_sim.simulation.tasks import Task, make_task
from fetch_hand_sim.simulation.trial import TRIED, try_out
from msgs_spec.actions import command_from_action
from msgs_spec.arrays import Array
from msgs_spec.disturbances import Disturbances, read_disturbances
from msgs_spec.observations import Readings
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    TIMINGS,
    GoalKind,
    RewardType,
    SuccessRule,
    Timing,
)

Observation = dict[str, Array]

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one tick of N simulations gave.

    Attributes:
        observation: `observation`, `achieved_goal`, `desired_goal`, each (N, ...), fresh arrays.
        reward: (N,), sparse -1 or 0, dense minus the distance (m; poses 10 x m + rad).
        success: (N,) booleans, of this tick.
        diverged: (N,) booleans: MuJoCo lost this simulation during the tick and it was reset, so
            that its observation, reward and success are of a new episode.
    """

    observation: Observation
    reward: Array
    success: NDArray[np.bool_]
    diverged: NDArray[np.bool_]


class Simulation:
    """N copies of one task on a pool of threads; pickled and copied with its state.

    Call `reset` before `step`. A forked process has no threads but its own: a batch of several
    refuses to go on there, and a copy of it goes on.

    Args:
        task: One of the thirteen tasks (`msgs_spec.tasks.TASKS`).
        num_envs: Number of copies N.
        num_threads: Threads that step them; 0 for all processors that the process may use
            (`taskset`, `os.sched_setaffinity`). There are never more than copies.
        reward_type: `sparse` or `dense`.
        success_rule: `gymnasium` (released code) or `paper` (its text).
        control_hz: Actions per simulated second: 500/n for n = 1 ... 40.
        keeps_data: Whether each copy keeps an `MjData` of its own, which `read_data` then
            gives as MuJoCo left it.
        timing: What another rate than 25 Hz leaves as it is: `seconds` of an episode and the speed
            of the Fetch gripper, or `ticks` and its step, as up to 1.0 and as the reference does.
        disturbances: Delays, noise, other physics (`msgs_spec.disturbances.read_disturbances`).
            `observation` is then what the disturbed sensors measure. `achieved_goal`, rewards and
            success follow the true state.

    Attributes:
        spec: The task as data, `episode_ticks` at this rate.
        num_envs: Number of copies N.
        control_hz: Actions per simulated second.
        timing: As given.
        metric: What rewards and success are; it may be replaced between steps.
        goals: (N, goal size) the desired goals, live: what is written counts from the next step.
            World frame; points and fingertips in m, poses in m and as quaternion wxyz.
        divergences: How often MuJoCo has lost a simulation.

    Raises:
        ValueError: If an argument is not allowed; the message says what is.
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
        require_whole('num_envs', num_envs)
        require_whole('num_threads', num_threads)
        if num_envs < 1:
            raise ValueError(f'num_envs must be at least 1, not {num_envs}')
        if timing not in TIMINGS:
            raise ValueError(f'timing {timing!r}; allowed: {", ".join(TIMINGS)}')
        if num_threads < 0:
            raise ValueError(f'num_threads must be 0 (all processors) or more, not {num_threads}')
        self._arguments: dict[str, Any] = {
            'num_envs': num_envs,
            'num_threads': num_threads,
            'control_hz': control_hz,
            'keeps_data': keeps_data,
            'timing': timing,
        }
        self._task = make_task(task, **self._arguments)
        self._model_may_change = False
        self.spec = self._task.spec
        self.num_envs = num_envs
        self.control_hz = control_hz
        self.timing = timing
        self.metric = require_metric(
            self.spec, self._task.goal_metric(success_rule, reward_type), success_rule, reward_type
        )
        self.divergences = 0
        self._divergence = DivergenceWatch(self._task.batch)
        self.goals = np.zeros((num_envs, self.spec.goal.size))
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._all = np.arange(num_envs)
        self._is_pushed = False
        self._is_started = np.zeros(num_envs, dtype=np.bool_)
        self._process = os.getpid()
        self._disturber: Disturber | None = None
        self.disturbances = disturbances
        # The thirteen are held to their specification by tests.
        self._is_as_declared = self.spec.reference_id is not None

    def __repr__(self) -> str:
        """Task and number of copies."""
        return f'{type(self).__name__}({self.spec.name!r}, num_envs={self.num_envs})'

    @property
    def goals(self) -> Array:
        """The desired goals, (N, goal size), live; of another shape a `ValueError`."""
        return self._goals

    @goals.setter
    def goals(self, goals: ArrayLike) -> None:
        wanted = np.asarray(goals, dtype=np.float64)
        if wanted.shape != (shape := (self.num_envs, self.spec.goal.size)):
            raise ValueError(f'goals of {self.spec.name} have shape {shape}, not {wanted.shape}')
        self._goals = wanted

    @property
    def task(self) -> Task:
        """The physics of the task."""
        return self._task

    @property
    def model(self) -> Any:
        """The compiled `mujoco.MjModel`."""
        return self._task.model

    @property
    def asset(self) -> Path:
        """The MJCF file of the model."""
        return asset_path(self._task.asset)

    def data(self, index: int) -> Any:
        """A copy of simulation `index` as a `mujoco.MjData`, to render or inspect."""
        return self._task.batch.get_data(index)

    def read_data(self, index: int, data: Any) -> None:
        """Writes simulation `index` into a `mujoco.MjData`; what is derived needs `keeps_data`.

        Goals, generators and counters of divergences are no part of it, here and in `write_data`.
        """
        self._task.read_data(index, data)

    def write_data(self, index: int, data: Any) -> None:
        """Lets simulation `index` go on from a `mujoco.MjData`, changed by whoever had it."""
        self._task.write_data(index, data)

    def apply_model_changes(self) -> None:
        """Steps with `model` as it is now; the simulation keeps a copy of its own."""
        self._model_may_change = True
        self._task.follow_model()

    @property
    def is_started(self) -> NDArray[np.bool_]:
        """Which simulations have been reset before, (N,)."""
        return self._is_started.copy()

    def generator(self, index: int) -> np.random.Generator:
        """The random generator of simulation `index`, live: starts and goals are drawn from it."""
        generator = self._generators[index]
        if generator is None:
            generator = self._generators[index] = seeding.np_random(None)[0]
        return generator

    @property
    def tick_duration(self) -> float:
        """Simulated seconds per step."""
        return self._task.tick_duration

    def reset(self, seed: Seeds = None, ids: ArrayLike | None = None) -> Observation:
        """Starts simulations again.

        Args:
            seed: One seed (simulation i takes seed + i), one per simulation of `ids`, in their
                order, or None: the random generators go on. The same seed gives the reference's
                draws. Instead of a seed there may be a generator, which is used from then on.
            ids: Which simulations: indices or a boolean mask (N,); None for all.

        Returns:
            The observations of all N simulations.

        Raises:
            ValueError: If a seed is negative, or ids or seeds do not fit; the first time also if
                a task of another package does not give what its specification says.
            TypeError: If a seed is not an integer.
            RuntimeError: If an object never stays on the palm, or this process was forked and has
                no threads of the batch.
        """
        selected = self._select(ids)
        fresh = generators(seed, selected)
        for index, generator in zip(selected.tolist(), fresh, strict=True):
            self._generators[index] = generator or self._generators[index]
        if selected.size:
            self._start(np.sort(selected))
        return self.observe()

    def step(self, actions: ArrayLike) -> StepResult:
        """Advances every simulation by one tick.

        Args:
            actions: (N, action size) in [-1, 1], float32 or float64.

        Raises:
            ValueError: If the shape is wrong, or a value is not finite or out of range; nothing has
                moved then.
            gymnasium.error.ResetNeeded: If a simulation has never been reset.
            RuntimeError: If this process was forked and has no threads of the batch.
        """
        checked = self._finite('actions', actions)
        if checked.size and (np.abs(checked) > 1.0).any():
            env, part = np.argwhere(np.abs(checked) > 1.0)[0]
            raise ValueError(
                f'actions must lie in [-1, 1]; actions[{env}, {part}] is {checked[env, part]}'
            )
        return self._result(self._advance(command_from_action(self.spec.robot, checked)))

    def step_commands(self, commands: ArrayLike) -> StepResult:
        """Advances every simulation by one tick, with commands in ROS units.

        Args:
            commands: (N, action size): Fetch as actions; hand absolute joint positions in radians.
                What lies beyond a limit must have been clipped (`msgs_spec.actions`).

        Raises:
            ValueError: If the shape is wrong or a value is not finite.
            gymnasium.error.ResetNeeded: If a simulation has never been reset.
            RuntimeError: If this process was forked and has no threads of the batch.
        """
        return self._result(self.advance(commands))

    def advance(self, commands: ArrayLike) -> NDArray[np.bool_]:
        """Does what `step_commands` does, for those who read the sensors themselves.

        Returns:
            Which simulations diverged, (N,).
        """
        return self._advance(self._finite('commands', commands))

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None
    ) -> Array:
        """Reward of goals, as `step` gives it.

        Args:
            achieved_goal: (..., goal size), any batch shape.
            desired_goal: Likewise, of the same shape.
            info: Of no account; Gymnasium's interface has it.

        Returns:
            (...,) rewards.

        Raises:
            ValueError: If the last axis is not the goal's, or the shapes differ.
        """
        return self.metric.reward(achieved_goal, desired_goal, info)

    def compute_success(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike
    ) -> NDArray[np.bool_]:
        """Success of goals of any batch shape, (..., goal size) -> (...,); as `compute_reward`."""
        return self.metric.success(achieved_goal, desired_goal)

    def set_goal(self, goals: ArrayLike, ids: ArrayLike | None = None) -> None:
        """Replaces desired goals.

        Quaternions are normalised and taken in the hemisphere nearest to the object's, because the
        `gymnasium` success rule tells q from -q.

        Args:
            goals: (n, goal size) for the n simulations of `ids`, in their order; units and frame as
                `Simulation.goals` has them.
            ids: Which simulations; None for all.

        Raises:
            ValueError: If the shape is wrong, a value is not finite or a quaternion is zero.
        """
        selected = self._select(ids)
        wanted = finite_goals(goals, selected.size, self.spec)
        if self.spec.goal is GoalKind.POSE:
            wanted = nearest_quaternions(wanted, self._task.observe()[1][selected])
        self.goals[selected] = wanted

    def perturb(self, body: str, wrench: ArrayLike, index: int = 0) -> None:
        """Pushes a body of one simulation during the next step.

        Args:
            body: Its name in the model.
            wrench: (6,) force in N and torque in N m, world axes, at the centre of mass.
            index: Which simulation.

        Raises:
            ValueError: If there is no such simulation, no such body that can move, or a value is
                not finite.
        """
        values = np.asarray(wrench, dtype=np.float64)
        if values.shape != (6,) or not np.isfinite(values).all():
            raise ValueError(f'a wrench is six finite numbers, not {values.tolist()}')
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY.value, body)
        if number < 1 or not self.model.body_weldid[number]:
            raise ValueError(f'no body {body[:40]!r} that can move')
        self._pushes[selected_simulations([index], self.num_envs), number] = values
        self._is_pushed = True

    def resting_commands(self) -> Array:
        """Commands (N, action size) that let the robots stay as they are."""
        return self._task.resting_commands()

    @property
    def disturbances(self) -> Disturbances:
        """What is disturbed."""
        return Disturbances() if self._disturber is None else self._disturber.disturbances

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances | Mapping[str, Any] | str | None) -> None:
        """Replace the disturbances; every simulation must be reset afterwards."""
        chosen = read_disturbances(disturbances)
        if self._disturber is not None:
            self._disturber.start_nominal(self._all)
        self._disturber = None if chosen.is_off else Disturber(self._task, chosen)
        self._is_started[:] = False

    def variation(self, index: int) -> dict[str, float]:
        """Return what the running episode of a simulation drew from its disturbances."""
        if self._disturber is None:
            return {}
        return {name: float(values[index]) for name, values in self._disturber.variations.items()}

    def readings(self) -> Readings:
        """Return what the sensors measure, (N, topic.size) for each topic, fresh arrays."""
        return self.true_readings() if self._disturber is None else self._disturber.readings()

    def true_readings(self) -> Readings:
        """Return what undisturbed sensors would measure, as `readings`."""
        return self._task.readings()

    def observe(self) -> Observation:
        """Return the present observation, fresh arrays."""
        if self._disturber is None:
            return self._observation(*self._task.observe())
        sensed, _ = self._task.observe_from(self._disturber.readings())
        return self._observation(sensed, self._task.observe()[1])

    def __copy__(self) -> Simulation:
        """As `copy.deepcopy`: two simulations have no physics or generators in common."""
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        """Arguments and everything that decides the future, for `pickle` and `copy.deepcopy`."""
        return {
            'arguments': {
                'task': self.spec.name,
                **self._arguments,
                'disturbances': self.disturbances,
            },
            'disturbed': None if self._disturber is None else self._disturber.state(),
            'model': self.model if self._model_may_change else None,
            'pairs': self._task.pairs if self._model_may_change else None,
            'metric': self.metric,
            'physics': self._task.physics_state(),
            'goals': self.goals.copy(),
            'generators': self._generators,
            'divergences': self.divergences,
            'is_pushed': self._is_pushed,
            'is_started': self._is_started.copy(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Compiles the model again and goes on from the state, to the same bits."""
        Simulation.__init__(self, **state['arguments'])
        if state['model'] is not None:
            self._task.take_model(state['model'], state.get('pairs'))
            self._model_may_change = True
        self.metric = state['metric']
        self._task.set_physics_state(state['physics'])
        self._divergence.forget()
        if self._disturber is not None:
            self._disturber.set_state(state['disturbed'])
        self.goals[:] = state['goals']
        self._generators = state['generators']
        self.divergences = state['divergences']
        # The push itself is part of the physics; copies made by 1.0 do not say that it ends.
        self._is_pushed = state.get('is_pushed', False)
        self._is_started[:] = state.get('is_started', True)

    def observe_from(self, readings: Readings) -> Observation:
        """The observation of what `readings` returned."""
        return self._observation(*self._task.observe_from(readings))

    @property
    def _pushes(self) -> Array:
        """What bodies are pushed by, (N, bodies, 6), live."""
        pushes: Array = self._task.batch.bind('xfrc_applied')
        return pushes

    def _advance(self, commands: NDArray[np.floating]) -> NDArray[np.bool_]:
        if not self._is_started.all():
            waiting = np.flatnonzero(~self._is_started).tolist()
            raise ResetNeeded(f'reset comes before the first step: simulations {waiting!s:.60}')
        self._require_threads()
        if self._disturber is not None:
            commands = self._disturber.command(commands)
            self._is_pushed |= self._disturber.push(self._pushes)
        self._task.apply_commands(commands)
        try:
            self._task.step()
            failed = np.zeros(self.num_envs, dtype=bool)
        except SimulationError as error:
            failed = np.isin(self._all, error.ids)
        if self._is_pushed:
            self._pushes[:] = 0.0
            self._is_pushed = False
        diverged = failed | self._divergence.found()
        if self._disturber is not None:
            self._disturber.sense()
        if diverged.any():
            self._restart(diverged)
        return diverged

    def _result(self, diverged: NDArray[np.bool_]) -> StepResult:
        observation = self.observe()
        reward, success = self.metric.evaluate(observation['achieved_goal'], self.goals)
        return StepResult(observation, reward, success, diverged)

    def _restart(self, diverged: NDArray[np.bool_]) -> None:
        ids = np.flatnonzero(diverged)
        self.divergences += ids.size
        _LOGGER.warning(
            '%s: MuJoCo reports simulations %s as diverged; they start a new episode',
            self.spec.name,
            ids.tolist(),
        )
        self._start(ids)

    def _start(self, ids: NDArray[np.intp]) -> None:
        """Begins episodes; what MuJoCo warned of before counts no more."""
        self._require_threads()
        own = [self.generator(i) for i in ids.tolist()]
        # A far part of each generator's own sequence: start and goal draw the same without it.
        streams = [np.random.Generator(_jumped(each)) for each in own] if self._disturber else []
        if self._disturber is not None:
            self._disturber.start_nominal(ids)
        goals = self._task.reset(ids, own)
        if self._disturber is not None:
            self._disturber.start(ids, streams)
        if not self._is_as_declared:
            require_goals(self.spec, goals, ids.size)
            require_as_declared(self._task, self.metric, goals, ids)
            self._try_out()
            self._is_as_declared = True
        self.goals[ids] = goals
        self._divergence.forget()
        self._is_started[ids] = True

    def _try_out(self) -> None:
        """Tries the task out once in a process, with two simulations of its own."""
        tried = self.spec.name, type(self._task)
        if tried in TRIED:
            return
        trial = Simulation(self.spec.name, 2, 1, control_hz=self.control_hz, timing=self.timing)
        trial._is_as_declared = True
        for wrong in try_out(trial):
            _LOGGER.warning('%s: %s', self.spec.name, wrong)
        TRIED.add(tried)

    def _require_threads(self) -> None:
        """Refuses to wait for ever for threads that a forked process does not have."""
        if self._process != os.getpid() and self._task.batch.nthread > 1:
            raise RuntimeError(
                'this process was forked, and the threads of a batch stay behind: make the batch '
                'here, copy it (copy.deepcopy), or give it num_threads=1'
            )

    def _observation(self, observation: Array, achieved_goal: Array) -> Observation:
        return {
            'observation': observation,
            'achieved_goal': achieved_goal,
            'desired_goal': self.goals.copy(),
        }

    def _finite(self, name: str, values: ArrayLike) -> NDArray[np.floating]:
        shape = (self.num_envs, self.spec.robot.action_size)
        return finite_numbers(name, values, shape, owner=self.spec.name)

    def _select(self, ids: ArrayLike | None) -> NDArray[np.intp]:
        return self._all if ids is None else selected_simulations(ids, self.num_envs)


def _jumped(generator: np.random.Generator) -> np.random.BitGenerator:
    """Return a stream that no number of draws from `generator` reaches."""
    source: Any = generator.bit_generator
    jumped: np.random.BitGenerator = source.jumped()
    return jumped
