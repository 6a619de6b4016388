"""The one table between flat field names and the groups of `TrainConfig`, and what users write.

Flat names are those of `--set`, of `train(**fields)`, of options and of stored runs, also of
versions whose configuration had no groups.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import itertools
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from msgs_spec.text import did_you_mean
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import (
    LARGEST,
    Checked,
    Hierarchical,
    Learner,
    Ppo,
    Range,
    choices_of,
    plain_type,
    range_of,
    type_name,
    typed,
    types_of,
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
# Values of `marks` where no group sets them.
_UNMARKED = {
    'algorithm': 'ddpg',
    'reward_type': 'sparse',
    'condition': 'none',
    'importance': 'none',
}
_MARK_CHOICES = {
    'algorithm': ('ddpg', 'ppo', 'imitation'),
    'reward_type': ('sparse', 'dense'),
    'condition': ('none', 'threshold', 'horizon'),
    'importance': ('none', 'density', 'decision'),
}
_MARK_MEANINGS = {
    'algorithm': '`ddpg`, `ppo` (on policy: each cycle once, also with goals in hindsight) or '
    '`imitation` of the policy in `init_from`, which sees the true state.',
    'reward_type': '`sparse` (-1 until success, then 0) or `dense` (negative distance).',
    'condition': 'An input more for actor and critic: `threshold` (log-uniform, .5 ... '
    '`widest_threshold` times that of success, also in the reward) or `horizon` (steps left, whose '
    'rewards are the value). The actor acts at the threshold of the task and with a whole episode '
    'left.',
}
# Fields for studies; `--help-research` shows them.
RESEARCH = (
    'algorithm subgoal_every trace importance first_value first_action_gain gamble first_distance '
    'first_rotation noise_seconds parameter_noise target discount critics aggregate norm quantiles '
    'n_step correction longest_hold advantage condition widest_threshold goal_choice subgoal_prior '
    'imagination_interval ticks_after_drop drop_is_lost reward_grades critic_first '
    'disturbance_scales'
).split()
# Former and shorter names of options.
_OTHER_NAMES = {'total_steps': ('--steps',), 'simulation_threads': ('--threads',)}


def _groups_in(kind: Any) -> list[type[Checked]]:
    """Return the groups that a field may hold; for a plain value none."""
    parts = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
    return [part for part in parts if isinstance(part, type) and issubclass(part, Checked)]


@dataclasses.dataclass(frozen=True, slots=True)
class Field:
    """One flat field.

    Attributes:
        default: Its value where no group has it.
        group: Title of the first group that has it.
    """

    name: str
    kind: Any
    default: Any
    meaning: str
    group: str

    @property
    def choices(self) -> tuple[str, ...]:
        """Allowed values of a field that has a few."""
        return _MARK_CHOICES.get(self.name) or choices_of(self.kind)

    @property
    def limits(self) -> Range | None:
        """Allowed range of a number."""
        return range_of(self.kind)


def _walk(group: type[Checked]) -> Iterator[Field]:
    """Yield the flat fields of a group and of the groups in it; names may come twice."""
    title = (group.__doc__ or '').splitlines()[0].rstrip('.')
    meanings = field_docstrings(group)
    for name, value in {**_UNMARKED, **group.marks}.items():
        if name in group.marks and name in _UNMARKED:
            meaning = _MARK_MEANINGS.get(name, '')
            yield Field(name, str, _UNMARKED.get(name, value), meaning, title)
    for each in dataclasses.fields(group):  # type: ignore[arg-type]
        kind = types_of(group)[each.name]
        inner = _groups_in(kind)
        for part in inner:
            yield from _walk(part)
        if not inner:
            default = each.default
            if each.default_factory is not dataclasses.MISSING:
                default = each.default_factory()
            yield Field(each.name, kind, default, meanings.get(each.name, ''), title)


def field_docstrings(kind: type) -> dict[str, str]:
    """Return the text below each field of a class and its bases, on one line."""
    found = {}
    for each in reversed(kind.__mro__):
        if each is object or not dataclasses.is_dataclass(each):
            continue
        (definition,) = ast.parse(inspect.getsource(each)).body
        assert isinstance(definition, ast.ClassDef)
        for field, below in itertools.pairwise(definition.body):
            match field, below:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = ' '.join(text.split())
    return found


def _all_fields() -> dict[str, Field]:
    found: dict[str, Field] = {}
    for each in _walk(TrainConfig):
        known = found.get(each.name)
        if known is None:
            found[each.name] = each
        elif not known.meaning or each.name == 'importance':
            kind = str if each.name in _UNMARKED else known.kind
            found[each.name] = dataclasses.replace(
                known, kind=kind, meaning=each.meaning or known.meaning
            )
    return found


FIELDS = _all_fields()
"""All fields by flat name, in the order of the groups."""
DEFAULTS = {name: each.default for name, each in FIELDS.items() if name != 'task'}


def to_flat(config: TrainConfig) -> dict[str, Any]:
    """Return all fields by flat name; those that the configuration does not have by default."""
    flat = {name: each.default for name, each in FIELDS.items()}
    _flatten(config, flat)
    return flat


def _flatten(group: Checked, flat: dict[str, Any]) -> None:
    flat |= group.marks
    for name in types_of(type(group)):
        value = getattr(group, name)
        if isinstance(value, Checked):
            _flatten(value, flat)
        elif name in flat:
            flat[name] = value


def from_flat(fields: Mapping[str, Any], **changes: Any) -> TrainConfig:
    """Build a configuration from flat fields.

    Args:
        fields: A recipe or a stored run. Fields of groups that the run does not have are ignored.
        **changes: Fields that the user gave. Each must have an effect or its default.

    Raises:
        ValueError: If a field is unknown, a value is not allowed, or fields exclude each other.
    """
    flat = {**DEFAULTS, **typed_fields(fields), **typed_fields(changes)}
    if 'task' not in flat:
        raise ValueError('task is missing')
    for name, allowed in _MARK_CHOICES.items():
        if flat[name] not in allowed:
            raise ValueError(f'{name} {flat[name]!r}; allowed: {", ".join(allowed)}')
    used: dict[str, Any] = {}
    config = _build(TrainConfig, flat, used)
    assert isinstance(config, TrainConfig)
    for name in changes:
        effective = used.get(name, DEFAULTS.get(name))
        if flat[name] not in (effective, DEFAULTS.get(name)):
            raise ValueError(
                f'{name} {flat[name]!r} has no effect: it needs {_needed(name, flat[name])}'
            )
    return config


def changed(config: TrainConfig, **changes: Any) -> TrainConfig:
    """Return a configuration with flat fields replaced.

    Raises:
        ValueError: As `from_flat`.
    """
    return from_flat(to_flat(config), **changes)


def _build(group: type[Checked], flat: Mapping[str, Any], used: dict[str, Any]) -> Checked:
    used |= group.marks
    values = {}
    for name, kind in types_of(group).items():
        inner = _groups_in(kind)
        if not inner:
            values[name] = used[name] = flat[name]
        elif chosen := _chosen(inner, flat):
            values[name] = _build(chosen, flat, used)
    return group(**values)


def _chosen(groups: list[type[Checked]], flat: Mapping[str, Any]) -> type[Checked] | None:
    """Return the group that the flat fields select, or the first or only one by default."""
    if len(groups) == 1 and not _selector(groups[0]):
        return groups[0]
    selected = [group for group in groups if _is_selected(group, flat)]
    if len(selected) > 1 and issubclass(selected[0], Learner):
        if Ppo in selected:
            raise ValueError(f'algorithm ppo excludes subgoal_every {flat["subgoal_every"]}')
        selected = [Hierarchical]
    if len(selected) > 1:
        names = [f'{_selector(each)} {flat[_selector(each)]}' for each in selected]
        raise ValueError(f'{names[0]} excludes {", ".join(names[1:])}')
    return selected[0] if selected else next((g for g in groups if not _selector(g)), None)


def _is_selected(group: type[Checked], flat: Mapping[str, Any]) -> bool:
    name = _selector(group)
    if name in group.marks:
        return bool(flat[name] == group.marks[name])
    return bool(name) and bool(flat[name] != DEFAULTS[name])


def _selector(group: type[Checked]) -> str:
    """Return the flat field that selects a group of several, '' for one that needs none."""
    if group.marks:
        return next(iter(group.marks))
    if group.__name__ in _ALTERNATIVES:
        return _ALTERNATIVES[group.__name__]
    return ''


_ALTERNATIVES = {
    'Hierarchical': 'subgoal_every',
    'Returns': 'n_step',
    'Held': 'longest_hold',
    'Advantages': 'advantage',
    'Chosen': 'goal_choice',
    'Imagined': 'subgoal_prior',
    'Drop': 'ticks_after_drop',
}


def _needed(name: str, value: Any) -> str:
    """Return the flat fields that select the groups which have a field with this value."""
    found = []
    for group in _all_groups(TrainConfig):
        selector = _selector(group)
        if selector and selector != name and name in types_of(group):
            if value in (choices_of(types_of(group)[name]) or [value]):
                default = f'other than {DEFAULTS[selector]}'
                found.append(f'{selector} {group.marks.get(selector, default)}')
    return ' or '.join(dict.fromkeys(found)) or 'algorithm ddpg and no subgoal_every'


def _all_groups(group: type[Checked]) -> Iterator[type[Checked]]:
    yield group
    for kind in types_of(group).values():
        for part in _groups_in(kind):
            yield from _all_groups(part)


def config_from_dict(values: Mapping[str, Any], **changes: Any) -> TrainConfig:
    """Rebuild a configuration that went through JSON; later fields have their default.

    Fields that were removed since are ignored: `removed_fields` returns them.

    Raises:
        ValueError: If a field is unknown or a value is not allowed.
    """
    kept = {name: value for name, value in values.items() if name not in REMOVED}
    return from_flat(kept, **changes)


def removed_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a stored run that had an effect and were removed in version 2.0."""
    return {n: values[n] for n, default in REMOVED.items() if values.get(n, default) != default}


