"""Real nodes in separate processes on a real ROS graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from std_srvs.srv import SetBool, Trigger

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import build_message, decode
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic, topics
from node_runtime.ros import rclpy_profile
from support.graph import (
    SIM_NODE,
    Client,
    Start,
    client,
    end,
    episodes_in,
    finish,
    ros_args,
)
from support.tasks import each_task

REACH = task_spec('FetchReach')


def test_topics_have_the_promised_type_and_quality_and_commands_by_name_move_these_joints(
    start_process: Start,
) -> None:
    spec = task_spec('HandManipulateBlockFull')
    start_process(*SIM_NODE, *ros_args(task=spec.name, mode='lockstep', wait_for_commands=True))
    with client(spec) as robot:
        for promised in topics(spec):
            look = (
                robot.node.get_publishers_info_by_topic
                if promised.direction == 'published'
                else robot.node.get_subscriptions_info_by_topic
            )
            robot.spin_until(lambda: bool(look(promised.name)), promised.name)  # noqa: B023
            (info,) = look(promised.name)
            offered, wanted = info.qos_profile, rclpy_profile(promised.qos)
            assert info.topic_type == promised.type_name
            assert offered.reliability == wanted.reliability
            assert offered.durability == wanted.durability
        robot.subscribe('applied_command', 'joint_states')
        robot.connect('joint_commands')
        robot.spin_until(lambda: bool(robot.received['joint_states']), 'the reset')
        message = robot.publisher('joint_commands').msg_type()
        message.name = ['robot0:THJ0', 'robot0:WRJ1']
        message.position = [-0.5, 0.1]
        robot.publish('joint_commands', message)
        robot.spin_until(lambda: bool(robot.received['applied_command']), 'a tick')
        applied = decode(topic(spec, 'applied_command'), robot.received['applied_command'][0])
    runner = EpisodeRunner(Simulation(spec.name))
    runner.advance(runner.resting_command())
    expected = runner.resting_command()
    expected[[0, -1]] = 0.1, -0.5
    np.testing.assert_allclose(applied, expected, atol=1e-12)


@each_task
def test_every_task_runs_and_logs_its_topics(
    start_process: Start, tmp_path: Path, task: str
) -> None:
    parameters = {'task': task, 'episodes': 1, 'seed': 5, 'episode_dir': tmp_path}
    arguments = ros_args(**parameters, real_time_factor=0.0, use_sim_time=True)
    namespace = ('-r', f'__ns:=/{task}')
    code, output = finish(start_process(*SIM_NODE, *arguments, *namespace), 120.0)
    assert code == 0, output
    (episode,) = episodes_in(tmp_path)
    spec = task_spec(task)
    sim_time, settings, logged = output.strip().splitlines()
    assert 'use_sim_time is set back to false: sim_node itself publishes simulated' in sim_time
    assert settings.endswith(
        f'{task}, 25 ticks per simulated second, as fast as possible; topics in /{task}; '
        f'log: {tmp_path}; no commands yet'
    )
    assert f'episode 0 seed 5: {spec.episode_ticks} steps, return' in logged
    names = {s: s.name if s.name[0] == '/' else f'/{task}/{s.name}' for s in topics(spec)}
    published = [s for s in topics(spec) if s.direction == 'published']
    assert {names[source] for source in published} == set(episode.topics)
    for source in published:
        messages = episode.topics[names[source]].messages
        if source.name != 'episode_status':
            values = [decode(source, deserialize(source.type_name, m.data)) for m in messages]
            assert np.isfinite(values).all()
            after_reset_only = source.name in ('reward', 'applied_command')
            assert len(values) == spec.episode_ticks + (0 if after_reset_only else 1)


def test_bad_commands_are_dropped_and_good_ones_clipped(
    start_process: Start, tmp_path: Path
) -> None:
    # A robot reports what a killed one has left behind.
    (tmp_path / '.FetchReach_left.active').mkdir()
    sim = start_process(
        *SIM_NODE, *ros_args(mode='lockstep', wait_for_commands=True, episode_dir=tmp_path)
    )
    with client(REACH) as robot:
        robot.subscribe('applied_command', 'joint_states')
        robot.connect('commands')
        robot.spin_until(lambda: bool(robot.received['joint_states']), 'the reset')
        for bad in ([0.0] * 3, [0.0] * 5, [], [float('nan'), 0, 0, 0], [0, float('inf'), 0, 0]):
            robot.command(*bad)
            robot.spin(0.1)
        # Warnings about commands do not silence those about goals.
        robot.connect('set_goal')
        far = build_message(topic(REACH, 'set_goal'), 0, [0.0, 0.0, 1e6])
        robot.publish('set_goal', serialize('geometry_msgs/msg/PointStamped', far))
        robot.command(0.0)
        robot.spin(0.3)
        assert robot.received['applied_command'] == []
        robot.command(0.25, -7.0, 1e300, 0.5)
        robot.spin_until(lambda: bool(robot.received['applied_command']), 'a tick')
        applied = robot.received['applied_command']
        assert list(applied[0].data) == [0.25, -1.0, 1.0, 0.5]
        # Every command of a burst has its own tick.
        burst = [0.125 * number for number in range(1, 8)]
        for value in burst:
            robot.command(value, 0, 0, 0)
        robot.spin_until(lambda: len(applied) > len(burst), 'a tick for each')
        robot.spin(0.3)
        assert [message.data[0] for message in applied[1:]] == burst
    output = end(sim)
    assert 'FetchReach_left' in output
    assert 'commands dropped: 3 values given; allowed: 4' in output
    assert 'set_goal dropped: 1e+06 given; allowed: -1000 ... 1000' in output
    (episode,) = episodes_in(tmp_path)
    assert len(episode.topics['/commands'].messages) == 7 + len(burst)


def test_a_robot_rests_obeys_holds_pauses_steps_and_resets(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(command_timeout=0.2))
    with client(REACH) as robot:
        robot.subscribe('applied_command', 'joint_states', 'episode_status', '/clock')
        robot.connect('commands')
        robot.spin_until(lambda: len(robot.received['applied_command']) > 3, 'ticks')
        assert list(robot.received['applied_command'][-1].data) == [0.0] * 4
        # A whole episode: its end would end the hold.
        first = robot.statuses()[-1].episode
        robot.spin_until(lambda: robot.statuses()[-1].episode > first, 'a new episode')
        robot.command(0.5, 0.0, 0.0, 1.0)
        seen = robot.received['applied_command']
        robot.spin_until(lambda: list(seen[-1].data) == [0.5, 0.0, 0.0, 1.0], 'the command')
        began = len(seen)
        robot.spin_until(lambda: list(seen[-1].data) == [0.0, 0.0, 0.0, 1.0], 'the hold')
        # Five ticks; a busy machine misses some.
        assert 1 <= len(seen) - began <= 8

        assert not robot.call(Trigger, 'sim_node/step').success
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        robot.spin(0.2)
        count = len(robot.stamps('joint_states'))
        robot.spin(0.3)
        assert len(robot.stamps('joint_states')) == count
        late, state = Client(REACH, 'late'), ('joint_states', 'achieved_goal', 'desired_goal')
        late.subscribe(*state, 'episode_status')
        last = robot.stamps('joint_states')[-1:]
        late.spin_until(lambda: all(late.stamps(name) == last for name in state), 'the last state')
        late.spin_until(lambda: late.statuses()[-1].task == 'FetchReach', 'the last status')
        late.close()
        assert robot.call(Trigger, 'sim_node/step').success
        robot.spin_until(lambda: len(robot.stamps('joint_states')) > count, 'a step')
        robot.spin(0.2)
        assert len(robot.stamps('joint_states')) == count + 1
        robot.spin_until(lambda: bool(robot.statuses()), 'status')
        episode = robot.statuses()[-1].episode
        assert robot.call(Trigger, 'sim_node/reset').success
        robot.spin_until(lambda: robot.statuses()[-1].episode > episode, 'the next episode')
        assert robot.statuses()[-1].tick == 0
        robot.spin_until(lambda: len(robot.stamps('joint_states')) > count + 1, 'its state')
        robot.spin(0.2)
        assert len(robot.stamps('joint_states')) == count + 2
        assert robot.set_parameter('sim_node', 'real_time_factor', 8.0).successful
        assert robot.call(SetBool, 'sim_node/pause', data=False).success
        robot.spin_until(lambda: robot.statuses()[-1].episode > episode + 2, 'more episodes')
        stamps = np.diff(robot.stamps('/clock'))
    assert (stamps > 0).all() and set(stamps % 40_000_000) == {0}


def test_a_robot_that_waits_for_commands_can_be_seeded_and_stepped_to_its_end(
    start_process: Start,
) -> None:
    sim = start_process(*SIM_NODE, *ros_args(wait_for_commands=True, episodes=2))
    with client(REACH) as robot:
        assert robot.set_parameter('sim_node', 'seed', 9).successful
        # Late subscribers receive it, too.
        robot.subscribe('episode_status', '/clock')
        robot.spin_until(
            lambda: [(s.phase, s.seed) for s in robot.statuses()[-1:]] == [('waiting', 9)], 'seed'
        )
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        assert robot.call(SetBool, 'sim_node/pause', data=False).success
        robot.spin_until(lambda: bool(robot.stamps('/clock')), 'clock')
        robot.spin(0.3)
        assert len(robot.stamps('/clock')) == 1, 'without a step it waits'
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        assert robot.call(Trigger, 'sim_node/step').success
        assert robot.call(SetBool, 'sim_node/pause', data=False).message == 'running at 1.000 s'
        robot.spin_until(lambda: len(robot.stamps('/clock')) > 5, 'ticks')
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        answer = robot.call(Trigger, 'sim_node/reset')
        assert 'a tick of its own starts episode 1' in answer.message
        robot.spin_until(
            lambda: [(s.episode, s.phase) for s in robot.statuses()[-1:]] == [(1, 'reset')],
            'the next episode',
        )
        for _ in range(REACH.episode_ticks):
            assert robot.call(Trigger, 'sim_node/step').success
        code, output = finish(sim)
    assert code == 0, output
    assert 'log: off; waits for commands' in output
    assert 'episode 1 seed 10: 50 steps, return' in output


def test_bad_parameters_end_with_one_line_and_code_2(start_process: Start) -> None:
    lines: list[tuple[dict[str, object], str]] = [
        ({'task': 'FetchFly'}, "'FetchFly' given; allowed: 'FetchReach', 'FetchPush'"),
        ({'control_hz': 30.0}, 'nearest: 29.4117647 and 31.25'),
        ({'seed': 'seven'}, '0 ... 4294967295'),
        ({'episode_dir': '/proc/here'}, 'episode_dir: /proc/here: No such file or directory'),
        ({'use_sim_time': 1}, "'use_sim_time' to '1' of type 'INTEGER', expecting type 'BOOL'"),
    ]
    nodes = [start_process(*SIM_NODE, *ros_args(**parameters)) for parameters, _ in lines]
    for node, (parameters, line) in zip(nodes, lines, strict=True):
        code, output = finish(node)
        assert code == 2, parameters
        assert line in output
        assert len(output.strip().splitlines()) == 1
