"""Check a third-party task, as `gymnasium.utils.env_checker.check_env` checks an environment."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from fetch_hand_sim.simulation.models import load_model
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.simulation import Simulation
from fetch_hand_sim.simulation.tasks import Task
from msgs_spec.arrays import Array
from msgs_spec.observations import Readings, observed_topics
from msgs_spec.tasks import REWARD_TYPES, SUCCESS_RULES, GoalKind, TaskSpec, task_spec
from msgs_spec.topics import sensor_topics

_TOLERANCE = 1e-9
# Offset between two rows of readings, so that formulas cannot mix them up unnoticed.
_OFFSET = 1e-6
_STEPS = 3


def check_task(name: str) -> None:
    """Check that the class of a task, one of `TASKS`, follows its specification.

    Run it once in the tests of the third-party package. The simulation itself checks none of this.

    Raises:
        ValueError: If the task is invalid; the message names the first problem and its remedy.
            Exceptions of the task's own code are passed on.
    """
    spec = task_spec(name)
    _check_specification(spec)
    simulation = Simulation(name, num_envs=2, num_threads=1)
    task = simulation.task
    _check_object(task)
    _check_model_file(task)
    _check_metrics(task)
    _check_sensors(task)
    simulation.reset(seed=0)
    _check_goals(spec, simulation.goals)
    _check_formulas(task)
    _check_rewards(simulation)
    _check_resets(simulation)


def _check_specification(spec: TaskSpec) -> None:
    _require(
        spec.distance_threshold > 0.0, spec, f'distance_threshold {spec.distance_threshold}; > 0'
    )
    _require(spec.episode_ticks >= 1, spec, f'episode_ticks {spec.episode_ticks}; allowed: >= 1')
    sizes = [part.size for part in spec.observation if part.name == spec.achieved_goal]
    _require(
        sizes == [spec.goal.size],
        spec,
        f'achieved_goal {spec.achieved_goal!r} must name one part of the observation with '
        f'{spec.goal.size} values',
    )
    _require(
        len(spec.robot.joints) == len(spec.robot.joint_units),
        spec,
        f'{len(spec.robot.joints)} joints have {len(spec.robot.joint_units)} units',
    )
    for part in spec.robot.command:
        is_range = np.isfinite([part.lower, part.upper]).all() and part.lower < part.upper
        _require(is_range, spec, f'command {part.name} has limits {part.lower} ... {part.upper}')
    published = [topic.name for topic in sensor_topics(spec)]
    for topic in observed_topics(spec):
        _require(
            topic in published,
            spec,
            f'formulas read topic {topic!r}; allowed: {", ".join(published)}',
        )


def _check_object(task: Task) -> None:
    """Viewers draw the object at its free joint."""
    if task.spec.object_name is None:
        return
    joint = f'{task.spec.object_name}:joint'
    number = mujoco.mj_name2id(task.model, mujoco.mjtObj.mjOBJ_JOINT.value, joint)
    is_free = number >= 0 and task.model.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE.value
    _require(is_free, task.spec, f'the model needs a free joint {joint!r} for the object')


def _check_model_file(task: Task) -> None:
    """Pictures, films and /tf show the file, so it must contain what is simulated."""
    simulated, drawn = (_shapes(model) for model in (task.model, load_model(task.asset)))
    _require(
        simulated.shape == drawn.shape and np.allclose(simulated, drawn),
        task.spec,
        f'the simulated model differs from {task.asset}, which pictures show; change the file',
    )


def _shapes(model: mujoco.MjModel) -> Array:
    """Return body, type, position and size of every geom, (geoms, 8)."""
    columns = model.geom_bodyid[:, None], model.geom_type[:, None], model.geom_pos, model.geom_size
    return np.concatenate(columns, axis=1)


def _check_metrics(task: Task) -> None:
    for rule in SUCCESS_RULES:
        for reward_type in REWARD_TYPES:
            metric: Any = task.goal_metric(rule, reward_type)
            is_asked = isinstance(metric, GoalMetric) and (
                (metric.success_rule, metric.reward_type) == (rule, reward_type)
            )
            _require(
                is_asked,
                task.spec,
                f'goal_metric({rule!r}, {reward_type!r}) must return a GoalMetric of these',
            )


def _check_sensors(task: Task) -> None:
    for topic in sensor_topics(task.spec):
        _require(
            topic.name in task.sensors,
            task.spec,
            f'sensor {topic.name} is missing; add it with add_sensor(name, function)',
        )
        first, second = (task.readings([topic.name])[topic.name] for _ in range(2))
        _require_array(task.spec, f'sensor {topic.name}', first, (task.batch.nsim, topic.size))
        _require(
            not np.shares_memory(first, second),
            task.spec,
            f'sensor {topic.name} must return a fresh array (.copy())',
        )


def _check_goals(spec: TaskSpec, goals: Array) -> None:
    _require_array(spec, 'goals of reset', goals, (2, spec.goal.size))
    if spec.goal is GoalKind.POSE:
        lengths = np.linalg.norm(goals[:, 3:], axis=1)
        _require(np.allclose(lengths, 1.0), spec, f'goal quaternions have lengths {lengths}, not 1')


def _check_formulas(task: Task) -> None:
    """Formulas must work on any leading axes, row by row."""
    pair = _different_rows(task)
    together = _evaluate_formulas(task, pair, (2,))
    for row in range(2):
        alone = _evaluate_formulas(task, {name: each[row] for name, each in pair.items()}, ())
        for both, one in zip(together, alone, strict=True):
            _require(
                np.allclose(both[row], one, _TOLERANCE, _TOLERANCE),
                task.spec,
                'formulas must work row by row on the last axis; one row depends on another',
            )
    start, spec = task.spec.achieved_goal_start, task.spec
    observation, achieved = together
    _require(
        np.allclose(observation[:, start : start + spec.goal.size], achieved),
        spec,
        f'observation part {spec.achieved_goal!r} is not the achieved goal; order the parts as '
        'the vector',
    )


def _different_rows(task: Task) -> Readings:
    rows = task.readings(observed_topics(task.spec))
    for topic in sensor_topics(task.spec):
        if topic.name in rows:
            offsets = [_OFFSET * ('quaternion' not in part.unit) for part in topic.layout]
            rows[topic.name][1] += np.repeat(offsets, [part.size for part in topic.layout])
    return rows


def _evaluate_formulas(
    task: Task, readings: Readings, leading: tuple[int, ...]
) -> tuple[Array, Array]:
    observation, achieved = task.observe_from(readings)
    where = f'for readings with leading axes {leading}'
    size, goal_size = task.spec.observation_size, task.spec.goal.size
    _require_array(task.spec, f'observation {where}', observation, (*leading, size))
    _require_array(task.spec, f'achieved_goal {where}', achieved, (*leading, goal_size))
    return observation, achieved


def _check_rewards(simulation: Simulation) -> None:
    achieved, desired = simulation.observe()['achieved_goal'], simulation.goals
    for goals in ((achieved, desired), (achieved[0], desired[0]), (achieved[None], desired[None])):
        shape = goals[0].shape[:-1]
        for name, values in (
            ('reward', simulation.metric.reward(*goals)),
            ('success', simulation.metric.success(*goals)),
        ):
            _require_array(
                simulation.spec, f'{name} of goals {goals[0].shape}', np.asarray(values), shape
            )


def _check_resets(simulation: Simulation) -> None:
    """The same seed must give the same episode, and a reset must leave other simulations alone."""
    simulation.reset(seed=[0, 1])
    first = _all_sensors(simulation)
    _require_array(
        simulation.spec,
        'resting_commands()',
        simulation.resting_commands(),
        (2, simulation.spec.robot.action_size),
    )
    for _ in range(_STEPS):
        simulation.step(np.full((2, simulation.spec.robot.action_size), 0.5))
    before = _all_sensors(simulation)
    simulation.reset(seed=0, ids=[0])
    again = _all_sensors(simulation)
    _require(
        np.allclose(again[0], first[0], _TOLERANCE, _TOLERANCE),
        simulation.spec,
        'a reset with the same seed gives other sensor values; reset must set the whole state and '
        'call self.batch.forward(ids)',
    )
    _require(
        np.array_equal(again[1], before[1]),
        simulation.spec,
        'reset(ids) changes simulations that are not in ids',
    )


def _all_sensors(simulation: Simulation) -> Array:
    return np.concatenate(list(simulation.readings().values()), axis=1)


def _require_array(spec: TaskSpec, what: str, values: Any, shape: tuple[int, ...]) -> None:
    _require(isinstance(values, np.ndarray), spec, f'{what} must be an array, not {values!r:.60}')
    _require(values.shape == shape, spec, f'{what} has shape {values.shape}, not {shape}')
    _require(bool(np.isfinite(values).all()), spec, f'{what} is not finite')


def _require(is_met: Any, spec: TaskSpec, problem: str) -> None:
    if not is_met:
        raise ValueError(f'{spec.name}: {problem}')
