"""Reports and log lines of a robot."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from std_msgs.msg import Float64MultiArray

from msgs_spec.codecs import message_stamp
from msgs_spec.tasks import task_spec
from msgs_spec.topics import QosSpec
from node_runtime.diagnostics import COMMANDERS
from node_runtime.ros import rclpy_profile
from support.graph import POLICY_NODE, SIM_NODE, Start, client, end, episodes_in, finish, ros_args

REACH = task_spec('FetchReach')


def test_episodes_after_an_actor_has_left_do_not_bear_its_name(
    start_process: Start, tmp_path: Path
) -> None:
    arguments = ros_args(wait_for_commands=True, real_time_factor=8.0, episode_dir=tmp_path)
    sim = start_process(*SIM_NODE, *arguments)
    policy = start_process(*POLICY_NODE)
    with client(REACH) as robot:
        robot.subscribe('episode_status')
        robot.spin_until(lambda: robot.statuses()[-1].episode > 1, 'two')
        end(policy)
        robot.spin(0.5)
        last = robot.statuses()[-1].episode
        robot.spin_until(lambda: robot.statuses()[-1].episode > last + 2, 'others')
    end(sim)
    named = ['checkpoint_sha256' in each.metadata for each in episodes_in(tmp_path)]
    assert named[0] and named == sorted(named, reverse=True)
    # The one that ran was begun by the actor.
    assert not any(named[last + 2 :])


def test_commanders_that_stop_or_disturb_and_health_are_reported(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(wait_for_commands=True, real_time_factor=4.0))
    policy = start_process(*POLICY_NODE, *ros_args(policy='resting', use_sim_time=True))
    with client(REACH) as robot:
        robot.subscribe('/diagnostics', 'real_time_factor', 'policy_status', 'joint_states')

        def wait_for(text: str, node: str = '/sim_node') -> None:
            robot.spin_until(lambda: text in robot.reports(node)[-1].message, text)

        robot.spin_until(lambda: len(robot.stamps('joint_states')) > 5, 'ticks')
        # The policy introduces itself in the time of the robot.
        (introduction,) = robot.received['policy_status']
        assert 0 < message_stamp(introduction) < robot.stamps('joint_states')[-1]
        policy.send_signal(signal.SIGKILL)
        stopped = 'commands have stopped, the robot holds; /policy_node sends none'
        wait_for(stopped)
        assert robot.reports()[-1].level == b'\x01'
        # A successor is one commander, though the graph remembers the first for 20 s.
        successor = start_process(*POLICY_NODE, *ros_args(policy='resting', use_sim_time=True))
        robot.spin_until(lambda: 'stopped' not in robot.reports()[-1].message, 'commands')
        assert 'publish commands' not in robot.reports()[-1].message
        assert robot.values()[COMMANDERS] == '/policy_node'

        robot.connect('commands')
        wait_for('2 publish commands: /client, /policy_node')
        robot.command(0, 0, 0)
        wait_for('1 commands rejected')
        assert robot.reports()[-1].level == b'\x01'
        values = robot.values()
        assert values['rejected: wrong size'] == values['commands rejected'] == '1'
        assert values['log'] == 'off'
        assert float(values['tick time p99 (ms)']) > 0.0
        wait_for('commands per second', '/policy_node')
        assert float(robot.values('/policy_node')['inference p50 (ms)']) > 0.0
        # Both in wall time, though one node follows the simulated.
        for each in robot.received['/diagnostics'][-2:]:
            assert abs(message_stamp(each) - time.time_ns()) < 10e9
        best_effort = rclpy_profile(QosSpec(1, 'best_effort', 'volatile'))
        for name in ('commands', 'set_goal'):
            robot.node.create_publisher(Float64MultiArray, name, best_effort)
        unreceived = [
            '/commands of /client is not received: it is best effort; allowed: reliable',
            '/set_goal of /client is not received: its type is std_msgs/msg/Float64MultiArray',
        ]
        for line in unreceived:
            wait_for(line)
        factors = robot.received['real_time_factor']
        robot.spin_until(lambda: any(abs(m.data - 4.0) < 0.4 for m in factors), 'factor of 4')
        robot.set_parameter('sim_node', 'real_time_factor', 0.1)
        factors.clear()
        robot.spin_until(lambda: any(abs(m.data - 0.1) < 0.05 for m in factors), 'factor of 0.1')
    for process in (sim, successor):
        process.send_signal(signal.SIGTERM)
    code, output = finish(sim)
    assert code == 0
    assert output.count(stopped) == 1
    for line in ('commands come from /policy_node', '2 publish commands: /client', *unreceived):
        assert line in output
    assert finish(successor)[0] == 0


def test_robots_of_one_name_and_a_second_clock_are_reported(start_process: Start) -> None:
    sims = [start_process(*SIM_NODE, *ros_args(), '-r', f'__ns:={ns}') for ns in ('/', '/', '/b')]
    same = '2 nodes publish as one robot: /sim_node, /sim_node; give each its own namespace'
    clock = '/clock is also published by /sim_node; start all robots but one with publish_clock:='
    with client(REACH) as robot:
        robot.subscribe('/diagnostics')
        for node, line in (('/sim_node', same), ('/b/sim_node', clock)):
            robot.spin_until(
                lambda: sum(line in each.message for each in robot.reports(node)) > 2,  # noqa: B023
                'errors',
            )
            last = robot.reports(node)[-1]
            assert last.level == b'\x02'
            assert ('publish_clock' in last.message) == (line == clock)
    assert [line in end(sim) for sim, line in zip(sims, (same, same, clock), strict=True)] == [
        True
    ] * 3
