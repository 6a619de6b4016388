"""Parameters as data and on a real node."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest

from msgs_spec.parameters import NODES, POLICY_NODE, SIM_NODE, unknown_parameter, usage, validate
from node_runtime.command_line import UsageError
from node_runtime.node_main import _reject_arguments
from node_runtime.ros_parameters import declare_parameters, descriptor, set_callback

SPECS = {
    f'{node.removesuffix("_node")}.{s.name}': s for node, specs in NODES.items() for s in specs
}
every_parameter = pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        ('sim.task', 'fetchreach', "'fetchreach' given; .*; did you mean 'FetchReach'\\?$"),
        ('sim.task', 3, 'task: 3 given; allowed: '),
        ('sim.seed', -1, 'seed: -1 given; allowed: whole numbers 0 ... 4294967295'),
        ('sim.joint_prefix', 5, 'joint_prefix: 5 given; allowed: text; .* two pairs of'),
        ('sim.seed', True, 'seed: True given; allowed: '),
        ('sim.reward_type', '', "reward_type: '' given; allowed: 'sparse', 'dense'"),
        ('sim.control_hz', 30.0, 'control_hz 30 is not a whole number .*29.4117647 and 31.25'),
        ('sim.control_hz', 1000.0, 'control_hz: 1000.0 given; allowed: 12.5 ... 500$'),
        ('sim.real_time_factor', math.nan, 'factor: nan given; allowed: 0 or 0.01 ... 1000'),
        ('sim.command_timeout', True, 'command_timeout: True given; allowed: a number, 0 ... 3600'),
        ('sim.joint_prefix', 'x' * 65, 'joint_prefix of 65 characters; allowed: up to 64$'),
        ('sim.episode_dir', 1, '1 given; allowed: text; .*: "episode_dir:=\'2026\'"$'),
        ('sim.wait_for_commands', 1, 'wait_for_commands: 1 given; allowed: true, false'),
        ('policy.task', 'Fetch', "task: 'Fetch' given; allowed: '', 'FetchReach', "),
    ],
)
def test_other_values_are_refused_in_one_line(name, value, message):
    with pytest.raises(ValueError, match=message) as error:
        validate(SPECS[name], value)
    assert '\n' not in str(error.value)


@pytest.fixture(scope='module')
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
def test_the_default_is_allowed_and_survives_ros2_param_dump_and_load(spec):
    """`ros2 param load` parses the text of each dumped value as YAML, as `-p` does."""
    validate(spec, spec.default)
    assert spec.description.endswith('.')
    parameter_module = pytest.importorskip('rclpy.parameter')
    message = parameter_module.get_parameter_value(str(spec.default))
    loaded = parameter_module.parameter_value_to_python(message)
    assert (loaded, type(loaded)) == (spec.default, type(spec.default))


def test_a_joint_prefix_may_have_64_characters():
    validate(SPECS['sim.joint_prefix'], 'x' * 64)


@pytest.mark.parametrize('specs', NODES.values(), ids=NODES)
def test_ros_declares_them_and_shows_the_ranges_that_are_checked(specs, make_node):
    """`ros2 param describe` prints them."""
    node = make_node()
    for spec in specs:
        parameter = node.declare_parameter(spec.name, spec.default, descriptor(spec))
        assert parameter.value == spec.default
        declared = node.describe_parameter(spec.name)
        assert declared.type == parameter.type_.value
        assert declared.description == spec.description
        assert declared.read_only == spec.read_only
        ranges = [*declared.integer_range, *declared.floating_point_range]
        assert len(ranges) == (spec.type in ('integer', 'double'))
        for limits in ranges:
            for value in (limits.from_value, limits.to_value):
                validate(spec, value)
            for value in (limits.from_value - 1, limits.to_value + 1):
                with pytest.raises(ValueError, match='allowed'):
                    validate(spec, value)
            if spec.or_zero:
                assert spec.allowed in declared.additional_constraints


def test_a_node_reads_valid_values_and_names_unknown_parameters(make_node, monkeypatch, capfd):
    with pytest.raises(ValueError, match=r'seed: -1 given; allowed: whole numbers 0 ') as error:
        declare_parameters(make_node(seed=-1), SIM_NODE)
    assert '\n' not in str(error.value)
    monkeypatch.setenv('HOME', '/home/somebody')
    unknown = {'tsak': 'FetchPush', 'nonsense': 1}
    # `checkpoint` is a parameter of policy_node, in a file for both nodes.
    others = {'checkpoint': 'random', 'use_sim_time': False}
    node = make_node(episode_dir='~/episodes', seed=3, real_time_factor=2, **unknown, **others)
    values = declare_parameters(node, SIM_NODE)
    assert (values['task'], values['seed']) == ('FetchReach', 3)
    assert values['episode_dir'] == '/home/somebody/episodes'
    # ROS reads `2` as an integer.
    assert repr(values['real_time_factor']) == '2.0'
    warnings = capfd.readouterr().err
    assert "unknown parameter 'tsak'; did you mean 'task'?" in warnings
    assert "unknown parameter 'nonsense'; it is ignored" in warnings
    assert not any(name in warnings for name in others)


def test_new_values_are_checked_while_the_node_runs(make_node):
    node = make_node()
    declare_parameters(node, SIM_NODE)
    node.add_on_set_parameters_callback(set_callback(SIM_NODE))
    rclpy = pytest.importorskip('rclpy')

    def put(name, value):
        (result,) = node.set_parameters([rclpy.Parameter(name, value=value)])
        return result.successful, result.reason

    assert put('real_time_factor', 0.5) == (True, '')
    assert put('real_time_factor', 'fast') == (
        False,
        "real_time_factor: 'fast' given; allowed: a number, 0 or 0.01 ... 1000",
    )
    assert node.get_parameter('real_time_factor').value == 0.5
    assert put('task', 'FetchPush') == (False, 'Trying to set a read-only parameter: task.')
    assert put('use_sim_time', False) == (True, '')
    node.add_on_set_parameters_callback(set_callback(SIM_NODE, makes_time=True))
    is_taken, reason = put('use_sim_time', True)
    assert (is_taken, 'allowed: false in this node' in reason) == (False, True)
    assert put('use_sim_time', False) == (True, '')


@pytest.mark.parametrize(
    ('arguments', 'line'),
    [
        (['task:=FetchPush'], "unknown argument 'task:=FetchPush'; parameters are given"),
        (['--ros-args', '-p', 'task:=FetchPush', '--', 'x'], "unknown argument 'x'; "),
        (['--ros-args', '-p', 'policy:=a:=', '-p', 'task:='], 'task:= has no value; '),
        (['--ros-args', '-r', '__ns:=/a/'], "'__ns:=/a/' given; allowed: letters, digits and _"),
        (['--ros-args', '-r', '__node:=my-arm'], "'__node:=my-arm' given; allowed: letters, "),
    ],
)
def test_arguments_that_rclpy_ignores_are_rejected(arguments, line):
    with pytest.raises(UsageError, match=f'^{line}'):
        _reject_arguments(arguments)


def test_an_argument_that_rclpy_does_not_explain_is_one_line():
    command = [sys.executable, '-m', 'fetch_hand_sim.sim_node', '--ros-args', 'seed:=3']
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith("sim_node: unknown after --ros-args: 'seed:=3'; a parameter is")
    assert done.stderr.count('\n') == 1


def test_warnings_about_parameters_of_others():
    line = unknown_parameter(POLICY_NODE, 'chekpoint')
    assert line == "unknown parameter 'chekpoint'; did you mean 'policy'?"
    line = unknown_parameter(SIM_NODE, 'qos_overrides./joint_states.publisher.depth')
    assert line is not None and line.endswith('the quality of service of all topics is fixed')
    for name in ('qos_overrides./clock.publisher.depth', 'use_sim_time', 'rate'):
        assert unknown_parameter(SIM_NODE, name) is None


@pytest.mark.parametrize('node', NODES)
def test_help_names_every_parameter_with_its_default_and_what_is_allowed(node):
    text = usage(node, 'What it is.')
    assert text.startswith(f'usage: {node} [--ros-args')
    assert max(map(len, text.splitlines())) <= 80
    flowing = ' '.join(text.split())
    for spec in NODES[node]:
        assert f'{spec.name} ({spec.type}, default {spec.default!r}' in flowing
        assert f'{spec.description} Allowed: {spec.allowed}.' in flowing


def test_help_is_printed_before_ros_is_loaded():
    program = (
        'import sys\n'
        'from fetch_hand_sim.replay_node import main as replay\n'
        'from fetch_hand_sim.sim_node import main as sim\n'
        'from policy_node.node import main as policy\n'
        'for words in ["--help"], ["-h"], ["--ros-args", "--help"]:\n'
        '    assert [main(words) for main in (replay, sim, policy)] == [0, 0, 0]\n'
        'assert not {"rclpy", "mujoco", "torch"} & sys.modules.keys()\n'
    )
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.count('usage: ') == 9
