"""The fields of a training configuration as options of a command line."""

from __future__ import annotations

import argparse
import ast
import inspect
import itertools
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.config_fields import ConfigFields
from policy_node.training.configuration.config_rules import CHOICES
from policy_node.training.configuration.config_values import parse_assignment, parse_value

# Former and shorter names.
_OTHER_NAMES = {
    'total_steps': ('--steps',),
    'simulation_threads': ('--threads',),
}


def add_field_options(parser: argparse.ArgumentParser, without: tuple[str, ...]) -> None:
    """Adds an option for each field, `--learning-rate` for `learning_rate`; not given, it is None.

    Args:
        parser: Of the command.
        without: Fields that the command has options of its own for.
    """
    group = parser.add_argument_group(
        'fields of the configuration',
        'What is not given is as in the recipe, or as in the run that goes on.',
    )
    documented = field_docstrings(ConfigFields)
    for name, kind in typing.get_type_hints(TrainConfig).items():
        if name in without:
            continue
        names = (*_OTHER_NAMES.get(name, ()), f'--{name.replace("_", "-")}')
        meaning = documented[name].replace('%', '%%')
        if kind is bool:
            action = argparse.BooleanOptionalAction
            group.add_argument(*names, dest=name, action=action, help=meaning)
        else:
            read, metavar = _reader(name), _metavar(name, kind)
            group.add_argument(*names, dest=name, type=read, metavar=metavar, help=meaning)


def given_fields(options: argparse.Namespace, without: tuple[str, ...]) -> dict[str, Any]:
    """The fields that a command line has options for and that were given."""
    fields = typing.get_type_hints(TrainConfig).keys() - set(without)
    given = vars(options).items()
    return {name: value for name, value in given if name in fields and value is not None}


def with_assignments(
    given: dict[str, Any], assignments: Iterable[str], options: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Fields that a command line has options for, and those of its `--set`.

    Args:
        given: The former.
        assignments: The latter, `name=value`; the last one of a field counts.
        options: What options of fields are called, where not as the field.

    Raises:
        ValueError: If an assignment is none, or says something else than the option of its field.
    """
    assigned = dict(parse_assignment(text) for text in assignments)
    for name, value in assigned.items():
        if name in given and given[name] != value:
            option = (options or {}).get(name, f'--{name.replace("_", "-")}')
            raise ValueError(f'{option} {given[name]} excludes --set {name}={value}')
    return {**given, **assigned}


def field_docstrings(kind: type) -> dict[str, str]:
    """What stands below each field of a class, on one line."""
    (definition,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in itertools.pairwise(definition.body):
        match field, below:
            case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = ' '.join(text.split())
    return found


def _reader(name: str) -> Any:
    """What reads a value of a field."""

    def read(text: str) -> Any:
        try:
            return parse_value(name, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _metavar(name: str, kind: Any) -> str:
    if name in CHOICES:
        return '{' + ','.join(CHOICES[name]) + '}'
    return {int: 'N', float: 'X', str: 'TEXT'}.get(kind, 'N,N,...')
