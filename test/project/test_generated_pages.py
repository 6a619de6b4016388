"""Generated tables and pages equal the definitions in the package and lack nothing."""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from interface_table import interface_markdown
from make_tables import renewed, sections
from reference_pages import help_of, leaves, train_config_page

from msgs_spec.parameters import NODES
from msgs_spec.robots import SHADOW_HAND
from msgs_spec.tasks import TASKS
from msgs_spec.topics import SERVICES, topics, view_topics
from policy_node.policies.loading import shipped_actors
from policy_node.training.configuration.config import FIELDS
from policy_node.training.configuration.recipes import recipe_config
from support import PACKAGES, ROOT

SECTIONS = sections()


@pytest.mark.parametrize('path', SECTIONS, ids=lambda path: path.stem)
def test_a_page_has_the_present_tables(path: Path) -> None:
    page = path.read_text(encoding='utf-8')
    assert renewed(page, SECTIONS[path]) == page, 'run: make tables'


def test_the_readme_is_short() -> None:
    lines = (ROOT / 'README.md').read_text().splitlines()
    assert len(lines) <= 110
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize('path', shipped_actors().values(), ids=lambda path: path.stem)
def test_each_actor_is_the_one_that_was_evaluated(path: Path) -> None:
    report = json.loads(path.with_suffix('.json').read_text())
    assert report['sha256'] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert report['episodes'] >= 1000
    assert path.with_suffix('.png').is_file()


def test_every_topic_parameter_and_service_has_its_row() -> None:
    rows = {
        f'| `{spec.name}` | {spec.type_name.replace("/msg/", "/")} |'
        for task in TASKS.values()
        for spec in (*topics(task), *view_topics(task))
    }
    rows |= {
        f'| {n} | `{spec.name}` | {spec.type} |' for n, specs in NODES.items() for spec in specs
    }
    rows |= {f'| `{spec.name}` |' for spec in SERVICES}
    page = interface_markdown()
    assert [row for row in rows if f'\n{row}' not in page] == []


def test_the_joints_of_the_hand_have_both_numberings() -> None:
    page = (ROOT / 'docs' / 'hand_joints.md').read_text()
    commanded = [part.name for part in SHADOW_HAND.command]
    for index, joint in enumerate(SHADOW_HAND.joints):
        name = joint.removeprefix('robot0:')
        row = re.search(rf'^\| `{name}` \| `rh_(\w+)(\d)` \|.*$', page, re.MULTILINE)
        assert (row[1], int(row[2])) == (name[:-1], int(name[-1]) + 1)
        command = str(commanded.index(joint)) if joint in commanded else 'none, coupled'
        assert row[0].endswith(f'| {index} | {command} |')


def test_every_field_of_training_has_a_row_with_its_meaning_and_recipe() -> None:
    fields, _, recipes = train_config_page().partition('## Recipes')
    rows = [line.split(' | ') for line in fields.splitlines()]
    meanings = {row[0].strip('| `'): row[-1].strip(' |') for row in rows if len(row) >= 4}
    assert [name for name in FIELDS if not meanings.get(name)] == []
    gamma = recipe_config('HandReach', 'best').gamma
    (row,) = (line for line in recipes.splitlines() if line.startswith('| `gamma` |'))
    assert row.split(' | ')[4] == f'`{gamma}`'


def test_a_command_is_shown_with_its_help() -> None:
    assert ('episodes', 'list') in dict(leaves())
    text = help_of(('episodes', 'list'))
    assert text.startswith('usage: fetch_hand_sim episodes list [-h]')


def constructors() -> Iterator[tuple[str, str]]:
    """Yield each class with its place and the docstring of its `__init__`."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text())):
                for method in node.body if isinstance(node, ast.ClassDef) else ():
                    if isinstance(method, ast.FunctionDef) and method.name == '__init__':
                        yield f'{path}: {node.name}', ast.get_docstring(method) or ''


def test_arguments_of_a_class_are_documented_in_the_class() -> None:
    found = dict(constructors())
    assert len(found) > 50
    assert [name for name, text in found.items() if 'Args:' in text] == []
