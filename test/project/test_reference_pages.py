"""The generated pages of the reference: nothing is missing from them."""

from __future__ import annotations

import ast
import runpy
from collections.abc import Iterator

from policy_node.training.configuration.config import FIELDS
from policy_node.training.configuration.recipes import recipe_config
from support import ROOT

TOOL = runpy.run_path(str(ROOT / 'tools' / 'reference_pages.py'))


def test_every_field_of_training_has_a_row_with_its_meaning() -> None:
    page = TOOL['train_config_page']()
    rows = [line.split(' | ') for line in page.partition('## Recipes')[0].splitlines()]
    meanings = {row[0].strip('| `'): row[-1].strip(' |') for row in rows if len(row) >= 4}
    for name in FIELDS:
        assert meanings.get(name), name


def test_the_recipes_on_the_page_equal_those_of_training() -> None:
    recipes = TOOL['train_config_page']().partition('## Recipes')[2]
    gamma = recipe_config('HandReach', 'best').gamma
    (row,) = (line for line in recipes.splitlines() if line.startswith('| `gamma` |'))
    assert row.split(' | ')[4] == f'`{gamma}`'


def test_a_command_is_shown_with_its_help() -> None:
    assert ('episodes', 'list') in dict(TOOL['leaves'](TOOL['COMMANDS']))
    assert TOOL['help_of'](('episodes', 'list')).startswith(
        'usage: fetch_hand_sim episodes list [-h]'
    )


def constructors() -> Iterator[tuple[str, str]]:
    """Yield each class with its place and the docstring of its `__init__`."""
    for package in ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node'):
        for path in (ROOT / package).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text())):
                for method in node.body if isinstance(node, ast.ClassDef) else ():
                    if isinstance(method, ast.FunctionDef) and method.name == '__init__':
                        yield f'{path}: {node.name}', ast.get_docstring(method) or ''


def test_arguments_of_a_class_are_documented_in_the_class() -> None:
    found = dict(constructors())
    assert len(found) > 50
    assert [name for name, text in found.items() if 'Args:' in text] == []
