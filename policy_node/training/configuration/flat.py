"""Read and write the fields of `TrainConfig` by name.

Values come from options, `--set`, `train(**fields)`, recipes and stored runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from msgs_spec.text import did_you_mean
from policy_node.training.configuration.config import (
    DEFAULTS,
    FIELDS,
    LARGEST,
    NEEDS,
    WITHOUT_EFFECT,
    Field,
    TrainConfig,
)

# Fields of earlier versions that no recipe and no study used, with their defaults.
REMOVED: dict[str, Any] = {
    'cut_distance': 0.3,
    'episode_weights': 'moved',
    'random_steps': 0,
    'reward_distance': 1.0,
    'reward_rotation': 1.0,
    'noise_spread': 0.0,
    'retry_failed': 0.0,
    'narrow_above': 0.0,
    'reward_apart': 0.0,
    'target_noise': 0.0,
    'temporal_smoothness': 0.0,
    'future_only_steps': 0,
}
# Fields for studies; `--help-research` shows them.
RESEARCH = (
    'algorithm subgoal_every trace importance first_value first_action_gain gamble first_distance '
    'first_rotation noise_seconds parameter_noise target discount critics aggregate norm quantiles '
    'n_step correction longest_hold advantage condition widest_threshold goal_choice subgoal_prior '
    'imagination_interval ticks_after_drop drop_is_lost reward_grades critic_first start_share '
    'disturbance_scales'
).split()
# Shorter names of options.
_SHORT = {'total_steps': '--steps', 'simulation_threads': '--threads'}


def to_flat(config: TrainConfig) -> dict[str, Any]:
    """Return the values of all fields by name."""
    return {name: getattr(config, name) for name in FIELDS}


def from_flat(fields: Mapping[str, Any], **changes: Any) -> TrainConfig:
    """Build a configuration from values by field name; missing fields get their default.

    Args:
        fields: Values of a recipe or a stored run. Fields without effect get their default, for
            example fields of `ddpg` with `algorithm=ppo`.
        **changes: Values set by the user, which replace those in `fields`.

    Raises:
        ValueError: If a field is unknown, a value is not allowed, fields exclude each other, or a
            value in `changes` has no effect with the other fields.
    """
    values = types.SimpleNamespace(**{**DEFAULTS, **typed_fields(fields), **typed_fields(changes)})
    if not hasattr(values, 'task'):
        raise ValueError('task is missing')
    for names, needed, holds in NEEDS:
        if holds(values):
            continue
        for name in names.split():
            given, idle = getattr(values, name), WITHOUT_EFFECT.get(name, DEFAULTS[name])
            if name in changes and given not in (idle, DEFAULTS[name]):
                raise ValueError(f'{name} {given!r} has no effect: it needs {needed}')
            setattr(values, name, idle)
    return TrainConfig(**vars(values))


def changed(config: TrainConfig, **changes: Any) -> TrainConfig:
    """Return a copy of a configuration with the fields in `changes` replaced.

    Raises:
        ValueError: If a field is unknown, or a value is not allowed or has no effect with the
            other fields.
    """
    return from_flat(to_flat(config), **changes)


def config_from_dict(values: Mapping[str, Any], **changes: Any) -> TrainConfig:
    """Rebuild the configuration of a stored run from JSON values, with `changes` by the user.

    Missing fields get their default. Fields that a later version removed are ignored;
    `removed_fields` returns them.

    Raises:
        ValueError: If a field is unknown or a value is not allowed.
    """
    kept = {name: value for name, value in values.items() if name not in REMOVED}
    return from_flat(kept, **changes)


def removed_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of removed fields, by name, that differ from the field's former default."""
    return {n: values[n] for n, default in REMOVED.items() if values.get(n, default) != default}


