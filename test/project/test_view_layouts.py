"""Layouts for rviz2 and Foxglove show topics that there are."""

from __future__ import annotations

import json
import re

import yaml

from msgs_spec.tasks import TASKS
from msgs_spec.topics import MONITORING, topics
from msgs_spec.view_topics import view_topics
from support import ROOT

PUBLISHED = {f'/{spec.name.strip("/")}' for task in TASKS.values() for spec in view_topics(task)}
ROBOT = {
    f'/{spec.name.strip("/")}' for task in TASKS.values() for spec in (*topics(task), *MONITORING)
}


def values(tree, key):
    """All values of a key at any depth."""
    if isinstance(tree, dict):
        found = [tree[key]] if key in tree else []
        return found + [each for part in tree.values() for each in values(part, key)]
    return [each for part in tree for each in values(part, key)] if isinstance(tree, list) else []


def test_rviz_shows_topics_of_the_node():
    layout = yaml.safe_load((ROOT / 'config/view.rviz').read_text())
    shown = {each for each in values(layout, 'Value') if isinstance(each, str)}
    assert shown and shown <= PUBLISHED
    displays = layout['Visualization Manager']['Displays']
    classes = {each['Class'].partition('/')[2] for each in displays}
    assert {'RobotModel', 'TF', 'MarkerArray'} <= classes
    assert layout['Visualization Manager']['Global Options']['Fixed Frame'] == 'world'


def test_foxglove_shows_topics_that_there_are():
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text())
    panels = layout['configById']
    paths = {path['value'].partition('.')[0] for plots in values(panels, 'paths') for path in plots}
    shown = paths | {panels['3D!robot']['layers']['robot']['topic']}
    shown |= set(panels['3D!robot']['topics']) | {
        panels['DiagnosticSummary!health']['topicToRender']
    }
    assert shown <= ROBOT | PUBLISHED
    placed = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout'])))
    assert placed == set(panels)


def test_foxglove_gets_what_its_panels_read():
    """The keys that its 3D and Plot panels keep in layouts, by its last open source and exports."""
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text())
    assert set(layout) == {
        'configById',
        'globalVariables',
        'userNodes',
        'playbackConfig',
        'layout',
    }
    panels = layout['configById']
    assert {name.partition('!')[0] for name in panels} == {'3D', 'Plot', 'DiagnosticSummary'}
    for identity, layer in panels['3D!robot']['layers'].items():
        assert layer['instanceId'] == identity
        assert layer['sourceType'] == 'topic' and layer['displayMode'] == 'visual'
        assert layer['framePrefix'] == '' and layer['frameLocked'] and layer['visible']
    sizes = {'target': 3, 'targetOffset': 3, 'targetOrientation': 4}
    camera = panels['3D!robot']['cameraState']
    assert {name: len(camera[name]) for name in sizes} == sizes
    for plot in (config for name, config in panels.items() if name.startswith('Plot')):
        for path in plot['paths']:
            has_stamp = path['value'].startswith('/scalars/')
            assert path['timestampMethod'] == ('headerStamp' if has_stamp else 'receiveTime')
            assert path['enabled'] is True
    children = [layout['layout']]
    while children:
        child = children.pop()
        if isinstance(child, dict):
            assert child['direction'] in ('row', 'column')
            children += [child['first'], child['second']]
