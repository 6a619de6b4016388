"""The disturbances of a robustness curve, their levels, and which ones a policy withstands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from msgs_spec.disturbances import PRESETS, Disturbances
from msgs_spec.tasks import TaskSpec

# Share of the undisturbed success that counts as kept.
KEPT = 0.9


@dataclass(frozen=True, slots=True)
class Sweep:
    """One disturbance at rising levels.

    Attributes:
        unit: Unit of the levels as text, such as `rad` or `of half the range`.
        levels: Levels, mildest first.
        at: Function from a level to the argument of `Disturbances.from_dict`.
        needs_object: Whether it applies only to tasks with an object.
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    at: Callable[[float], dict[str, Any]]
    needs_object: bool = False


def _ticks(group: str, *more: str) -> Callable[[float], dict[str, Any]]:
    return lambda level: {name: {'latency': int(level)} for name in (group, *more)}


def _one(group: str, name: str) -> Callable[[float], dict[str, Any]]:
    return lambda level: {group: {name: level}}


def _factors(*names: str) -> Callable[[float], dict[str, Any]]:
    """Return a function from a level to disturbances of the physics.

    They multiply the parameters `names` by random factors between 1/level and level.
    """
    return lambda level: {'physics': {name: [1.0 / level, level] for name in names}}


_TICKS = (1.0, 2.0, 3.0, 4.0)
_SPREADS = (1.1, 1.25, 1.5, 2.0, 3.0)
SWEEPS = (
    Sweep('action latency', 'ticks', _TICKS, _ticks('action')),
    Sweep('sensor latency', 'ticks', _TICKS, _ticks('joints', 'object')),
    Sweep('repeated commands', 'probability', (0.1, 0.2, 0.3, 0.5, 0.7), _one('action', 'repeat')),
    Sweep('action noise', 'of half the range', (0.05, 0.1, 0.2, 0.3, 0.5), _one('action', 'noise')),
    Sweep('joint noise', 'rad', (0.005, 0.01, 0.02, 0.05, 0.1), _one('joints', 'noise')),
    Sweep('joint offset', 'rad', (0.005, 0.01, 0.02, 0.05, 0.1), _one('joints', 'bias')),
    Sweep(
        'object noise',
        'm, 5 x rad',
        (0.002, 0.005, 0.01, 0.02, 0.05),
        lambda level: {'object': {'noise': level, 'rotation_noise': min(5.0 * level, 0.5)}},
        needs_object=True,
    ),
    Sweep('friction', 'factor', _SPREADS, _factors('friction')),
    Sweep('actuators', 'factor', _SPREADS, _factors('gain', 'damping')),
    Sweep(
        'pushes',
        'of the weight, 1 Hz',
        (0.25, 0.5, 1.0, 2.0, 4.0),
        lambda level: {'pushes': {'force': level, 'rate': 1.0}},
    ),
)


@dataclass(frozen=True, slots=True)
class Point:
    """An evaluation under a disturbance at a level, a preset (level 1) or `none` (level 0)."""

    name: str
    level: float
    disturbances: Disturbances

    @property
    def key(self) -> str:
        """Key of this point in the result file, '<name> <level>', such as 'friction 1.5'."""
        return f'{self.name} {self.level:g}'


def points(spec: TaskSpec) -> Iterator[Point]:
    """Yield the undisturbed evaluation, then all levels of the task's sweeps, then the presets."""
    yield Point('none', 0.0, Disturbances())
    for sweep in sweeps_of(spec):
        for level in sweep.levels:
            yield Point(sweep.name, level, Disturbances.from_dict(sweep.at(level)))
    for name, preset in PRESETS.items():
        yield Point(name, 1.0, preset)


def sweeps_of(spec: TaskSpec) -> Sequence[Sweep]:
    """Return the sweeps that apply to a task."""
    return [sweep for sweep in SWEEPS if spec.has_object or not sweep.needs_object]


def kept_up_to(sweep: Sweep, success: Mapping[str, float], undisturbed: float) -> float | None:
    """Return the highest level up to which a policy keeps 90 % of the success rate `undisturbed`.

    `success` has success rates by `Point.key`. Return None if it is lower at the first level.
    """
    kept = None
    for level in sweep.levels:
        if success[f'{sweep.name} {level:g}'] < KEPT * undisturbed:
            break
        kept = level
    return kept


def sentence(spec: TaskSpec, control_hz: float, success: Mapping[str, float]) -> str:
    """Return a sentence: up to which level of each disturbance a policy keeps 90 % of its success.

    `success` has success rates by `Point.key`; `control_hz` converts latencies from ticks to ms.
    """
    if not success['none 0']:
        return f'{spec.name}: no success without disturbances, so there is none to keep.'
    kept, lost = [], []
    for sweep in sweeps_of(spec):
        level = kept_up_to(sweep, success, success['none 0'])
        if level is None:
            lost.append(f'{_amount(sweep, sweep.levels[0], control_hz)} {sweep.name}')
        else:
            end = ' (the highest level)' if level == sweep.levels[-1] else ''
            kept.append(f'{_amount(sweep, level, control_hz)} {sweep.name}{end}')
    share = f'{spec.name} keeps {KEPT:.0%} of its undisturbed success ({success["none 0"]:.2f})'
    text = f'{share} up to {", ".join(kept)}' if kept else f'{share} under no disturbance'
    return f'{text}; not with {", ".join(lost)}.' if lost else f'{text}.'


def _amount(sweep: Sweep, level: float, control_hz: float) -> str:
    if sweep.unit == 'ticks':
        return f'{1000.0 * level / control_hz:.0f} ms'
    if sweep.unit == 'factor':
        return f'x{level:g}'
    return f'{level:g} rad' if sweep.unit == 'rad' else f'{level:g}'