def typed_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert values, by name of a field of `TrainConfig`, to the types of these fields.

    NumPy scalars become Python numbers, lists become tuples, and integers become floats in float
    fields. Text for `goals` and `reward_grades` is parsed.

    Raises:
        ValueError: If a field is unknown or a value is not of its type.
    """
    found = {}
    for name, value in values.items():
        _require_field(name)
        is_text = isinstance(value, str) and name in ('goals', 'reward_grades')
        kind = FIELDS[name].kind
        found[name] = parse_value(name, value) if is_text else _typed(name, value, kind)
    return found


def _require_field(name: str) -> None:
    """Raise ValueError if `TrainConfig` has no field `name`; suggest the field of an option."""
    if name in FIELDS:
        return
    meanings = {name: name for name in FIELDS} | {'her': 'strategy'}
    meanings |= {option.removeprefix('--'): field for field, option in _SHORT.items()}
    near = did_you_mean(name, meanings) or f'; allowed: {", ".join(FIELDS)}'
    raise ValueError(f'{name[:80]!r} is no field of TrainConfig{near}')


def _typed(name: str, value: Any, kind: Any) -> Any:
    origin = typing.get_origin(kind)
    if origin is tuple and isinstance(value, list | tuple):
        part = typing.get_args(kind)[0]
        return tuple(_typed(name, each, part) for each in value)
    if origin is dict and isinstance(value, dict):
        return {str(key): _typed(name, each, float) for key, each in value.items()}
    value = value.item() if isinstance(value, np.generic) else value
    if kind is float and type(value) is int and abs(value) <= LARGEST:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f'{name} {value!r:.80} is not of type {_type_name(kind)}')
    return value


def _type_name(kind: Any) -> str:
    return str(kind) if isinstance(kind, types.GenericAlias) else str(kind.__name__)


def parse_assignment(text: str) -> tuple[str, Any]:
    """Parse `name=value`; return the name of the field and the value, converted to its type.

    Raises:
        ValueError: If the field is unknown or the value does not fit its type.
    """
    name, separator, value = text.partition('=')
    _require_field(name)
    if not separator:
        raise ValueError(f'{text!r} is not name=value: give {name}=...')
    return name, parse_value(name, value)


def parse_value(name: str, text: str) -> Any:
    """Parse `text` into the type of the field `name`; ValueError if it does not fit."""
    kind = FIELDS[name].kind
    try:
        return _parse(text, kind)
    except ValueError:
        form = {dict: 'name=share with commas', tuple: 'numbers with commas: N,N,...'}
        wanted = form.get(typing.get_origin(kind) or kind, f'of type {_type_name(kind)}')
        raise ValueError(f'{name} {text!r} is not {wanted}') from None


def _parse(text: str, kind: Any) -> Any:
    if kind is bool:
        if text.lower() not in ('true', 'false', '1', '0'):
            raise ValueError(text)
        return text.lower() in ('true', '1')
    if typing.get_origin(kind) is tuple:
        part = typing.get_args(kind)[0]
        return tuple(part(each) for each in text.split(',') if each)
    if typing.get_origin(kind) is dict:
        pairs = [part.strip().partition('=')[::2] for part in text.split(',') if part]
        if len(dict(pairs)) < len(pairs):
            raise ValueError(text)
        return {source: float(share) for source, share in pairs}
    return whole(text) if kind is int else kind(text)


def whole(text: str) -> int:
    """Parse an integer, which may be written as `1_000_000` or `1e6`.

    Raises:
        ValueError: If the number is not an integer, or is written as a float above 2**53.
    """
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if not number.is_integer() or abs(number) > LARGEST:
            raise
        return int(number)


def value_text(value: Any) -> str:
    """Return a value of a field as text in the form that `--set` reads."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ','.join(map(value_text, value))
    if isinstance(value, dict):
        return ','.join(f'{name}={value_text(share)}' for name, share in value.items())
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def add_field_options(parser: argparse.ArgumentParser, without: tuple[str, ...]) -> None:
    """Add an option for each field to `parser`, for example `--learning-rate` for `learning_rate`.

    Options that the user does not give are None. `--help` shows the options by group, except those
    for studies, which `--help-research` shows. Fields named in `without` get no option.
    """
    research = argparse.ArgumentParser(
        prog=parser.prog, usage='fields for studies (docs/research)', add_help=False
    )
    parser.add_argument(
        '--help-research', action=_ResearchHelp, page=research, help='show the fields for studies'
    )
    groups: dict[str, Any] = {}
    for name, each in FIELDS.items():
        if name in without:
            continue
        if name in RESEARCH:
            add_field_option(research, each)
            add_field_option(parser, dataclasses.replace(each, meaning=argparse.SUPPRESS))
            continue
        if each.group not in groups:
            groups[each.group] = parser.add_argument_group(each.group)
        add_field_option(groups[each.group], each)


class _ResearchHelp(argparse.Action):
    """Action of `--help-research`: print the options for studies and exit."""

    def __init__(self, *arguments: Any, page: argparse.ArgumentParser, **options: Any) -> None:
        super().__init__(*arguments, **{**options, 'nargs': 0})
        self._page = page

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        self._page.print_help()
        parser.exit()


def _option_names(name: str) -> list[str]:
    """Return the options of a field, the shorter one first."""
    short = [_SHORT[name]] if name in _SHORT else []
    return [*short, f'--{name.replace("_", "-")}']


def add_field_option(group: Any, each: Field) -> None:
    """Add the option for a field to a parser or a group of options."""
    names = _option_names(each.name)
    options: dict[str, Any] = {'dest': each.name, 'help': each.meaning.replace('%', '%%')}
    if each.kind is bool:
        group.add_argument(*names, action=argparse.BooleanOptionalAction, **options)
        return
    metavar = {int: 'N', float: 'X', str: 'TEXT', dict[str, float]: 'NAME=X,...'}
    shown = '{' + ','.join(each.choices) + '}' if each.choices else metavar.get(each.kind)

    def read(text: str) -> Any:
        try:
            return parse_value(each.name, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    group.add_argument(*names, type=read, metavar=shown or 'X,X,...', **options)


def given_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields that were given as options on the command line, by name."""
    return {n: value for n, value in vars(options).items() if n in FIELDS and value is not None}


def with_assignments(given: dict[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return the values given by options and by `--set`, by field.

    Args:
        assignments: Texts `name=value` of `--set`; the last one for a field counts.

    Raises:
        ValueError: If an assignment is invalid or contradicts the option of its field.
    """
    assigned = dict(parse_assignment(text) for text in assignments)
    for name, value in assigned.items():
        if name in given and given[name] != value:
            option = f'{_option_names(name)[0]} {given[name]}'
            raise ValueError(f'{option} excludes --set {name}={value_text(value)}')
    return {**given, **assigned}