def typed_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return flat fields with values of their types: lists become tuples, texts mixtures of goals.

    Raises:
        ValueError: If a field is unknown or a value is not of its type.
    """
    unknown = sorted(values.keys() - FIELDS.keys())
    if unknown:
        near = did_you_mean(unknown[0], list(FIELDS))
        raise ValueError(f'unknown configuration fields: {", ".join(unknown)}{near}')
    found = {}
    for name, value in values.items():
        kind = FIELDS[name].kind
        is_text = isinstance(value, str) and name in ('goals', 'reward_grades')
        found[name] = parse_value(name, value) if is_text else typed(name, value, kind)
    return found


def parse_assignment(text: str) -> tuple[str, Any]:
    """Parse `name=value` into a flat field and a value of its type.

    Raises:
        ValueError: If the field is unknown or the value does not fit its type.
    """
    name, separator, value = text.partition('=')
    if name not in FIELDS:
        near = did_you_mean(name, list(FIELDS))
        raise ValueError(f'{text!r} is not name=value{near}; names: {", ".join(FIELDS)}')
    if not separator:
        raise ValueError(f'{text!r} is not name=value: give {name}=...')
    return name, parse_value(name, value)


def parse_value(name: str, text: str) -> Any:
    """Parse the text of a flat field.

    Raises:
        ValueError: If it does not fit the field's type.
    """
    kind = plain_type(FIELDS[name].kind)
    try:
        return _parse(text, kind)
    except ValueError:
        form = {dict: 'name=share with commas', tuple: 'numbers with commas: N,N,...'}
        wanted = form.get(typing.get_origin(kind) or kind, f'of type {type_name(kind)}')
        raise ValueError(f'{name} {text!r} is not {wanted}') from None


def _parse(text: str, kind: Any) -> Any:
    if kind is bool:
        return {'true': True, 'false': False, '1': True, '0': False}[_known_bool(text)]
    if typing.get_origin(kind) is tuple:
        part = typing.get_args(kind)[0]
        return tuple(part(each) for each in text.split(',') if each)
    if typing.get_origin(kind) is dict:
        pairs = [part.strip().partition('=')[::2] for part in text.split(',') if part]
        if len(dict(pairs)) < len(pairs):
            raise ValueError(text)
        return {source: float(share) for source, share in pairs}
    return whole(text) if kind is int else kind(text)


def _known_bool(text: str) -> str:
    if text.lower() not in ('true', 'false', '1', '0'):
        raise ValueError(text)
    return text.lower()


def whole(text: str) -> int:
    """Read a whole number, also as `1_000_000` and `1e6`.

    Raises:
        ValueError: If it is not whole, or a float may have rounded it.
    """
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if not number.is_integer() or abs(number) > LARGEST:
            raise
        return int(number)


def value_text(value: Any) -> str:
    """Return the text of a value as `--set` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ','.join(map(value_text, value))
    if isinstance(value, dict):
        return ','.join(f'{name}={value_text(share)}' for name, share in value.items())
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def add_field_options(parser: argparse.ArgumentParser, without: tuple[str, ...]) -> None:
    """Add an option for each field, `--learning-rate` for `learning_rate`; by default None.

    `--help` shows the fields by group, `--help-research` those of studies.
    """
    research = argparse.ArgumentParser(
        prog=parser.prog, usage='fields for studies (docs/research)', add_help=False
    )
    parser.add_argument(
        '--help-research', action=_ResearchHelp, page=research, help='show the fields for studies'
    )
    groups: dict[tuple[str, bool], Any] = {}
    for name, each in FIELDS.items():
        if name in without:
            continue
        is_research = name in RESEARCH
        if is_research:
            _add_option(research, each, shown=True)
            _add_option(parser, each, shown=False)
            continue
        group = groups.get((each.group, is_research))
        if group is None:
            group = groups[each.group, is_research] = parser.add_argument_group(each.group)
        _add_option(group, each, shown=True)


