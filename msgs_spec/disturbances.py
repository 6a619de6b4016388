"""Disturbances of a robot as data: delays, noise, lost commands, changed physics and pushes.

Everything is off by default. Sources of the ranges are in `docs/robustness.md`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from msgs_spec.text import did_you_mean, entries, one_line

Span = tuple[float, float]

# The longest delay, in ticks.
MOST_TICKS = 4
# Bytes of a file of disturbances.
_LONGEST_FILE = 100_000


@dataclass(frozen=True, slots=True)
class Kind:
    """Limits and meaning of a field of a disturbance.

    Attributes:
        off: The value that switches the disturbance off; `lowest` ... `highest` are allowed.
        is_range: Whether a value is a pair (low, high), from which each episode draws a number. A
            single number n then means (n, n).
        is_whole: Whether the number is whole, such as a delay in ticks.
        is_factor: Whether the number is a factor, which is scaled and drawn on a log scale.
    """

    off: float
    lowest: float
    highest: float
    is_range: bool = True
    is_whole: bool = False
    is_factor: bool = False

    def checked(self, name: str, value: Any) -> Any:
        """Return the field `name` as a number or, for ranges, a pair; ValueError if not allowed."""
        given = list(value) if self.is_range and isinstance(value, (list, tuple)) else [value]
        is_right = len(given) in (1, 1 + self.is_range) and all(
            isinstance(each, (int, float, np.integer, np.floating))
            and not isinstance(each, bool)
            and self.lowest <= each <= self.highest
            and not (self.is_whole and each != int(each))
            for each in given
        )
        if not is_right or given[0] > given[-1]:
            raise ValueError(
                f'{name}={one_line(repr(value), 40)}; allowed: a '
                f'{"whole " if self.is_whole else ""}number {self.lowest:g} ... {self.highest:g}'
                f'{", or [lowest, highest]" if self.is_range else ""}'
            )
        numbers = [int(each) if self.is_whole else float(each) for each in given]
        return (numbers[0], numbers[-1]) if self.is_range else numbers[0]

    def scaled(self, value: Any, strength: float) -> Any:
        """Return a number, or each of a pair, scaled by `strength` and clipped to the limits.

        A factor becomes `value ** strength`, another number `off + strength * (value - off)`.
        """
        if isinstance(value, tuple):
            return tuple(self.scaled(each, strength) for each in value)
        change = strength * (value - self.off)
        moved = self.off + (round(change) if self.is_whole else change)
        return min(max(value**strength if self.is_factor else moved, self.lowest), self.highest)

    def drawn(self, span: Span, share: float) -> float:
        """Return the number at `share`, 0 <= share < 1, of `span`; factors use a log scale."""
        lowest, highest = span
        if self.is_whole:
            return float(lowest + int(share * (highest - lowest + 1)))
        if self.is_factor:
            return float(lowest * (highest / lowest) ** share)
        return float(lowest + share * (highest - lowest))


SIZE = Kind(0.0, 0.0, 100.0, is_range=False)
PROBABILITY = Kind(0.0, 0.0, 1.0, is_range=False)
FACTOR = Kind(1.0, 0.05, 20.0, is_factor=True)
TICKS = Kind(0, 0, MOST_TICKS, is_whole=True)
PERIOD = Kind(1, 1, 100, is_whole=True)
SHIFT = Kind(0.0, -1.0, 1.0)


def _off(kind: Kind) -> Any:
    """Return a dataclass field with the limits `kind`; its default is the off value."""
    default = (kind.off, kind.off) if kind.is_range else kind.off
    return field(default=default, metadata={'kind': kind})


@dataclass(frozen=True)
class _Group:
    """Base class of groups such as `PushDisturbance`; `Kind.checked` converts each field."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = each.metadata['kind'].checked(each.name, getattr(self, each.name))
            object.__setattr__(self, each.name, value)


@dataclass(frozen=True)
class ActionDisturbance(_Group):
    """Errors of commands on their way to the motors.

    Attributes:
        latency: Delay, ticks.
        repeat: Probability per tick that the last command is applied again.
        drop: Probability per tick that a command is lost: the gripper stays, the hand keeps its
            targets.
        noise: Standard deviation of white noise, as a share of half the command range.
        bias: Standard deviation of an offset that lasts an episode, as a share of the same range.
    """

    latency: Span = _off(TICKS)
    repeat: float = _off(PROBABILITY)
    drop: float = _off(PROBABILITY)
    noise: float = _off(SIZE)
    bias: float = _off(SIZE)


