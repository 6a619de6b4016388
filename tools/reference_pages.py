"""Write the generated pages of the reference: commands and training fields.

`make docs` writes them to `docs/generated`, which git ignores.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from markdown_table import table

from fetch_hand_sim.__main__ import COMMANDS, Command
from msgs_spec.tasks import TASKS
from policy_node.training.configuration.config import DEFAULTS, FIELDS, Field
from policy_node.training.configuration.flat import (
    RESEARCH,
    to_flat,
    value_text,
)
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
    for path, command in leaves():
        parts.append(f'## {" ".join(path)}\n\n{_sentence(command.help)}')
        parts.append(f'```\n{help_of(path)}\n```')
    return '\n\n'.join(parts) + '\n'


def leaves(
    commands: Mapping[str, Command] = COMMANDS, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Command]]:
    """Yield the words and the entry of every command that runs a module."""
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
    """Return the fields of `TrainConfig` by group, and the values of the recipes."""
    parts = [
        '# Fields of training',
        'Fields that decide what `fetch_hand_sim train` learns: '
        '`policy_node.training.configuration.config.TrainConfig`. Any field is an option, '
        '`--learning-rate 1e-4`, or `--set learning_rate=1e-4`; each is in the JSON of the actor. '
        '[Training](../training.md) says how much they help.',
    ]
    for is_research, prefix in ((False, ''), (True, 'For studies: ')):
        fields = [each for each in FIELDS.values() if (each.name in RESEARCH) == is_research]
        for title in dict.fromkeys(each.group for each in fields):
            rows = [_row(each) for each in fields if each.group == title]
            parts.append(f'## {prefix}{title}')
            parts.append(table(('field', 'default', 'allowed', 'meaning'), rows))
    parts.append(
        '## Recipes\n\nValues that differ from the default. `paper` is given for FetchPush; hand '
        'manipulation has episodes of twice as many ticks.'
    )
    parts.append(_recipes())
    return '\n\n'.join(parts) + '\n'


def _row(field: Field) -> tuple[str, ...]:
    allowed = ', '.join(map(_code, field.choices)) or str(field.limits or '')
    if field.name == 'task':
        return _code('task'), '', f'one of the {len(TASKS)} tasks', field.meaning
    return _code(field.name), _code(value_text(field.default)), allowed, field.meaning


def _recipes() -> str:
    columns = [('paper', to_flat(recipe_config('FetchPush', 'paper')))]
    columns += [(f'best, {task}', to_flat(recipe_config(task, 'best'))) for task in _EXAMPLES]
    rows = []
    for name, default in DEFAULTS.items():
        values = [each[name] for _, each in columns]
        if name != 'recipe' and any(value != default for value in values):
            cells = ['' if value == default else _code(value_text(value)) for value in values]
            rows.append((_code(name), *cells))
    return table(('field', *(name for name, _ in columns)), rows)


def _code(text: str) -> str:
    return f'`{text}`' if text else ''
