"""Write the generated pages of the reference: commands and training fields.

`make docs` writes them to `docs/generated`, which git ignores.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from fetch_hand_sim.__main__ import COMMANDS, Command
from msgs_spec.tasks import TASKS
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.config_fields import ConfigFields
from policy_node.training.configuration.config_options import field_docstrings
from policy_node.training.configuration.config_rules import CHOICES, RANGES
from policy_node.training.configuration.recipes import recipe_config

_COLUMNS = '88'
# One task for each group of equal values in the recipe `best`.
_EXAMPLES = ('FetchPush', 'FetchSlide', 'HandReach', 'HandManipulateBlockRotateZ')


def write_pages(directory: Path) -> None:
    """Writes all pages into `directory`, which is made."""
    directory.mkdir(exist_ok=True)
    for name, page in (('commands', commands_page()), ('train_config', train_config_page())):
        path = directory / f'{name}.md'
        # An unchanged file keeps its time, and Sphinx its work.
        if not path.exists() or path.read_text(encoding='utf-8') != page:
            path.write_text(page, encoding='utf-8')


def commands_page() -> str:
    """Returns every command with what its `--help` prints."""
    parts = [
        '# Commands\n\n`fetch_hand_sim <command>`. The nodes and `view` are also executables for '
        '`ros2 run fetch_hand_sim`. What each command prints for `--help`:'
    ]
    for path, command in leaves(COMMANDS):
        parts.append(f'## {" ".join(path)}\n\n{_sentence(command.help)}')
        parts.append(f'```\n{help_of(path)}\n```')
    return '\n\n'.join(parts) + '\n'


def leaves(
    commands: dict[str, Command], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Command]]:
    """Yields every command that runs something, with the words that name it."""
    for name, command in commands.items():
        if command.commands:
            yield from leaves(command.commands, (*path, name))
        else:
            yield (*path, name), command


def _sentence(text: str) -> str:
    return f'{text[0].upper()}{text[1:]}.'


def help_of(path: tuple[str, ...]) -> str:
    """Returns what a command prints for `--help`."""
    command = [sys.executable, '-m', 'fetch_hand_sim', *path, '--help']
    environment = os.environ | {'COLUMNS': _COLUMNS, 'NO_COLOR': '1'}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return result.stdout.strip()


def train_config_page() -> str:
    """Returns the fields of `TrainConfig`, and where the recipes differ from their defaults."""
    documented = field_docstrings(ConfigFields)
    ranges = {name: _range(low, high) for name, low, high in RANGES}
    choices = {name: ', '.join(map(_code, values)) for name, values in CHOICES.items()}
    allowed = {'task': f'one of the {len(TASKS)} tasks'} | ranges | choices
    rows = []
    for field in dataclasses.fields(TrainConfig):
        meaning = documented[field.name]
        default = '' if field.default is dataclasses.MISSING else _code(_value(field.default))
        rows.append((_code(field.name), default, allowed.get(field.name, ''), meaning))
    return (
        '\n\n'.join(
            [
                '# Fields of training',
                'Everything that decides what `fetch_hand_sim train` learns: '
                '`policy_node.training.configuration.config.TrainConfig`. Any field is an option, '
                '`--learning-rate 1e-4`, or `--set learning_rate=1e-4`; each is in the JSON of the '
                'actor. [Training](../training.md) '
                'says what they bought.',
                _table(('field', 'default', 'allowed', 'meaning'), rows),
                '## Recipes\n\nWhere a recipe differs from the default. `paper` is given for '
                'FetchPush; hand manipulation has episodes of twice as many ticks.',
                _recipes(),
            ]
        )
        + '\n'
    )


def _recipes() -> str:
    columns = [('paper', recipe_config('FetchPush', 'paper'))]
    columns += [(f'best, {task}', recipe_config(task, 'best')) for task in _EXAMPLES]
    rows = []
    for field in dataclasses.fields(TrainConfig):
        values = [getattr(each, field.name) for _, each in columns]
        if field.name not in ('task', 'recipe') and any(v != field.default for v in values):
            cells = ['' if v == field.default else _code(_value(v)) for v in values]
            rows.append((_code(field.name), *cells))
    return _table(('field', *(name for name, _ in columns)), rows)


def _range(low: float, high: float) -> str:
    if high == float('inf'):
        return f'{_value(low)} or more'
    return f'{_value(low)} ... {_value(high)}'


def _value(value: object) -> str:
    """A value as `--set` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ','.join(map(str, value))
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def _code(text: str) -> str:
    return f'`{text}`' if text else ''


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ('---',) * len(header), *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)
