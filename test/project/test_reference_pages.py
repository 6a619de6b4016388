"""The generated pages of the reference: nothing is missing from them."""

from __future__ import annotations

import dataclasses
import runpy

from policy_node.training.learning.config import TrainConfig
from policy_node.training.learning.recipes import recipe_config
from support import ROOT

TOOL = runpy.run_path(str(ROOT / 'tools' / 'reference_pages.py'))


def test_every_field_of_training_has_a_row_with_its_meaning() -> None:
    page = TOOL['train_config_page']()
    rows = [line.split(' | ') for line in page.partition('## Recipes')[0].splitlines()]
    meanings = {row[0].strip('| `'): row[-1].strip(' |') for row in rows if len(row) >= 4}
    for field in dataclasses.fields(TrainConfig):
        assert meanings.get(field.name), field.name


def test_the_recipes_are_those_that_train() -> None:
    recipes = TOOL['train_config_page']().partition('## Recipes')[2]
    gamma = recipe_config('HandReach', 'best').gamma
    (row,) = (line for line in recipes.splitlines() if line.startswith('| `gamma` |'))
    assert row.split(' | ')[4] == f'`{gamma}`'


def test_a_command_is_shown_with_what_it_prints() -> None:
    assert ('episodes', 'list') in dict(TOOL['leaves'](TOOL['COMMANDS']))
    assert TOOL['help_of'](('episodes', 'list')).startswith('usage: list_episodes [-h]')
