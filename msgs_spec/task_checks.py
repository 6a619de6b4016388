"""What a task of another package must be, said by field.

What is wrong with it would otherwise fail where nobody thinks of this task any more.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from numbers import Integral, Real
from typing import Any

from msgs_spec.robots import CommandPart, RobotSpec
from msgs_spec.task_types import GoalKind, TaskFormulas, TaskSpec, VectorPart
from msgs_spec.text import did_you_mean

# What Gymnasium takes in an id and every system in a file name.
_NAME = re.compile(r'\w[\w.-]*')
_LONGEST_NAME = 64
_SYMMETRIES = (None, 'cube', 'revolution')
_INFINITE = float('inf')


def accept(name: str, spec: Any, known: Mapping[str, TaskSpec]) -> TaskSpec:
    """Returns what another package calls a task, as it is listed.

    Args:
        name: What it is listed as.
        spec: What the package gave.
        known: The thirteen.

    Raises:
        ValueError: If it is none; the message is one line.
    """
    if not isinstance(spec, TaskSpec):
        raise ValueError(f'no TaskSpec but {type(spec).__name__}')
    _require_name(name, spec, known)
    _require_types(spec)
    _require_observation(spec)
    _require_robot(spec.robot)
    _require_above_zero('distance_threshold', spec.distance_threshold)
    if spec.rotation_threshold is not None:
        _require_above_zero('rotation_threshold', spec.rotation_threshold)
    if not isinstance(spec.episode_ticks, Integral) or spec.episode_ticks < 1:
        raise ValueError(
            f'episode_ticks {spec.episode_ticks!r}; allowed: a whole number, 1 or more'
        )
    _require_one_of('object_symmetry', spec.object_symmetry, _SYMMETRIES)
    _require_one_of('looks_like', spec.looks_like, (None, *known))
    if spec.formulas is None and not any(_is_observed_as(spec, each) for each in known.values()):
        raise ValueError('it has no formulas')
    # Kept by `replace`, it would take the place of the environment of that id.
    return replace(spec, reference_id=None)


def _require_name(name: str, spec: TaskSpec, known: Collection[str]) -> None:
    if spec.name != name:
        raise ValueError(f'the task calls itself {spec.name!r}')
    if name in known:
        raise ValueError('one of the thirteen has this name')
    if not _NAME.fullmatch(name) or len(name) > _LONGEST_NAME:
        raise ValueError(
            f'a name has letters, digits, _, - and . only, {_LONGEST_NAME} at most, not {name!r}'
        )


def _require_types(spec: TaskSpec) -> None:
    if not isinstance(spec.robot, RobotSpec):
        raise ValueError(f'robot is no RobotSpec but {type(spec.robot).__name__}')
    if not isinstance(spec.goal, GoalKind):
        raise ValueError(f'goal is no GoalKind but {type(spec.goal).__name__}')
    if not isinstance(spec.formulas, TaskFormulas | None):
        raise ValueError(f'formulas is no TaskFormulas but {type(spec.formulas).__name__}')
    try:
        hash(spec)
    except TypeError as error:
        raise ValueError(f'{error}: its fields take tuples, not lists or arrays') from None


def _require_observation(spec: TaskSpec) -> None:
    """Refuses parts without whole sizes, and an achieved goal that is none of them."""
    for part in spec.observation:
        if not isinstance(part, VectorPart):
            raise ValueError(f'observation has {part!r:.60}, which is no VectorPart')
        if not isinstance(part.size, Integral) or part.size < 1:
            raise ValueError(f'observation {part.name} has size {part.size!r}; allowed: 1 or more')
    achieved = [part.size for part in spec.observation if part.name == spec.achieved_goal]
    if achieved != [spec.goal.size]:
        raise ValueError(
            f'achieved_goal {spec.achieved_goal!r} must be the name of one part of the observation '
            f'with {spec.goal.size} values'
        )


def _require_robot(robot: RobotSpec) -> None:
    """Refuses a robot without joints, or whose units or limits are none."""
    units = robot.joint_units
    if not robot.joints or len(units) != len(robot.joints) or not {'m', 'rad'}.issuperset(units):
        raise ValueError(
            f'{robot.name} has {len(robot.joints)} joints with units {units!r:.60}; allowed: one '
            "joint or more, and 'm' or 'rad' for each"
        )
    for part in robot.command:
        if not isinstance(part, CommandPart):
            raise ValueError(f'command has {part!r:.60}, which is no CommandPart')
        limits = part.lower, part.upper
        if not all(isinstance(limit, Real) for limit in limits):
            raise ValueError(f'command {part.name} has limits {limits}; allowed: two numbers')
        if not -_INFINITE < part.lower < part.upper < _INFINITE:
            raise ValueError(
                f'command {part.name} has limits {part.lower:g} ... {part.upper:g}; allowed: '
                'finite, the lower below the upper'
            )


def _require_above_zero(name: str, value: Any) -> None:
    if not isinstance(value, Real) or not 0.0 < float(value) < _INFINITE:
        raise ValueError(f'{name} {value!r}; allowed: a number of more than 0')


def _require_one_of(name: str, given: Any, allowed: tuple[str | None, ...]) -> None:
    if given not in allowed:
        hint = did_you_mean(str(given), filter(None, allowed))
        raise ValueError(f'{name} {given!r}; allowed: {", ".join(map(str, allowed))}{hint}')


def _is_observed_as(spec: TaskSpec, known: TaskSpec) -> bool:
    """Whether the formulas of one of the thirteen make what a task says it observes."""
    names = ('robot', 'goal', 'observation', 'object_name', 'achieved_goal')
    return all(getattr(spec, name) == getattr(known, name) for name in names)
