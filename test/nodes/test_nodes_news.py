"""Reports, log lines and late subscribers of a robot."""

from __future__ import annotations

import re
import signal
from pathlib import Path

from std_msgs.msg import Float64MultiArray

from msgs_spec.tasks import task_spec
from msgs_spec.topics import QosSpec
from node_runtime.ros import rclpy_profile
from support.graph import POLICY_NODE, SIM_NODE, Start, client, end, episodes_in, ros_args

REACH = task_spec('FetchReach')


def test_a_killed_policy_is_reported_in_real_time(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(wait_for_commands=True, real_time_factor=4.0))
    policy = start_process(*POLICY_NODE, *ros_args(policy='resting'))
    with client(REACH) as robot:
        robot.subscribe('/diagnostics', 'reward')
        robot.spin_until(lambda: len(robot.received['reward']) > 5, 'ticks')
        policy.send_signal(signal.SIGKILL)
        text = 'commands have stopped, the robot holds; /policy_node sends none'
        robot.spin_until(
            lambda: any(text in report.message for report in robot.reports()), 'warning'
        )
        assert robot.reports()[-1].level == b'\x01'
        # A successor is one commander, though the graph remembers the first for 20 s.
        successor = start_process(*POLICY_NODE, *ros_args(policy='resting'))
        robot.spin_until(lambda: 'stopped' not in robot.reports()[-1].message, 'commands')
        assert 'publish commands' not in robot.reports()[-1].message
        assert robot.values()['commanders'] == '/policy_node'
    output = end(sim)
    assert output.count(text) == 1
    assert 'commands come from /policy_node' in output
    end(successor)


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


def test_a_robot_without_a_log_prints_its_settings_and_episodes(start_process: Start) -> None:
    arguments = ros_args(real_time_factor=0.0, episodes=2, seed=5, use_sim_time=True)
    sim = start_process(*SIM_NODE, *arguments, '-r', '__ns:=/arm1')
    output, errors = sim.communicate(timeout=30.0)
    assert sim.returncode == 0, errors
    use_sim_time, first, *episodes = (output + errors).strip().splitlines()
    assert (
        'use_sim_time is set back to false: sim_node itself publishes simulated time'
        in use_sim_time
    )
    assert first.endswith(
        'FetchReach, 25 ticks per simulated second, as fast as possible; topics in /arm1; '
        'log: off; no commands yet'
    )
    assert [re.search(r'episode \d seed \d: 50 steps, return', line)[0] for line in episodes] == [
        'episode 0 seed 5: 50 steps, return',
        'episode 1 seed 6: 50 steps, return',
    ]


def test_two_robots_of_one_name_both_report_it(start_process: Start) -> None:
    sims = [start_process(*SIM_NODE, *ros_args()) for _ in range(2)]
    line = '2 nodes publish as one robot: /sim_node, /sim_node; give each its own namespace'
    with client(REACH) as robot:
        robot.subscribe('/diagnostics')
        robot.spin_until(
            lambda: sum(line in report.message for report in robot.reports()) > 2, 'errors'
        )
        assert all(each.level == b'\x02' for each in robot.reports() if line in each.message)
        assert not any('publish_clock' in report.message for report in robot.reports())
    assert [line in end(sim) for sim in sims] == [True, True]


def test_publishers_that_the_robot_cannot_receive_are_reported(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(task='HandReach'))
    lines = (
        '/set_goal of /client is not received: its type is geometry_msgs/msg/PointStamped',
        '/commands of /client is not received: it is best effort; allowed: reliable',
    )
    with client(REACH) as robot:
        robot.subscribe('/diagnostics')
        robot.publisher('set_goal')
        best_effort = rclpy_profile(QosSpec(1, 'best_effort', 'volatile'))
        robot.node.create_publisher(Float64MultiArray, 'commands', best_effort)
        robot.spin_until(
            lambda: any(all(line in each.message for line in lines) for each in robot.reports()),
            'both lines',
        )
    output = end(sim)
    assert all(line in output for line in lines)
