"""Check a third-party task, as `gymnasium.utils.env_checker.check_env` checks an environment."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from fetch_hand_sim.simulation.models import load_model
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.simulation import Simulation
from fetch_hand_sim.simulation.tasks import Task
from msgs_spec.arrays import Array
from msgs_spec.tasks import REWARD_TYPES, SUCCESS_RULES, GoalKind, TaskSpec, task_spec
from msgs_spec.topics import sensor_topics

_TOLERANCE = 1e-9
# Offset between two rows of readings, so that formulas cannot mix them up unnoticed.
_OFFSET = 1e-6
_STEPS = 3
# Each rule yields a condition, and the error if it is False. Later rules rely on earlier ones.
Rules = Iterator[tuple[Any, str]]


def check_task(name: str) -> None:
    """Check that the simulation class of the task `name` follows its specification.

    Run it once in the tests of the third-party package. The simulation itself checks none of this.

    Raises:
        ValueError: If the task is invalid; the message names the first problem and its remedy.
            Exceptions raised in the code of the task are not caught.
    """
    for is_met, problem in _rules(task_spec(name)):
        if not is_met:
            raise ValueError(f'{name}: {problem}')


def _rules(spec: TaskSpec) -> Rules:
    yield from _specification(spec)
    simulation = Simulation(spec.name, num_envs=2, num_threads=1)
    yield from _model(simulation.task)
    for rule, reward_type in product(SUCCESS_RULES, REWARD_TYPES):
        metric: Any = simulation.task.goal_metric(rule, reward_type)
        is_asked = isinstance(metric, GoalMetric) and (
            (metric.success_rule, metric.reward_type) == (rule, reward_type)
        )
        yield is_asked, f'goal_metric({rule!r}, {reward_type!r}) must return a GoalMetric of these'
    yield from _sensors(simulation.task)
    simulation.reset(seed=0)
    yield from _array('goals of reset', simulation.goals, (2, spec.goal.size))
    if spec.goal is GoalKind.POSE:
        lengths = np.linalg.norm(simulation.goals[:, 3:], axis=1)
        yield np.allclose(lengths, 1.0), f'goal quaternions have lengths {lengths}, not 1'
    yield from _formulas(simulation.task)
    yield from _rewards(simulation)
    yield from _resets(simulation)


def _specification(spec: TaskSpec) -> Rules:
    yield spec.distance_threshold > 0.0, f'distance_threshold {spec.distance_threshold}; > 0'
    yield spec.episode_ticks >= 1, f'episode_ticks {spec.episode_ticks}; allowed: >= 1'
    sizes = [part.size for part in spec.observation if part.name == spec.achieved_goal]
    yield (
        sizes == [spec.goal.size],
        f'achieved_goal {spec.achieved_goal!r} must name one part of the observation with '
        f'{spec.goal.size} values',
    )
    joints, units = len(spec.robot.joints), len(spec.robot.joint_units)
    yield joints == units, f'{joints} joints have {units} units'
    for part in spec.robot.command:
        is_range = np.isfinite([part.lower, part.upper]).all() and part.lower < part.upper
        yield is_range, f'command {part.name} has limits {part.lower} ... {part.upper}'
    published = [topic.name for topic in sensor_topics(spec)]
    for topic in spec.observed_topics:
        yield topic in published, f'formulas read topic {topic!r}; allowed: {", ".join(published)}'


def _model(task: Task) -> Rules:
    """Yield pairs (`is_met`, error) about the model.

    The object, if any, needs a free joint. Body, type, position and size of all simulated geoms
    must equal those in the MJCF file of the task.
    """
    name = task.spec.object_name
    yield (
        name is None or task.object_qpos is not None,
        f"the model needs a free joint '{name}:joint' for the object",
    )
    simulated, drawn = (
        np.column_stack([model.geom_bodyid, model.geom_type, model.geom_pos, model.geom_size])
        for model in (task.model, load_model(task.asset))
    )
    yield (
        simulated.shape == drawn.shape and np.allclose(simulated, drawn),
        f'the simulated model differs from {task.asset}, which pictures show; change the file',
    )


def _sensors(task: Task) -> Rules:
    for topic in sensor_topics(task.spec):
        name = topic.name
        yield (
            name in task.sensors,
            f'sensor {name} is missing; add it with add_sensor(name, function)',
        )
        first, second = (task.readings([name])[name] for _ in range(2))
        yield from _array(f'sensor {name}', first, (task.batch.nsim, topic.size))
        is_fresh = not np.shares_memory(first, second)
        yield is_fresh, f'sensor {name} must return a fresh array (.copy())'


def _formulas(task: Task) -> Rules:
    """Yield pairs (`is_met`, error) about `observe_from`, the formulas of observation and goal.

    The formulas must accept readings with any leading axes, and compute each row independently.
    """
    spec = task.spec
    rows = task.readings(spec.observed_topics)
    for topic in sensor_topics(spec):
        if topic.name in rows:
            offsets = [_OFFSET * ('quaternion' not in part.unit) for part in topic.layout]
            rows[topic.name][1] += np.repeat(offsets, [part.size for part in topic.layout])
    found = []
    for row in (slice(None), 0, 1):
        vectors = task.observe_from({name: values[row] for name, values in rows.items()})
        leading = (2,) if isinstance(row, slice) else ()
        where = f'for readings with leading axes {leading}'
        yield from _array(f'observation {where}', vectors[0], (*leading, spec.observation_size))
        yield from _array(f'achieved_goal {where}', vectors[1], (*leading, spec.goal.size))
        found.append(vectors)
    together, *single = found
    for both, *alone in zip(together, *single, strict=True):
        yield (
            np.allclose(both, alone, _TOLERANCE, _TOLERANCE),
            'formulas must work row by row on the last axis; one row depends on another',
        )
    part = slice(spec.achieved_goal_start, spec.achieved_goal_start + spec.goal.size)
    yield (
        np.allclose(together[0][:, part], together[1]),
        f'observation part {spec.achieved_goal!r} is not the achieved goal; order the parts as '
        'the vector',
    )


def _rewards(simulation: Simulation) -> Rules:
    achieved, desired = simulation.observe()['achieved_goal'], simulation.goals
    for goals in ((achieved, desired), (achieved[0], desired[0]), (achieved[None], desired[None])):
        for name in ('reward', 'success'):
            values = np.asarray(getattr(simulation.metric, name)(*goals))
            yield from _array(f'{name} of goals {goals[0].shape}', values, goals[0].shape[:-1])


def _resets(simulation: Simulation) -> Rules:
    """Yield pairs (`is_met`, error): equal seeds repeat starts; a reset changes only `ids`."""
    size = simulation.spec.robot.action_size
    simulation.reset(seed=[0, 1])
    first = _all_sensors(simulation)
    yield from _array('resting_commands()', simulation.resting_commands(), (2, size))
    for _ in range(_STEPS):
        simulation.step(np.full((2, size), 0.5))
    before = _all_sensors(simulation)
    simulation.reset(seed=0, ids=[0])
    again = _all_sensors(simulation)
    yield (
        np.allclose(again[0], first[0], _TOLERANCE, _TOLERANCE),
        'a reset with the same seed gives other sensor values; reset must set the whole state and '
        'call self.batch.forward(ids)',
    )
    is_kept = np.array_equal(again[1], before[1])
    yield is_kept, 'reset(ids) changes simulations that are not in ids'


def _all_sensors(simulation: Simulation) -> Array:
    return np.concatenate(list(simulation.readings().values()), axis=1)


def _array(what: str, values: Any, shape: tuple[int, ...]) -> Rules:
    yield isinstance(values, np.ndarray), f'{what} must be an array, not {values!r:.60}'
    yield values.shape == shape, f'{what} has shape {values.shape}, not {shape}'
    yield np.isfinite(values).all(), f'{what} is not finite'
