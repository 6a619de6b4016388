"""Launch file, parameter files and nodes agree."""

from __future__ import annotations

import argparse
import re
import xml.etree.ElementTree as ElementTree

import pytest
import rclpy
import yaml

from fetch_hand_sim.view.command import parse
from msgs_spec.parameters import POLICY_NODE, SIM_NODE, validate
from node_runtime.ros_parameters import declare_parameters
from support import ROOT

SPECS = {'sim_node': SIM_NODE, 'policy_node': POLICY_NODE}
DEMO, VIEW = (
    ElementTree.parse(ROOT / 'launch' / f'{name}.launch.xml').getroot() for name in ('demo', 'view')
)
GROUPS = {group.find('node').get('exec'): group for group in DEMO.findall('group')}
SHARE = '$(find-pkg-share fetch_hand_sim)'


def values_of(launch: ElementTree.Element, **arguments: str) -> dict[str, str]:
    """The arguments of a launch file, some of them given."""
    return {arg.get('name'): arg.get('default') for arg in launch.findall('arg')} | arguments


def resolved(text: str, values: dict[str, str]) -> str:
    """A value of a launch file, with its substitutions made."""
    text = re.sub(r'\$\(var (\w+)\)', lambda match: values[match[1]], text)
    return text.replace(SHARE, str(ROOT))


def is_meant(action: ElementTree.Element, values: dict[str, str]) -> bool:
    """Evaluate `if`; these files only use `not-equals`."""
    condition = action.get('if')
    if condition is None:
        return True
    (operands,) = re.findall(r'^\$\(not-equals (\S+ \S*)\)$', resolved(condition, values))
    left, _, right = operands.partition(' ')
    return left != right


def node_arguments(node: str, **arguments: str) -> list[str]:
    """The command line that ros2 launch makes of a group: its actions in their order."""
    words, values = ['--ros-args'], values_of(DEMO, **arguments)
    for action in GROUPS[node]:
        if action.tag == 'node' or not is_meant(action, values):
            continue
        if action.tag == 'set_parameters_from_file':
            words += ['--params-file', resolved(action.get('filename'), values)]
        else:
            words += ['-p', f'{action.get("name")}:={resolved(action.get("value"), values)}']
    return words


def given_by_view(**arguments: str) -> dict[str, str]:
    """The arguments that view.launch.xml gives to demo.launch.xml."""
    values = values_of(VIEW, **arguments)
    given = VIEW.find('include').findall('arg')
    return {arg.get('name'): resolved(arg.get('value'), values) for arg in given}


def parameters_of(node: str, **arguments: str) -> dict[str, object]:
    """The parameters with which a launched node runs."""
    rclpy.init(args=node_arguments(node, **arguments))
    try:
        launched = rclpy.create_node(node)
        return declare_parameters(launched, SPECS[node])
    finally:
        rclpy.shutdown()


def test_without_arguments_the_demo_and_the_robot_for_the_page_wait_for_commands():
    for arguments, wanted in (
        ({}, ('FetchReach', 5, 'episodes')),
        (given_by_view(), ('HandManipulateBlockRotateZ', 0, '')),
    ):
        values = parameters_of('sim_node', **arguments)
        assert (values['task'], values['episodes'], values['episode_dir']) == wanted
        assert values['wait_for_commands'] is True
        policy = parameters_of('policy_node', **arguments)
        assert policy == {spec.name: spec.default for spec in POLICY_NODE}
    logged = parameters_of('sim_node', **given_by_view(episode_dir='there'))
    assert logged['episode_dir'] == 'there'


