"""Messages that ROS has and PyPI has not: `tf2_msgs`, `simulation_interfaces`.

`tools/build_ros_messages.sh` builds both for the environment; without them nothing here runs.
"""

from __future__ import annotations

import sys

import numpy as np
import pytest

from fetch_hand_sim.sim_node import services
from msgs_spec.codecs import decode, message_stamp
from msgs_spec.tasks import task_spec
from msgs_spec.topics import INTERFACE_SERVICES, MAX_STEPS, QosSpec, topic
from node_runtime.ros import rclpy_profile, ros_message_class, ros_service_class
from support.frames import tree
from support.graph import POLICY_NODE, SIM_NODE, Start, client, end, ros_args

VISUALIZATION = (sys.executable, '-m', 'fetch_hand_sim.visualization_node')
# As the listeners of tf2 ask for.
LISTENING = QosSpec(depth=100, reliability='reliable', durability='volatile')
LISTENING_FIXED = QosSpec(depth=100, reliability='reliable', durability='transient_local')
SERVICES = {spec.name.removeprefix('~/'): spec for spec in INTERFACE_SERVICES}


def needs(package):
    return pytest.importorskip(
        f'{package}.msg',
        reason=f'{package} is not installed: tools/build_ros_messages.sh builds it',
        exc_type=ImportError,
    )


def listen(connection, kind, name, qos):
    """Returns the messages of a topic as they come."""
    received = []
    connection.node.create_subscription(kind, name, received.append, rclpy_profile(qos))
    return received


@pytest.mark.parametrize(
    ('task', 'namespace', 'prefix'),
    [('HandManipulateBlockRotateZ', '/', ''), ('FetchPush', '/lab/left', 'lab/left/')],
)
def test_frames_of_every_tick_are_one_tree_with_its_object_and_goal(
    start_process: Start, task: str, namespace: str, prefix: str
) -> None:
    message = needs('tf2_msgs').TFMessage
    spec = task_spec(task)
    rename = ['-r', f'__ns:={namespace}']
    start_process(*SIM_NODE, *ros_args(task=task), *rename)
    start_process(*VISUALIZATION, '--ros-args', *rename)
    start_process(*POLICY_NODE, '--ros-args', *rename)
    with client(spec) as connection:
        moving = listen(connection, message, '/tf', LISTENING)
        told = {}
        for name in ('desired_goal', 'object_pose'):
            source = topic(spec, name)
            kind, place = ros_message_class(source.type_name), f'{namespace.rstrip("/")}/{name}'
            told[name] = listen(connection, kind, place, source.qos)

        def ticks_seen_whole():
            seen = [{message_stamp(each) for each in messages} for messages in told.values()]
            return {message_stamp(each.transforms[0]) for each in moving}.intersection(*seen)

        # Subscriptions connect one after the other. More than an episode, so that a reset is seen.
        enough = 1.2 * spec.episode_ticks
        connection.spin_until(lambda: len(ticks_seen_whole()) > enough, 'frames', 60.0)
        fixed = listen(connection, message, '/tf_static', LISTENING_FIXED)
        connection.spin_until(lambda: fixed, 'frames that never move, for those who are late')
    values = {
        name: {message_stamp(each): decode(topic(spec, name), each) for each in messages}
        for name, messages in told.items()
    }
    frames = {}
    for each in moving:
        (stamp,) = {message_stamp(transform) for transform in each.transforms}
        frames[stamp] = each.transforms
    stamps = sorted(set(frames).intersection(*values.values()))
    # A tick is 40 ms, and all come; a machine that is busy may lose some of them.
    assert len(stamps) > 0.8 * (stamps[-1] - stamps[0]) / 40e6
    for stamp in stamps:
        poses = tree([*fixed[0].transforms, *frames[stamp]])
        assert all(name.startswith(prefix) for name in poses if name != 'world')
        tick = {name: found[stamp] for name, found in values.items()}
        place = poses[prefix + spec.object_name].position
        np.testing.assert_allclose(place, tick['object_pose'][:3])
        np.testing.assert_allclose(poses[f'{prefix}goal'].position, tick['desired_goal'][:3])
        assert f'{prefix}camera' in poses


class Simulator:
    """The services of a robot, called by a client."""

    def __init__(self, connection):
        self.connection = connection

    def __call__(self, name, **fields):
        kind = ros_service_class(SERVICES[name].type_name)
        return self.connection.call(kind, f'/sim_node/{name}', **fields)

    def result(self, name, **fields):
        answer = self(name, **fields).result
        return answer.result, answer.error_message

    def set_state(self, number):
        state = needs('simulation_interfaces').SimulationState(state=number)
        return self.result('set_simulation_state', state=state)

    @property
    def state(self):
        return self('get_simulation_state').state.state

    def later(self, name, **fields):
        """Returns the future of a call."""
        kind = ros_service_class(SERVICES[name].type_name)
        service = self.connection.node.create_client(kind, f'/sim_node/{name}')
        self.connection.spin_until(service.service_is_ready, name)
        return service.call_async(kind.Request(**fields))