@dataclass(frozen=True)
class JointDisturbance(_Group):
    """Errors of the joint sensors, and of the poses computed from them (gripper, fingertips).

    Attributes:
        latency: Delay, ticks. Sliding joints have only this error.
        noise: Standard deviation of white noise, rad.
        bias: Standard deviation of an offset that lasts an episode, rad.
        velocity_noise: Standard deviation of white noise, rad/s.
        resolution: Step of the encoders, rad.
    """

    latency: Span = _off(TICKS)
    noise: float = _off(SIZE)
    bias: float = _off(SIZE)
    velocity_noise: float = _off(SIZE)
    resolution: float = _off(SIZE)


@dataclass(frozen=True)
class ObjectDisturbance(_Group):
    """Errors of the tracked object pose.

    Attributes:
        latency: Delay, ticks.
        noise: Standard deviation of white noise per axis, m.
        bias: Standard deviation of an offset that lasts an episode, per axis, m.
        rotation_noise: Standard deviation of white noise per axis, rad.
        rotation_bias: Standard deviation of an offset that lasts an episode, per axis, rad.
        period: Ticks between two measurements; between them, the last one is repeated.
        stale: Probability per tick that a measurement is missing.
        lost: Probability per tick that tracking is lost for half a second.
    """

    latency: Span = _off(TICKS)
    noise: float = _off(SIZE)
    bias: float = _off(SIZE)
    rotation_noise: float = _off(SIZE)
    rotation_bias: float = _off(SIZE)
    period: Span = _off(PERIOD)
    stale: float = _off(PROBABILITY)
    lost: float = _off(PROBABILITY)


@dataclass(frozen=True)
class PhysicsDisturbance(_Group):
    """Physics that differs from the model during an episode; factors multiply model values.

    Attributes:
        friction: Factor of all sliding, torsional and rolling friction.
        object_mass: Factor of the object's mass.
        object_size: Factor of the object's size; its mass stays.
        gain: Factor of the gain of the position actuators (hand, gripper fingers).
        force_limit: Factor of the largest actuator force (hand).
        damping: Factor of the damping of the driven joints (hand).
        gravity_tilt: Largest angle between gravity and the vertical, rad; its direction is random.
        table_height: Shift of the table and of the object on it, m (Fetch).
    """

    friction: Span = _off(FACTOR)
    object_mass: Span = _off(FACTOR)
    object_size: Span = _off(FACTOR)
    gain: Span = _off(FACTOR)
    force_limit: Span = _off(FACTOR)
    damping: Span = _off(FACTOR)
    gravity_tilt: float = _off(SIZE)
    table_height: Span = _off(SHIFT)


@dataclass(frozen=True)
class PushDisturbance(_Group):
    """Random pushes of one tick; they act on the object, or without one on gripper or palm.

    Attributes:
        force: Standard deviation of the force per axis, as a share of the pushed body's weight.
        rate: Mean number of pushes per simulated second.
    """

    force: float = _off(SIZE)
    rate: float = _off(SIZE)


@dataclass(frozen=True)
class StartDisturbance(_Group):
    """Random changes of the start states that the task draws.

    Attributes:
        object_position: Largest shift of the object, horizontally, per axis, m.
        joints: Standard deviation of an offset of each joint, rad (hand).
    """

    object_position: float = _off(SIZE)
    joints: float = _off(SIZE)


@dataclass(frozen=True)
class Disturbances:
    """All disturbances of a simulated robot; each group is off by default."""

    action: ActionDisturbance = ActionDisturbance()
    joints: JointDisturbance = JointDisturbance()
    object: ObjectDisturbance = ObjectDisturbance()
    physics: PhysicsDisturbance = PhysicsDisturbance()
    pushes: PushDisturbance = PushDisturbance()
    start: StartDisturbance = StartDisturbance()

    @property
    def is_off(self) -> bool:
        """True if nothing is disturbed."""
        return self == Disturbances()

    def scaled(self, factor: float) -> Disturbances:
        """Return the disturbances `factor` times as strong, within the limits of each value.

        The difference of a value from its off value is multiplied by `factor`; ticks are rounded.
        Values that are factors are raised to the power of `factor`: 0.5 scaled by 2 is 0.25.
        """
        groups = {}
        for group in fields(self):
            values = getattr(self, group.name)
            changes = {
                each.name: each.metadata['kind'].scaled(getattr(values, each.name), factor)
                for each in fields(values)
            }
            groups[group.name] = dataclasses.replace(values, **changes)
        return dataclasses.replace(self, **groups)

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """Return the values that are not off, by group and field; `from_dict` reads the result."""
        found: dict[str, dict[str, Any]] = {}
        for group in fields(self):
            for each in fields(getattr(self, group.name)):
                value = getattr(getattr(self, group.name), each.name)
                if value != each.default:
                    plain = list(value) if isinstance(value, tuple) else value
                    found.setdefault(group.name, {})[each.name] = plain
        return found

    def to_json(self) -> str:
        """Return `as_dict` as JSON text, which `from_json` and `read_disturbances` read."""
        return json.dumps(self.as_dict())

    @classmethod
    def from_json(cls, text: str) -> Disturbances:
        """Return the disturbances of a JSON text from `to_json`; ValueError if it is invalid."""
        try:
            return cls.from_dict(json.loads(text))
        except RecursionError:
            raise ValueError('disturbances: JSON is nested too deep') from None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Disturbances:
        """Return the disturbances of a mapping from `as_dict`; ValueError if it is invalid."""
        groups: dict[str, Any] = {each.name: type(each.default) for each in fields(cls)}
        found: dict[str, Any] = {}
        for name, given in entries('disturbances', values, list(groups)).items():
            values = entries(name, given, [each.name for each in fields(groups[name])])
            try:
                found[name] = groups[name](**values)
            except ValueError as error:
                raise ValueError(f'{name}.{error}') from None
        return cls(**found)