class _ResearchHelp(argparse.Action):
    """Prints the page of fields for studies and exits."""

    def __init__(self, *arguments: Any, page: argparse.ArgumentParser, **options: Any) -> None:
        super().__init__(*arguments, **{**options, 'nargs': 0})
        self._page = page

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        self._page.print_help()
        parser.exit()


def _add_option(group: Any, each: Field, shown: bool) -> None:
    names = (*_OTHER_NAMES.get(each.name, ()), f'--{each.name.replace("_", "-")}')
    options: dict[str, Any] = {'dest': each.name, 'help': each.meaning.replace('%', '%%')}
    if not shown:
        options['help'] = argparse.SUPPRESS
    kind = plain_type(each.kind)
    if kind is bool:
        group.add_argument(*names, action=argparse.BooleanOptionalAction, **options)
        return
    metavar = {int: 'N', float: 'X', str: 'TEXT'}.get(kind, 'X,X,...')
    if each.choices:
        metavar = '{' + ','.join(each.choices) + '}'
    if typing.get_origin(kind) is dict:
        metavar = 'NAME=X,...'
    group.add_argument(*names, type=_reader(each.name), metavar=metavar, **options)


def _reader(name: str) -> Any:
    """Return the function that reads a value of a field."""

    def read(text: str) -> Any:
        try:
            return parse_value(name, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def given_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields that the command line has options for and that were given."""
    return {n: value for n, value in vars(options).items() if n in FIELDS and value is not None}


def with_assignments(
    given: dict[str, Any], assignments: Iterable[str], options: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the fields given by options and by `--set`.

    Args:
        assignments: Those of `--set`, `name=value`; the last one of a field counts.

    Raises:
        ValueError: If an assignment is invalid or contradicts the option of its field.
    """
    assigned = dict(parse_assignment(text) for text in assignments)
    for name, value in assigned.items():
        if name in given and given[name] != value:
            option = (options or {}).get(name, f'--{name.replace("_", "-")}')
            raise ValueError(f'{option} {given[name]} excludes --set {name}={value_text(value)}')
    return {**given, **assigned}