def test_constants_are_those_of_the_installed_release() -> None:
    messages = needs('simulation_interfaces')
    ours, result = services, messages.Result
    assert (ours.FEATURE_UNSUPPORTED, ours.OK, ours.OPERATION_FAILED) == (
        result.RESULT_FEATURE_UNSUPPORTED,
        result.RESULT_OK,
        result.RESULT_OPERATION_FAILED,
    )
    state = messages.SimulationState
    assert (ours.PLAYING, ours.PAUSED) == (state.STATE_PLAYING, state.STATE_PAUSED)
    reset = ros_service_class(SERVICES['reset_simulation'].type_name).Request
    assert (ours.SCOPE_DEFAULT, ours.SCOPE_STATE, ours.SCOPE_ALL) == (
        reset.SCOPE_DEFAULT,
        reset.SCOPE_STATE,
        reset.SCOPE_ALL,
    )
    change = ros_service_class(SERVICES['set_simulation_state'].type_name).Response
    assert change.ALREADY_IN_TARGET_STATE == ours.ALREADY_IN_TARGET_STATE
    assert all(hasattr(messages.SimulatorFeatures, name) for name in ours.FEATURES)


def test_simulation_interfaces_answer_as_their_definitions_say(start_process: Start) -> None:
    messages = needs('simulation_interfaces')
    node = start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    with client(task_spec('FetchReach')) as connection:
        connection.subscribe('joint_states')
        simulator = Simulator(connection)
        features = simulator('get_simulator_features').features
        known = messages.SimulatorFeatures
        assert set(features.features) == {getattr(known, name) for name in services.FEATURES}
        assert list(features.spawn_formats) == []
        assert 'time never goes back' in features.custom_info
        connection.spin_until(lambda: connection.received['joint_states'], 'tick')

        assert simulator.state == 1
        assert simulator.result('step_simulation')[0] == 4
        for number in (0, 3, 4, 5, 255):
            code, line = simulator.set_state(number)
            assert code == 0 and 'allowed: 1 (playing), 2 (paused)' in line
        assert simulator.set_state(1)[0] == 101
        assert simulator.state == 1
        assert simulator.set_state(2)[0] == 1
        assert simulator.set_state(2)[0] == 101
        assert simulator.state == 2

        connection.spin(0.3)
        before = len(connection.stamps('joint_states'))
        # The definition's default is one step.
        assert simulator.result('step_simulation')[0] == 1
        connection.spin(0.3)
        # As many as a topic keeps.
        assert simulator.result('step_simulation', steps=10)[0] == 1
        connection.spin(0.3)
        stamps = connection.stamps('joint_states')
        assert len(stamps) == before + 11
        assert set(np.diff(stamps[-12:])) == {40_000_000}
        for steps in (0, MAX_STEPS + 1, 2**63, 2**64 - 1):
            code, line = simulator.result('step_simulation', steps=steps)
            assert code == 4 and f'{steps} ticks asked for' in line
        assert simulator.state == 2

        for scope in (1, 3, 4, 5, 6, 7, 8, 254):
            code, line = simulator.result('reset_simulation', scope=scope)
            assert code == 0 and 'time, which never goes back' in line
        for scope in (0, 2, 255):
            code, line = simulator.result('reset_simulation', scope=scope)
            assert code == 1 and ('time goes on' in line) == (scope != 2)
            connection.spin(0.3)
        assert simulator.state == 2
        assert simulator.result('step_simulation', steps=MAX_STEPS)[0] == 1
        assert simulator.set_state(1)[0] == 1
        assert simulator.result('reset_simulation')[0] == 1
        assert simulator.state == 1
        stamps = connection.stamps('joint_states')
        assert all(np.diff(stamps) > 0)
    end(node)


@pytest.mark.parametrize('mode', ['realtime', 'lockstep'])
def test_a_policy_goes_on_after_others_paused_and_stepped(start_process: Start, mode: str) -> None:
    messages = needs('simulation_interfaces')
    robot = start_process(*SIM_NODE, *ros_args(task='FetchReach', mode=mode))
    policy = start_process(*POLICY_NODE)
    with client(task_spec('FetchReach')) as connection:
        connection.subscribe('applied_command', 'joint_states')
        connection.spin_until(lambda: len(connection.received['applied_command']) > 5, 'commands')
        simulator = Simulator(connection)
        paused, playing = (messages.SimulationState(state=number) for number in (2, 1))
        for wanted in (paused, playing, paused):
            # One of several simultaneous calls pauses; the others find the robot paused.
            calls = [simulator.later('set_simulation_state', state=wanted) for _ in range(3)]
            connection.spin_until(lambda calls=calls: all(c.done() for c in calls), 'answers')
            codes = sorted(each.result().result.result for each in calls)
            assert codes == [1, 101, 101]
        connection.spin(0.3)
        before = len(connection.stamps('joint_states'))
        calls = [simulator.later('step_simulation', steps=steps) for steps in (1, 2, 3)]
        calls.append(simulator.later('get_simulation_state'))
        connection.spin_until(lambda: all(each.done() for each in calls), 'answers')
        assert [each.result().result.result for each in calls] == [1, 1, 1, 1]
        connection.spin(0.3)
        stamps = connection.stamps('joint_states')
        assert len(stamps) == before + 6
        assert simulator.set_state(1)[0] == 1
        count = len(connection.received['applied_command'])
        connection.spin_until(
            lambda: len(connection.received['applied_command']) > count + 20, 'commands again'
        )
        assert all(np.diff(connection.stamps('joint_states')) > 0)
    end(policy)
    end(robot)