def read_disturbances(given: str | Mapping[str, Any] | Disturbances | None) -> Disturbances:
    """Read disturbances in any form that users may give.

    Args:
        given: A preset (`mild`, `hardware`, `severe`), optionally scaled (`hardware*0.5`); the path
            of a JSON or YAML file; JSON text that begins with `{`; a mapping; `Disturbances`; or
            `none`, `off`, '' or None for no disturbances. Invalid values raise ValueError.
    """
    if given is None or given in ('', 'none', 'off'):
        return Disturbances()
    if isinstance(given, Disturbances):
        return given
    if not isinstance(given, str):
        return Disturbances.from_dict(given)
    name, star, scale = given.partition('*')
    if name in PRESETS:
        return PRESETS[name].scaled(_scale(scale) if star else 1.0)
    if given.startswith('{'):
        return Disturbances.from_dict(_parsed(given))
    path = Path(os.path.expanduser(given))
    if not os.path.isfile(path):
        allowed = ', '.join(['none', *PRESETS])
        raise ValueError(
            f'disturbances {given[:80]!r} is neither a file nor a preset; allowed: {allowed}, '
            f'scaled as in hardware*0.5{did_you_mean(name, list(PRESETS))}'
        )
    if path.stat().st_size > _LONGEST_FILE:
        raise ValueError(f'{path}: larger than {_LONGEST_FILE:,} bytes')
    try:
        return Disturbances.from_dict(_parsed(path.read_text(errors='replace')))
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        import yaml

        try:
            if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
                # Nested aliases would make gigabytes of a short text.
                raise ValueError('aliases are not allowed')
            return yaml.safe_load(text)
        except Exception as error:  # PyYAML raises unrelated types, such as KeyError for `!!bool x`
            raise ValueError(f'neither JSON nor YAML: {one_line(error)}') from None


def _scale(text: str) -> float:
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 0.0 <= scale <= 10.0:
        raise ValueError(f'scale {text[:20]!r} of disturbances; allowed: 0 ... 10')
    return scale


# `docs/robustness.md` gives the source of each range.
_HARDWARE = Disturbances(
    action=ActionDisturbance(latency=(0, 1), repeat=0.05, drop=0.02, noise=0.05, bias=0.015),
    joints=JointDisturbance(
        latency=(0, 1), noise=0.005, bias=0.01, velocity_noise=0.05, resolution=0.0015
    ),
    object=ObjectDisturbance(
        latency=(0, 1),
        noise=0.003,
        bias=0.003,
        rotation_noise=0.03,
        rotation_bias=0.03,
        period=(1, 2),
        stale=0.1,
        lost=0.002,
    ),
    physics=PhysicsDisturbance(
        friction=(0.7, 1.3),
        object_mass=(0.7, 1.3),
        object_size=(0.97, 1.03),
        gain=(0.8, 1.2),
        force_limit=(0.8, 1.2),
        damping=(0.7, 1.5),
        gravity_tilt=0.03,
        table_height=(-0.003, 0.003),
    ),
    pushes=PushDisturbance(force=0.3, rate=0.5),
    start=StartDisturbance(object_position=0.003, joints=0.01),
)
PRESETS: Mapping[str, Disturbances] = {
    'mild': _HARDWARE.scaled(0.5),
    'hardware': _HARDWARE,
    'severe': _HARDWARE.scaled(2.0),
}
