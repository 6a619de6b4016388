"""Episodes on the graph again: `replay_node`, with `policy_node` and without."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import time
from array import array
from dataclasses import fields

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from fetch_hand_sim.episode_log import EpisodeReadError, EpisodeWriter, read_episode
from fetch_hand_sim.episode_log.reader import split_ticks
from fetch_hand_sim.replay_node.schedule import Playhead, ReplaySchedule
from msgs_spec.codecs import decode, message_stamp
from msgs_spec.schemas import deserialize, message_class, serialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic, topics
from node_runtime.ros import ros_message_class
from support.fresh_actor import fresh_actor
from support.graph import POLICY_NODE, SIM_NODE, client, finish, logged_run, ros_args

REPLAY_NODE = (*SIM_NODE[:2], 'fetch_hand_sim.replay_node')
LISTENER = """
import rclpy
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topics
from node_runtime.ros import rclpy_profile, ros_message_class
rclpy.init()
node = rclpy.create_node('listener')
for spec in topics(TASKS['FetchReach']):
    if spec.direction == 'published':
        profile = rclpy_profile(spec.qos)
        node.create_subscription(ros_message_class(spec.type_name), spec.name, id, profile)
rclpy.spin(node)
"""
REACH = task_spec('FetchReach')
# A policy skips a tick if it falls 40 ms / RATE behind.
RATE = 0.15
ODD_NAMES = ('/a b', '/1st', '/a//b', '/' + 300 * 'x')


def from_ros(message):
    """Returns a message of rclpy as an instance of `message_class`, to be given to `serialize`."""
    package = type(message).__module__.split('.')[0]
    target = message_class(f'{package}/msg/{type(message).__name__}')
    names = [item.name for item in fields(target) if item.name != '__msgtype__']
    return target(**{name: _plain(getattr(message, name)) for name in names})


def _plain(value):
    if hasattr(value, 'get_fields_and_field_types'):
        return from_ros(value)
    if isinstance(value, array | np.ndarray):
        return np.asarray(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    # ROS's `byte` is a bytes object in rclpy and a number in the type store.
    return value[0] if isinstance(value, bytes) else value


def collect(listener, name):
    """Receive a topic without loss."""
    spec = topic(listener.spec, name)
    received = []
    listener.node.create_subscription(
        ros_message_class(spec.type_name), name, received.append, QoSProfile(depth=1000)
    )
    return received


def record(start_process, directory, task, actor):
    """One episode of real nodes in lockstep, so that every tick has its command."""
    policy = start_process(*POLICY_NODE, *ros_args(policy=actor))
    settings = {'task': task, 'episodes': 1, 'seed': 3, 'log_compiled_model': False}
    (episode,) = logged_run(start_process, directory, **settings)
    policy.send_signal(signal.SIGTERM)
    assert finish(policy)[0] == 0
    return episode.path


@pytest.mark.parametrize(
    'task', ['FetchReach', pytest.param('HandManipulateBlockFull', marks=pytest.mark.release)]
)
def test_actor_on_a_replay_repeats_the_recorded_commands(start_process, tmp_path, task):
    """FetchReach with the shipped actor, a hand task with an untrained one."""
    actor: object = 'FetchReach'
    if task != actor:
        fresh_actor(actor := tmp_path / 'untrained.safetensors', task)
    path = record(start_process, tmp_path / 'episodes', task, actor)
    spec = task_spec(task)
    recorded = [m.data for m in read_episode(path).topics['/commands'].messages]
    assert len(recorded) == spec.episode_ticks
    with client(spec) as listener:
        received = collect(listener, 'commands')
        replay = start_process(
            *REPLAY_NODE,
            *ros_args(path=path, rate=RATE, wait_for_commands=True, start_paused=True),
        )
        start_process(*POLICY_NODE, *ros_args(policy=actor))
        # The replay waits for the policy, not for its listeners: a busy machine takes seconds.
        (subscription,) = listener.node.subscriptions
        listener.spin_until(subscription.get_publisher_count, 'policy that is heard')
        listener.call(SetBool, 'replay_node/pause', data=False)
        # The policy also answers the last observation, after which the robot took no command.
        listener.spin_until(lambda: len(received) > spec.episode_ticks, 'all commands')
        assert finish(replay)[0] == 0
    name = topic(spec, 'commands').type_name
    again = [serialize(name, from_ros(message)) for message in received]
    assert len(again) == spec.episode_ticks + 1
    assert again[:-1] == recorded


@pytest.mark.alone
def test_every_message_comes_back_as_recorded_with_its_timing(start_process, finished):
    logged = read_episode(finished)
    with client(REACH) as listener:
        # None is lost, also of /clock, while a busy machine does not serve the test.
        listener.subscribe(depth=1000)
        replay = start_process(*REPLAY_NODE, *ros_args(path=finished, start_paused=True))
        listener.spin_until(lambda: bool(listener.received['episode_status']), 'latched status')
        subscriptions = list(listener.node.subscriptions)
        listener.spin_until(
            lambda: all(each.get_publisher_count() for each in subscriptions), 'all topics'
        )
        assert listener.node.count_publishers('commands') == 0
        assert listener.call(SetBool, 'replay_node/pause', data=False).message == 'running'
        listener.spin_until(lambda: replay.poll() is not None, 'the end of the replay')
        published = [spec for spec in topics(REACH) if spec.direction == 'published']
        messages = {s.name: logged.topics['/' + s.name.lstrip('/')].messages for s in published}
        listener.spin_until(
            lambda: all(len(listener.received[n]) >= len(m) for n, m in messages.items()),
            'all messages',
        )
        listener.spin(0.2)
        for spec in published:
            expected = [m.data for m in messages[spec.name]]
            got = [serialize(spec.type_name, from_ros(m)) for m in listener.received[spec.name]]
            # Latched topics are published once more before the start.
            extra = len(got) - len(expected)
            assert extra == (1 if spec.qos.durability == 'transient_local' else 0), spec.name
            assert got[extra:] == expected, spec.name
        times = np.array(listener.received_at['joint_states'])
    # Two seconds of episode; a busy machine may delay single messages.
    assert times[-1] - times[0] == pytest.approx(2.0, abs=0.2)
    assert np.median(np.diff(times)) == pytest.approx(0.04, abs=0.004)


def test_late_subscribers_get_the_latched_topics_of_an_offset(start_process, finished):
    start_process(*REPLAY_NODE, *ros_args(path=finished, start_offset=1.0, start_paused=True))
    with client(REACH) as listener:
        listener.subscribe('desired_goal', 'episode_status', 'joint_states')
        listener.spin_until(lambda: bool(listener.received['desired_goal']), 'the latched goal')
        listener.spin_until(lambda: bool(listener.received['episode_status']), 'the latched status')
        assert message_stamp(listener.received['desired_goal'][0]) == 1_960_000_000
        assert listener.statuses()[0].phase == 'reset'
        subscriptions = list(listener.node.subscriptions)
        listener.spin_until(lambda: all(s.get_publisher_count() for s in subscriptions), 'replay')
        listener.call(SetBool, 'replay_node/pause', data=False)
        listener.spin_until(lambda: bool(listener.received['joint_states']), 'a tick')
        assert message_stamp(listener.received['joint_states'][0]) == 2_000_000_000


@pytest.mark.alone
def test_rate_loop_and_pause(start_process, finished):
    start_process(*REPLAY_NODE, *ros_args(path=finished, rate=2.0, loop=True))
    with client(REACH) as listener:
        listener.subscribe('joint_states', '/clock')
        stamps = []

        def has_looped():
            stamps[:] = [message_stamp(m) for m in listener.received['joint_states']]
            return any(later < earlier for earlier, later in itertools.pairwise(stamps))

        listener.spin_until(has_looped, 'a second round')
        times = np.array(listener.received_at['joint_states'][: len(stamps)])
        assert np.median(np.diff(times)) == pytest.approx(0.02, abs=0.005)
        assert 1_000_000_000 in stamps
        assert listener.call(SetBool, 'replay_node/pause', data=True).message == 'paused'
        listener.spin(0.2)
        count, clocks = len(listener.received['joint_states']), len(listener.received['/clock'])
        listener.spin(0.5)
        assert len(listener.received['joint_states']) == count
        assert len(listener.received['/clock']) > clocks, 'the clock stands and is still published'
        rate = Parameter('rate', value=0.0).to_parameter_msg()
        (result,) = listener.call(
            SetParameters, 'replay_node/set_parameters', parameters=[rate]
        ).results
        assert not result.successful and '0.01' in result.reason


def test_commands_are_published_only_when_asked_for(start_process, finished):
    with client(REACH) as listener:
        received = collect(listener, 'commands')
        arguments = ros_args(path=finished, topics='commands, reward', rate=2.0, start_paused=True)
        replay = start_process(*REPLAY_NODE, *arguments)
        for name in ('commands', 'reward'):
            listener.spin_until(lambda: bool(listener.node.count_publishers(name)), name)  # noqa: B023
        assert listener.node.count_publishers('joint_states') == 0
        listener.call(SetBool, 'replay_node/pause', data=False)
        listener.spin_until(lambda: len(received) == 50, 'commands')
        assert finish(replay)[0] == 0
        commands = [decode(topic(REACH, 'commands'), message) for message in received]
    logged = read_episode(finished).topics['/applied_command'].messages
    applied = topic(REACH, 'applied_command')
    expected = [decode(applied, deserialize(applied.type_name, m.data)) for m in logged]
    np.testing.assert_array_equal(commands, expected)


def assert_ends_well(replay, said=''):
    """The process ends with 0 after one line."""
    code, output = finish(replay)
    assert (code, output.count('\n')) == (0, 1), output
    assert 'real time; topics in /' in output and output.endswith(f'{said}\n')


def test_a_replay_that_waits_for_commands_is_interrupted(start_process, finished):
    replay = start_process(*REPLAY_NODE, *ros_args(path=finished, wait_for_commands=True))
    with client(REACH) as listener:
        listener.subscribe('episode_status')
        listener.spin_until(lambda: bool(listener.received['episode_status']), 'latched status')
    replay.send_signal(signal.SIGINT)
    assert_ends_well(replay, '; topics in /; waits for commands')


@pytest.mark.alone
def test_a_hanging_callback_delays_the_end_by_one_second(start_process, finished):
    """Not for one per topic."""
    nowhere = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
    replay = start_process(*REPLAY_NODE, *ros_args(path=finished, loop=True))
    listener = start_process(sys.executable, '-c', LISTENER, **nowhere)
    with client(REACH) as watcher:
        names = [spec.name for spec in topics(REACH) if spec.direction == 'published']
        for name in names:
            watcher.spin_until(lambda: watcher.node.count_subscribers(name) == 1, name)  # noqa: B023
        watcher.spin(0.5)
        listener.send_signal(signal.SIGSTOP)
        watcher.spin(1.5)
        replay.send_signal(signal.SIGINT)
        began = time.monotonic()
        assert_ends_well(replay)
    assert time.monotonic() - began < 6.0


def test_a_replay_begins_with_commands_of_another_name(start_process, finished):
    commands = ('-r', '/commands:=/arm/goals')
    arguments = ros_args(path=finished, wait_for_commands=True, rate=10.0)
    replay = start_process(*REPLAY_NODE, *arguments, *commands)
    start_process(*POLICY_NODE, '--ros-args', *commands)
    assert_ends_well(replay)


def test_in_a_namespace_it_replays_a_robot_of_that_namespace(start_process, finished):
    """Beside the robot without one, whose topics it leaves alone."""
    options = ros_args(path=finished, wait_for_commands=True, start_paused=True)
    with client(REACH) as listener:
        replay = start_process(*REPLAY_NODE, *options, '-r', '__ns:=/left')
        node = listener.node
        left = [f'/left{name}' for name in read_episode(finished).topics if name != '/clock']
        published = [name for name in left if not name.endswith('/commands')]
        listener.spin_until(lambda: all(map(node.count_publishers, published)), 'its topics')
        assert node.count_publishers('/clock') == 1
        assert not any(node.count_publishers(name.removeprefix('/left')) for name in left)
        commands = topic(REACH, 'commands')
        node.create_publisher(ros_message_class(commands.type_name), '/left/commands', 10)
        listener.call(SetBool, '/left/replay_node/pause', data=False)
        line = '2.00 s, at 1 x real time; topics in /left; waits for commands; paused until'
        assert_ends_well(replay, f'{line} ~/pause is called with false')


@pytest.mark.release
def test_a_policy_goes_on_when_less_than_a_second_is_replayed_again(start_process, finished):
    with client(REACH) as listener:
        received = collect(listener, 'commands')
        arguments = ros_args(path=finished, loop=True, start_offset=1.5, wait_for_commands=True)
        start_process(*REPLAY_NODE, *arguments)
        start_process(*POLICY_NODE)
        # A round has 13 ticks.
        listener.spin_until(lambda: len(received) > 30, 'commands of a third round')


def test_topics_of_a_running_robot_are_rejected_unless_forced(start_process, finished):
    start_process(*SIM_NODE, *ros_args(publish_clock=False))
    with client(REACH) as listener:
        listener.spin_until(lambda: listener.node.count_publishers('joint_states'), 'a robot')
        code, output = finish(start_process(*REPLAY_NODE, *ros_args(path=finished)))
        assert code == 2 and ' is already published by /sim_node; ' in output
        forced = start_process(*REPLAY_NODE, *ros_args(path=finished, force=True, rate=100.0))
        assert_ends_well(forced)
        elsewhere = start_process(*REPLAY_NODE, *ros_args(path=finished), '-r', '__ns:=/replay')
        assert_ends_well(elsewhere)


@pytest.mark.parametrize(
    ('parameters', 'line'),
    [
        ({}, 'path is missing; allowed: a bag directory or an MCAP file'),
        ({'start_offset': 9.0}, 'start_offset: 9.0 given; allowed: up to 2.000'),
    ],
)
def test_bad_parameters_end_with_one_line_and_code_2(start_process, finished, parameters, line):
    given = {'path': finished, **parameters} if parameters else {}
    code, output = finish(start_process(*REPLAY_NODE, *ros_args(**given)))
    assert code == 2
    assert line in output
    assert len(output.strip().splitlines()) == 1


def test_a_replay_schedule_contains_the_published_messages_in_order(finished):
    schedule = ReplaySchedule(finished)
    ticks = split_ticks(read_episode(finished))
    expected = [m.data for tick in ticks for m in tick.published]
    assert [message.data for message in schedule.messages] == expected
    with_inputs = ReplaySchedule(finished, with_inputs=True)
    assert len(with_inputs.messages) == len(expected) + 50
    assert schedule.namespace == ''
    with pytest.raises(ValueError, match="no topic 'wheels' in the episode; allowed: /clock, /jo"):
        ReplaySchedule(finished, ['wheels'])
    index = schedule.index_at(2_000_000_000)
    assert schedule.messages[index].name == '/clock'
    assert schedule.messages[index].time_ns == 2_000_000_000


@pytest.mark.parametrize(
    ('namespace', 'lost', 'reason'),
    [
        ('/', 3, ''),
        *((name, 0, 'topic .*; allowed: names of ROS') for name in ODD_NAMES),
    ],
)
def test_messages_that_ros_cannot_publish_are_refused(finished, tmp_path, namespace, lost, reason):
    """Messages without their last bytes, and topics without names of ROS."""
    whole = read_episode(finished)
    writer = EpisodeWriter(tmp_path, 'odd', whole.metadata, namespace=namespace)
    for tick in split_ticks(whole)[:3]:
        messages = [(m.topic, m.data[: len(m.data) - lost]) for m in tick.published]
        writer.write_tick(tick.stamp_ns, messages)
    with pytest.raises(EpisodeReadError, match=f'odd_0.mcap: {reason}'):
        ReplaySchedule(writer.finish({}))


def test_playhead_follows_rate_and_pauses():
    head = Playhead(1_000, 0.0, now=10.0)
    assert head.position_ns(99.0) == 1_000
    assert head.remaining(10**9, 99.0) == float('inf')
    head.set_rate(2.0, 100.0)
    assert head.position_ns(100.5) == 1_000 + 10**9
    assert head.remaining(1_000 + 2 * 10**9, 100.5) == pytest.approx(0.5)
    head.set_rate(0.5, 100.5)
    assert head.position_ns(101.5) == 1_000 + 1_500_000_000
    for now in (101.5, 110.0):
        head.set_rate(0.0, now)
    assert head.position_ns(200.0) == 1_000 + 1_500_000_000
    head.jump(7, 300.0)
    assert head.position_ns(300.0) == 7
