"""Launch file, parameter file and nodes agree; discovery stays on this machine unless asked."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

from msgs_spec.parameters import POLICY_NODE, SIM_NODE, validate
from msgs_spec.ros import keep_discovery_local
from support import ROOT

SPECS = {'sim_node': SIM_NODE, 'policy_node': POLICY_NODE}
LAUNCH = ElementTree.parse(ROOT / 'launch' / 'demo.launch.xml').getroot()
ARGUMENTS = {arg.get('name'): arg.get('default') for arg in LAUNCH.findall('arg')}


def resolved(value: str) -> str:
    """A value of the launch file with the defaults of its arguments."""
    return re.sub(r'\$\(var (\w+)\)', lambda match: ARGUMENTS[match[1]], value)


@pytest.mark.parametrize('node', LAUNCH.findall('node'), ids=lambda node: node.get('exec'))
def test_launched_nodes_get_parameters_they_have(node):
    specs = {spec.name: spec for spec in SPECS[node.get('exec')]}
    assert node.get('name') == node.get('exec')
    given = {p.get('name'): p.get('value') for p in node.findall('param') if p.get('name')}
    assert given
    for name, value in given.items():
        # launch reads a value as YAML.
        validate(specs[name], yaml.safe_load(resolved(value)))


def test_launch_file_starts_what_setup_py_installs():
    text = (ROOT / 'setup.py').read_text()
    for node in LAUNCH.findall('node'):
        assert re.search(rf"'{node.get('exec')} = [\w.]+:main'", text)
        assert resolved(node.get('namespace')) == ''
    used = set(re.findall(r'\$\(var (\w+)\)', (ROOT / 'launch/demo.launch.xml').read_text()))
    assert used == set(ARGUMENTS)
    assert all(arg.get('description') for arg in LAUNCH.findall('arg'))


@pytest.mark.parametrize('node', SPECS)
def test_parameter_file_holds_the_defaults(node):
    nodes = yaml.safe_load((ROOT / 'config' / 'sim_node.yaml').read_text())
    given = nodes[f'/**/{node}']['ros__parameters']
    wanted = {spec.name: spec.default for spec in SPECS[node]}
    assert given == wanted
    assert {name: type(value) for name, value in given.items()} == {
        name: type(value) for name, value in wanted.items()
    }


@pytest.mark.parametrize(('before', 'after'), [(None, 'LOCALHOST'), ('SUBNET', 'SUBNET')])
def test_discovery_stays_on_this_machine_unless_asked(monkeypatch, before, after):
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE', raising=False)
    if before:
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', before)
    keep_discovery_local()
    assert os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] == after
