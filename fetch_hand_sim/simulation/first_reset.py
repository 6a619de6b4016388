"""What a task of another package gives at its first reset, against what its specification says.

What does not fit would fail far from its cause, or never. Looked at once: ticks cost no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import numpy as np

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.tasks import Task
from fetch_hand_sim.simulation.tasks.task import Ids
from msgs_spec.arrays import Array
from msgs_spec.observations import Readings, achieved_goal, observation, observed_topics
from msgs_spec.tasks import GoalKind, RewardType, SuccessRule, TaskSpec
from msgs_spec.text import one_line
from msgs_spec.topics import sensor_topics
from node_runtime.command_line import CommandError

_Given = TypeVar('_Given')
# What tells two rows of readings apart where there is one simulation; m, rad and per second.
_APART = 1e-6
# Rows one by one may differ from those of a batch by this, as sums in another order do.
_ROUNDING = 1e-9
# The same number where one of two is of single precision.
_SINGLE = 1e-5
# By how much the length of a quaternion may differ from 1.
_UNIT = 1e-6


class SpecificationError(CommandError, ValueError):
    """A task does not give what its specification says; the message is one line."""


def require_metric(
    spec: TaskSpec, metric: Any, success_rule: SuccessRule, reward_type: RewardType
) -> GoalMetric:
    """Refuses a metric of `goal_metric` that is none, or another than was asked for.

    Raises:
        SpecificationError: If it is; the message says what is allowed.
    """
    if not isinstance(metric, GoalMetric):
        kind = type(metric).__name__
        raise SpecificationError(
            f'{spec.name}: goal_metric() gives {kind}; allowed: a GoalMetric of success_rule and '
            'reward_type'
        )
    given, asked = (metric.success_rule, metric.reward_type), (success_rule, reward_type)
    if given != asked:
        raise SpecificationError(
            f'{spec.name}: goal_metric{asked} gives a metric of {given}; it passes on both '
            'arguments'
        )
    return metric


def require_goals(spec: TaskSpec, goals: Any, count: int) -> None:
    """Refuses goals of `reset` that are not (count, goal size) finite numbers, turns of length 1.

    Raises:
        SpecificationError: If they are not; the message says what is wrong.
    """
    _require_shape(spec, 'what reset returns', goals, (count, spec.goal.size))
    _require_finite(spec, 'what reset returns', goals)
    if spec.goal is GoalKind.POSE:
        lengths = np.linalg.norm(np.asarray(goals)[:, 3:], axis=1)
        worst = lengths[np.abs(lengths - 1.0).argmax()]
        if abs(worst - 1.0) > _UNIT:
            raise SpecificationError(
                f'{spec.name}: a quaternion that reset returns has length {worst:.7g}; allowed: 1'
            )


def require_as_declared(task: Task, metric: GoalMetric, goals: Array, ids: Ids) -> None:
    """Compares sensors, formulas, rewards and resting commands with the specification.

    Args:
        task: The task, `ids` of whose simulations have just been reset.
        metric: What rewards it.
        goals: (n, goal size) what these are to reach.
        ids: (n,) which.

    Raises:
        SpecificationError: If something does not fit; the message says what is allowed.
    """
    _require_sensors(task)
    readings = {name: each[ids] for name, each in task.readings(observed_topics(task.spec)).items()}
    found = _require_vectors(task, readings, (ids.size,))
    for name, vectors in found.items():
        _require_finite(task.spec, name, vectors)
    _require_any_leading_axes(task, readings)
    _require_achieved_part(task.spec, found['observation'], found['achieved_goal'])
    _require_rewards(metric, found['achieved_goal'], goals)
    shape = (task.batch.nsim, task.spec.robot.action_size)
    _require_shape(task.spec, 'resting_commands()', task.resting_commands(), shape)


def _require_sensors(task: Task) -> None:
    for topic in sensor_topics(task.spec):
        first, second = (task.readings([topic.name])[topic.name] for _ in range(2))
        what = f'what sensor {topic.name} says'
        _require_shape(task.spec, what, first, (task.batch.nsim, topic.size))
        if np.shares_memory(first, second):
            raise SpecificationError(
                f'{task.spec.name}: {what} is the same array each time, which the next step '
                'changes; a sensor returns a fresh one (.copy())'
            )


def _require_vectors(task: Task, readings: Readings, leading: tuple[int, ...]) -> dict[str, Array]:
    """What the formulas make of readings with these leading axes, if sizes and type are right."""
    spec, where = task.spec, f'of readings with leading axes {leading}'

    def made() -> dict[str, Array]:
        return {
            'observation': observation(spec, readings, task.tick_duration),
            'achieved_goal': achieved_goal(spec, readings),
        }

    found = _asked(spec, f'what formulas make {where}', made)
    for name, size in (('observation', spec.observation_size), ('achieved_goal', spec.goal.size)):
        if not isinstance(found[name], np.ndarray):
            kind = type(found[name]).__name__
            raise SpecificationError(f'{spec.name}: {name} {where} is no array but {kind}')
        _require_shape(spec, f'{name} {where}', found[name], (*leading, size))
    return found


def _require_any_leading_axes(task: Task, readings: Readings) -> None:
    """Compares what two rows give together with what each gives alone."""
    pair = dict(_two_rows(task, readings))
    together = _require_vectors(task, pair, (2,))
    for row in range(2):
        alone = _require_vectors(task, {name: each[row] for name, each in pair.items()}, ())
        for name, vector in alone.items():
            if not np.allclose(together[name][row], vector, _ROUNDING, _ROUNDING, equal_nan=True):
                raise SpecificationError(
                    f'{task.spec.name}: {name} of a row depends on the other rows of its batch, or '
                    'on chance; formulas work row by row, on the last axis'
                )


def _two_rows(task: Task, readings: Readings) -> Iterator[tuple[str, Array]]:
    """The first and the last row, the last a little apart, but for quaternions."""
    for topic in sensor_topics(task.spec):
        if topic.name not in readings:
            continue
        apart = [_APART * ('quaternion' not in part.unit) for part in topic.layout]
        pair = readings[topic.name][[0, -1]]
        pair[1] += np.repeat(apart, [part.size for part in topic.layout])
        yield topic.name, pair


def _require_achieved_part(spec: TaskSpec, observations: Array, achieved: Array) -> None:
    start = spec.achieved_goal_start
    part = observations[:, start : start + spec.goal.size]
    if not np.allclose(part, achieved, _SINGLE, _SINGLE):
        raise SpecificationError(
            f'{spec.name}: observation[{start}:{start + spec.goal.size}], by its parts '
            f'{spec.achieved_goal}, is not the achieved goal: parts are named in the order of the '
            'vector'
        )


def _require_rewards(metric: GoalMetric, achieved: Array, desired: Array) -> None:
    spec = metric.spec
    for goals in ((achieved, desired), (achieved[0], desired[0]), (achieved[None], desired[None])):
        shape = goals[0].shape[:-1]
        where = f'of goals {goals[0].shape}'
        # As libraries ask, with the info that a reward must not depend on.
        reward = partial(metric.reward, goals[0], goals[1], None)
        for name, asked in (('reward', reward), ('success', partial(metric.success, *goals))):
            values = _asked(spec, f'{name} {where}', asked)
            _require_shape(spec, f'{name} {where}', values, shape)
            _require_finite(spec, f'{name} {where}', values)


def _asked(spec: TaskSpec, what: str, function: Callable[[], _Given]) -> _Given:
    """What code of another package returns; what it raises is one line."""
    try:
        with np.errstate(all='ignore'):
            return function()
    except KeyError as error:
        topics = ', '.join(observed_topics(spec))
        raise SpecificationError(
            f'{spec.name}: {what} asks for {error}; the topics of the formulas: {topics}'
        ) from error
    except Exception as error:
        why = f'{type(error).__name__}: {one_line(error)}'
        raise SpecificationError(f'{spec.name}: {what} cannot be computed: {why}') from error


def _require_shape(spec: TaskSpec, what: str, values: Any, shape: tuple[int, ...]) -> None:
    if np.shape(values) != shape:
        raise SpecificationError(f'{spec.name}: {what} has shape {np.shape(values)}, not {shape}')


def _require_finite(spec: TaskSpec, what: str, values: Any) -> None:
    if not np.isfinite(values).all():
        raise SpecificationError(
            f'{spec.name}: {what} is not finite: {np.asarray(values).tolist()!s:.60}'
        )
