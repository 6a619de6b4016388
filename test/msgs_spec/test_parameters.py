"""Parameters as data and on a real node."""

from __future__ import annotations

import math

import pytest

from msgs_spec.parameters import POLICY_NODE, SIM_NODE, descriptor, set_callback, validate

SPECS = {
    f'{node}.{s.name}': s
    for node, specs in (('sim', SIM_NODE), ('policy', POLICY_NODE))
    for s in specs
}
every_parameter = pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)


@every_parameter
def test_default_is_allowed_and_described(spec):
    validate(spec, spec.default)
    assert spec.description.endswith('.')


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('sim.task', 'HandManipulatePenFull'),
        ('sim.seed', 2**32 - 1),
        ('sim.control_hz', 500),
        ('sim.control_hz', 500 / 3),
        ('sim.real_time_factor', 0),
        ('sim.command_timeout', 0.25),
        ('sim.episode_dir', 'anywhere'),
        ('sim.wait_for_commands', True),
        ('policy.task', ''),
    ],
)
def test_allowed_values_pass(name, value):
    validate(SPECS[name], value)


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        ('sim.task', 'fetchreach', "task: 'fetchreach' given; allowed: 'FetchReach', "),
        ('sim.task', 3, 'task: 3 given; allowed: '),
        ('sim.task', None, 'task: None given; allowed: '),
        ('sim.seed', -1, 'seed: -1 given; allowed: 0 ... 4294967295'),
        ('sim.seed', 1.0, 'seed: 1.0 given; allowed: 0 ... 4294967295'),
        ('sim.seed', True, 'seed: True given; allowed: '),
        ('sim.reward_type', '', "reward_type: '' given; allowed: 'sparse', 'dense'"),
        ('sim.control_hz', 30.0, 'control_hz 30 is not a whole number .*29.4117647 and 31.25'),
        ('sim.control_hz', 1000, 'control_hz 1000 is not a whole number .*500'),
        ('sim.real_time_factor', -0.1, 'real_time_factor: -0.1 given; allowed: 0 ... 1000'),
        ('sim.real_time_factor', math.nan, 'real_time_factor: nan given; allowed: 0 ... 1000'),
        ('sim.real_time_factor', '2', "real_time_factor: '2' given; allowed: 0 ... 1000"),
        ('sim.command_timeout', True, 'command_timeout: True given; allowed: 0 ... 3600'),
        ('sim.episode_dir', 1, 'episode_dir: 1 given; allowed: any string'),
        ('sim.wait_for_commands', 1, 'wait_for_commands: 1 given; allowed: true, false'),
        ('policy.task', 'Fetch', "task: 'Fetch' given; allowed: '', 'FetchReach', "),
    ],
)
def test_other_values_are_refused_in_one_line(name, value, message):
    with pytest.raises(ValueError, match=message) as error:
        validate(SPECS[name], value)
    assert '\n' not in str(error.value)


@pytest.fixture
def make_node():
    rclpy = pytest.importorskip('rclpy')
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = []

    def make(**overrides):
        values = [rclpy.Parameter(name, value=value) for name, value in overrides.items()]
        node = rclpy.create_node('parameters', context=context, parameter_overrides=values)
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


@every_parameter
def test_ros_declares_it_and_knows_its_type(spec, make_node):
    node = make_node()
    parameter = node.declare_parameter(spec.name, spec.default, descriptor(spec))
    assert parameter.value == spec.default
    declared = node.describe_parameter(spec.name)
    assert declared.type == parameter.type_.value
    assert declared.description == spec.description
    assert declared.read_only == spec.read_only


def test_ros_takes_an_integer_for_a_number(make_node):
    spec = SPECS['sim.real_time_factor']
    node = make_node(real_time_factor=2)
    assert node.declare_parameter(spec.name, spec.default, descriptor(spec)).value == 2


def test_ros_refuses_what_is_out_of_range(make_node):
    spec = SPECS['sim.seed']
    node = make_node(seed=-1)
    with pytest.raises(Exception, match=r'Parameter seed out of range\. Min: 0, Max: 4294967295'):
        node.declare_parameter(spec.name, spec.default, descriptor(spec))


def test_new_values_are_checked_while_the_node_runs(make_node):
    node = make_node()
    for spec in SIM_NODE:
        node.declare_parameter(spec.name, spec.default, descriptor(spec))
    node.add_on_set_parameters_callback(set_callback(SIM_NODE))
    rclpy = pytest.importorskip('rclpy')

    def put(name, value):
        (result,) = node.set_parameters([rclpy.Parameter(name, value=value)])
        return result.successful, result.reason

    assert put('real_time_factor', 0.5) == (True, '')
    assert put('real_time_factor', 'fast') == (
        False,
        "real_time_factor: 'fast' given; allowed: 0 ... 1000",
    )
    assert node.get_parameter('real_time_factor').value == 0.5
    assert put('task', 'FetchPush') == (False, 'Trying to set a read-only parameter: task.')
    assert put('use_sim_time', False) == (True, '')
