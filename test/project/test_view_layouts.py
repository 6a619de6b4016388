"""Layouts for rviz2, Foxglove and PlotJuggler show existing topics."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import fields, is_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.codecs import build_message
from msgs_spec.tasks import TASKS, GoalKind
from msgs_spec.topics import MONITORING, topics, view_topics
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


def test_rviz_shows_topics_of_the_node_and_opens_its_window_without_the_picture():
    layout = yaml.safe_load((ROOT / 'config/view.rviz').read_text())
    shown = {each for each in values(layout, 'Value') if isinstance(each, str)}
    assert shown and shown <= PUBLISHED
    displays = layout['Visualization Manager']['Displays']
    classes = {each['Class'].partition('/')[2] for each in displays}
    assert {'RobotModel', 'TF', 'MarkerArray'} <= classes
    assert layout['Visualization Manager']['Global Options']['Fixed Frame'] == 'world'
    views = layout['Visualization Manager']['Views']
    assert [view['Name'] for view in views['Saved']] == ['Fetch', 'Hand']
    # rviz2 14.1.5 enables a picture whose window is open, and reads unset memory without docks.
    window = layout['Window Geometry']
    assert window['Hide Left Dock'] is window['Hide Right Dock'] is False
    # A name in UTF-16, its length before it, whether it is shown after it.
    state, name = bytes.fromhex(window['QMainWindow State']), 'Camera'.encode('utf-16-be')
    assert state[state.index(name) + len(name)] == 0
    name = 'Displays'.encode('utf-16-be')
    assert state[state.index(name) + len(name)] == 1


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


def curves(name, message):
    """The numbers of a message by the names that PlotJuggler 3.17.2 was seen to give them."""
    if name == '/joint_states':
        return {
            f'{name}/{joint}/{part}': value
            for part in ('position', 'velocity', 'effort')
            for joint, value in zip(message.name, getattr(message, part), strict=True)
        }
    if is_dataclass(message):
        parts = [(f'{name}/{each.name}', getattr(message, each.name)) for each in fields(message)]
    elif isinstance(message, list | np.ndarray):
        parts = [(f'{name}[{index}]', each) for index, each in enumerate(message)]
    else:
        return {name: message}
    return {key: value for part in parts for key, value in curves(*part).items()}


def logged_vectors(task):
    """Different numbers for every published topic; unit quaternions."""
    random = np.random.default_rng(0)
    found = {}
    for spec in topics(task):
        if spec.layout and spec.direction == 'published':
            parts = [random.normal(size=part.size) for part in spec.layout]
            parts = [part / np.linalg.norm(part) if part.size == 4 else part for part in parts]
            found[spec] = np.concatenate(parts)
    return found


def plotjuggler():
    """Plotted curves; functions by name: Lua text, sources."""
    root, functions = ElementTree.parse(ROOT / 'config/plotjuggler_layout.xml').getroot(), {}
    for each in root.iter('snippet'):
        others = [source.text for source in each.iterfind('additional_sources/*')]
        sources = [each.findtext('linked_source'), *others]
        functions[each.get('name')] = each.findtext('function'), sources
    return {each.get('name') for each in root.iter('curve')}, functions


def lua(text, values):
    """Run a Lua function of the layout."""
    names = {'math': SimpleNamespace(sqrt=math.sqrt, acos=math.acos, min=min, max=max)}
    names |= {'value': values[0]} | {f'v{i}': each for i, each in enumerate(values[1:], start=1)}
    return eval(text.removeprefix('return ').replace('^', '**'), names)


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_plotjuggler_shows_curves_of_every_task(task):
    """A function whose first source is missing stays empty; a later one would be an error."""
    plotted, functions = plotjuggler()
    vectors = logged_vectors(task)
    logged = {}
    for spec, vector in vectors.items():
        logged |= curves(f'/{spec.name}', build_message(spec, 0, vector))
    found = {
        name: lua(text, [logged[each] for each in sources])
        for name, (text, sources) in functions.items()
        if sources[0] in logged
    }
    assert set(functions) <= plotted <= set(functions) | set(logged)

    goals = {spec.name: vector for spec, vector in vectors.items()}
    (kind,) = (name for name in found if name.startswith('distance/'))
    distance, rotation = GoalMetric(task).distances(goals['achieved_goal'], goals['desired_goal'])
    if task.position_counts:
        assert found[kind] == pytest.approx(float(distance))
    assert ('rotation/HandManipulate' in found) == (task.goal is GoalKind.POSE)
    if task.goal is GoalKind.POSE and not task.ignores_z_rotation:
        assert found['rotation/HandManipulate'] == pytest.approx(float(rotation))

    commands = [part.name for part in task.robot.command]
    shown = {name: value for name, value in found.items() if 'command' in name.split('/')}
    assert len(shown) == (4 if task.robot.has_gripper_command else 6)
    for name, value in shown.items():
        which = name.replace('command', '').strip('/')
        index = commands.index(which if which in commands else f'robot0:{which}')
        assert value == logged[f'/applied_command/data[{index}]']