def test_arguments_replace_a_params_file_and_both_replace_the_defaults(tmp_path):
    mine = {
        'task': 'FetchPush',
        'episodes': 2,
        'mode': 'lockstep',
        'episode_dir': 'mine',
        'wait_for_commands': False,
        'publish_clock': False,
    }
    path = tmp_path / 'my.yaml'
    path.write_text(yaml.safe_dump({'/**/sim_node': {'ros__parameters': mine}}))
    given = {'task': 'HandReach', 'episodes': 0, 'mode': 'realtime', 'episode_dir': 'there'}
    given |= {'publish_clock': True}
    words = {name: str(value) for name, value in given.items()}
    by_view = given_by_view(params_file=str(path), task='HandReach', episode_dir='there')
    for arguments, wanted in (
        ({}, mine),
        (words, mine | given),
        (given_by_view(params_file=str(path)), mine),
        (by_view, mine | {'task': 'HandReach', 'episode_dir': 'there'}),
    ):
        values = parameters_of('sim_node', **{'params_file': str(path)} | arguments)
        assert {name: values[name] for name in mine} == wanted
    for arguments in (words, by_view):
        assert parameters_of('policy_node', **arguments)['task'] == 'HandReach'


def test_launch_files_start_installed_executables():
    setup, text = ((ROOT / name).read_text() for name in ('setup.py', 'launch/demo.launch.xml'))
    for name, group in GROUPS.items():
        node = group.find('node')
        assert (node.get('pkg'), node.get('name')) == ('fetch_hand_sim', name)
        assert re.search(rf"'{name} = [\w.]+:main'", setup)
        assert resolved(node.get('namespace'), values_of(DEMO)) == ''
    defaults = values_of(DEMO)
    assert set(re.findall(r'\$\(var (\w+)\)', text)) == set(defaults)
    assert set(defaults.values()) == {''}
    assert all(arg.get('description') for arg in (*DEMO.findall('arg'), *VIEW.findall('arg')))


def page_of_view(**arguments: str) -> argparse.Namespace:
    """The options with which view.launch.xml starts the page."""
    values = values_of(VIEW, **arguments)
    (node,) = [
        node
        for node in VIEW.findall('node')
        if resolved(node.get('if', 'true'), values) == 'true'
        and resolved(node.get('unless', 'false'), values) == 'false'
    ]
    assert (node.get('exec'), node.get('namespace')) == ('view', '$(var namespace)')
    return parse(resolved(node.get('args'), values).split())


def test_a_launched_page_is_local_and_may_command_by_default():
    page = page_of_view()
    assert (page.host, page.port, page.read_only, page.wait) == ('127.0.0.1', 0, False, 60.0)
    page = page_of_view(host='0.0.0.0', port='8090', read_only='true')
    assert (page.host, page.port, page.read_only) == ('0.0.0.0', 8090, True)


@pytest.mark.parametrize('node', SPECS)
def test_the_parameter_file_contains_the_defaults_and_that_of_the_demo_others(node):
    nodes = yaml.safe_load((ROOT / 'config' / 'sim_node.yaml').read_text())
    given = nodes[f'/**/{node}']['ros__parameters']
    wanted = {spec.name: spec.default for spec in SPECS[node]}
    assert [(name, type(value), value) for name, value in sorted(given.items())] == [
        (name, type(value), value) for name, value in sorted(wanted.items())
    ]
    demo = yaml.safe_load((ROOT / 'config' / 'demo.yaml').read_text()).get(f'/**/{node}', {})
    specs = {spec.name: spec for spec in SPECS[node]}
    for name, value in demo.get('ros__parameters', {}).items():
        validate(specs[name], value)
        assert value != specs[name].default


@pytest.mark.parametrize('page', ['README.md', 'docs/tutorials/write_your_own_controller.md'])
def test_a_page_lets_its_robot_wait_for_the_policy(page):
    """A policy takes seconds to load, in which a robot that does not wait fails its episodes."""
    robots = re.findall(
        r'ros2 run fetch_hand_sim sim_node(.*)\n.*(?:policy_node|controller)',
        (ROOT / page).read_text(),
    )
    assert robots
    assert all('-p wait_for_commands:=true' in arguments for arguments in robots)
