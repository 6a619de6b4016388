"""`policy_node` as a user meets it: wrong names, other robots, paused robots, other namespaces."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from msgs_spec.codecs import build_status
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.topics import topic
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Client,
    Start,
    client,
    end,
    finish,
    logged_run,
    ros_args,
)
from support.random_ticks import episode_status

REACH = task_spec('FetchReach')


def test_an_invalid_policy_is_reported_without_a_robot(
    start_process: Start, tmp_path: Path
) -> None:
    path = tmp_path / 'model.zip'
    path.write_bytes(b'no zip')
    cases: list[tuple[dict[str, object], str]] = [
        ({'checkpoint': 'nosuch'}, "no actor 'nosuch'; shipped: "),
        ({'policy': 'FetchReach', 'task': 'HandReach'}, 'trained on FetchReach, not on HandReach'),
        ({'policy': path}, 'trust:=true'),
        (
            {'policy': path, 'trust': True, 'task': 'FetchReach'},
            'is not a file of Stable-Baselines3',
        ),
    ]
    nodes = [start_process(*POLICY_NODE, *ros_args(**parameters)) for parameters, _ in cases]
    for node, (parameters, line) in zip(nodes, cases, strict=True):
        code, output = finish(node)
        assert code == 2 and line in output, output
        assert 'Traceback' not in output
        assert ('checkpoint is now called policy' in output) == ('checkpoint' in parameters)


def test_a_robot_that_comes_back_with_another_task_gets_its_own_actor(
    start_process: Start, tmp_path: Path
) -> None:
    """Also once such an actor has been set while no robot was there."""
    policy = start_process(*POLICY_NODE)
    for task in ('FetchReach', 'HandReach', 'FetchReach'):
        logged = logged_run(start_process, tmp_path, task=task, episodes=1)
    with client(REACH) as robot:
        status = topic(REACH, 'episode_status').name
        robot.spin_until(lambda: not robot.node.count_publishers(status), 'no robot')
        assert not robot.set_parameter('policy_node', 'policy', 'nosuch').successful
        assert robot.set_parameter('policy_node', 'policy', 'HandReach').successful
    end(_answered_robot(start_process, task_spec('HandReach')))
    assert policy.poll() is None
    output = end(policy)
    assert 'the robot changed from FetchReach at 25 Hz to HandReach at 25 Hz' in output
    assert 'HandReach: commands come from actor HandReach.safetensors' in output
    assert sorted(e.metadata['task'] for e in logged) == ['FetchReach', 'FetchReach', 'HandReach']
    assert len({e.metadata['checkpoint_sha256'] for e in logged}) == 2


def test_a_paused_robot_is_reported_until_it_is_gone(start_process: Start) -> None:
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with client(REACH) as robot:
        # An incompatible subscription, which never connects, does not hold the robot up.
        robot.node.create_subscription(JointState, 'joint_states', print, profile)
        robot.subscribe('applied_command', '/diagnostics')
        sim = start_process(*SIM_NODE, *ros_args(wait_for_commands=True))
        policy = start_process(*POLICY_NODE)
        robot.spin_until(lambda: len(robot.received['applied_command']) > 3, 'commands')
        maps = [Path(f'/proc/{process.pid}/maps').read_text() for process in (sim, policy)]
        assert 'libtorch' not in maps[1] and '_multiarray' in maps[1], 'a policy needs no PyTorch'
        # Through shared memory a listener that is stopped or killed would hold a node up. The
        # client has some, under the name that is looked for.
        assert not any('/dev/shm/fastrtps' in each for each in maps)
        assert '/dev/shm/fastrtps' in Path('/proc/self/maps').read_text()
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        robot.spin_until(
            lambda: (
                robot.reports('/policy_node')[-1].message == 'FetchReach: the robot is paused'
                and float(robot.values('/policy_node')['observation age (s)']) > 2.5
            ),
            'the pause',
        )
        assert not any('no state' in report.message for report in robot.reports('/policy_node'))
        end(sim)
        # Another publisher, such as a replay, may never report that it is running.
        robot.node.create_publisher(DiagnosticArray, 'episode_status', 1)
        robot.spin_until(
            lambda: robot.reports('/policy_node')[-1].message.startswith('no state: '),
            'the missing state',
        )
    end(policy)


def test_a_policy_of_another_rate_is_refused_while_another_acts(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(mode='lockstep', control_hz=50.0))
    policy = start_process(*POLICY_NODE, *ros_args(policy='random'))
    with client(REACH) as robot:
        robot.subscribe('applied_command')
        commands = robot.received['applied_command']
        robot.spin_until(lambda: len(commands) > 3, 'commands')
        result = robot.set_parameter('policy_node', 'policy', 'FetchReach')
        assert not result.successful
        assert 'was trained at 25 Hz; the robot runs at 50 Hz' in result.reason
        count = len(commands)
        robot.spin_until(lambda: len(commands) > count + 3, 'more of them')
    end(policy)


def _answered_robot(start_process: Start, task: TaskSpec) -> subprocess.Popen[str]:
    """Starts a robot and waits until it is commanded."""
    sim = start_process(*SIM_NODE, *ros_args(task=task.name, wait_for_commands=True))
    with client(task) as robot:
        robot.subscribe('applied_command')
        robot.spin_until(lambda: len(robot.received['applied_command']) > 3, 'commands')
    return sim


def wait_for_line(process: subprocess.Popen[str], text: str) -> list[str]:
    """Return the lines of a node up to the first one with a text; ROS logs to standard error."""
    lines = ['']
    assert process.stderr is not None
    while text not in lines[-1]:
        lines.append(process.stderr.readline())
        assert lines[-1], lines
    return lines[1:]


def test_robot_and_policy_in_different_namespaces_name_each_other(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE)
    assert len(wait_for_line(policy, 'waiting for a robot on /episode_status')) == 1
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep'), '-r', '__ns:=/arm1')
    text = 'no node publishes any; /policy_node waits for a robot on /episode_status'
    with client(REACH) as robot:
        robot.subscribe('/diagnostics')
        robot.spin_until(
            lambda: any(text in each.message for each in robot.reports('/arm1/sim_node')), 'line'
        )
    wait_for_line(policy, 'found in /arm1; join it with --ros-args -r __ns:=/arm1')
    end(policy)
    end(sim)


def test_a_robot_whose_topics_have_other_names_is_found(
    start_process: Start, tmp_path: Path
) -> None:
    names = ['joint_states:=/arm/joints', 'commands:=/arm/goals', 'policy_status:=/arm/policy']
    remapped = [word for name in names for word in ('-r', name)]
    policy = start_process(*POLICY_NODE, '--ros-args', *remapped)
    assert logged_run(start_process, tmp_path, *remapped, episodes=1)
    end(policy)


def publish_status(robot: Client, nanosec: int = 0, **values: str) -> None:
    """Publish the status of a robot that publishes nothing else."""
    status = topic(REACH, 'episode_status')
    said = episode_status(REACH).to_values() | {'phase': 'waiting', 'control_hz': '25.0'}
    message = build_status(status, 0, 'episode', said | values)
    message.header.stamp.nanosec = nanosec
    robot.publish(status.name, serialize(status.type_name, message))


HANGING = """
import time


class Hanging:
    def predict(self, observation, *, deterministic=True):
        print('asked', flush=True)
        time.sleep(600.0)


def make(task):
    return Hanging()
"""


def test_a_policy_that_hangs_is_ended_by_the_second_ctrl_c(
    start_process: Start, tmp_path: Path
) -> None:
    (tmp_path / 'hanging_policy.py').write_text(HANGING)
    parameters = {'policy': 'hanging_policy:make', 'trust': True, 'task': 'FetchReach'}
    policy = start_process(*POLICY_NODE, *ros_args(**parameters), cwd=tmp_path)
    assert policy.stdout is not None
    while 'asked' not in policy.stdout.readline():
        assert policy.poll() is None
    policy.send_signal(signal.SIGINT)
    time.sleep(1.2)
    assert policy.poll() is None
    policy.send_signal(signal.SIGINT)
    assert policy.wait(timeout=10) == -signal.SIGINT


def test_an_invalid_status_is_ignored_and_a_robot_that_does_not_fit_is_not_commanded(
    start_process: Start,
) -> None:
    """A policy ends when a robot that does not fit is the only one."""
    policy = start_process(*POLICY_NODE, *ros_args(policy='FetchReach'))
    # Before there is a robot, when the policy cannot know what is right.
    cases: list[tuple[dict[str, Any], str]] = [
        ({'control_hz': '30.0'}, 'ignored: episode_status with control_hz 30 is not'),
        ({'task': 'NoSuchTask'}, "ignored: unknown task 'NoSuchTask'; allowed: FetchReach, "),
        ({'reason': 'x' * 100_000}, 'bytes given; allowed: up to 65536'),
        # More nanoseconds than can be sent again.
        ({'nanosec': 10**9}, 'ignored: stamp with nanosec 1000000000; allowed: less than 1000000'),
        ({}, 'no state: no publisher of /joint_states, '),
    ]
    with client(REACH) as robot:
        robot.connect('episode_status')
        lines = []
        for values, line in cases:
            publish_status(robot, **values)
            lines += wait_for_line(policy, line)
            # The node logs such lines once a second.
            robot.spin(1.1)
    assert not any('commands come from' in line for line in lines)
    sim = _answered_robot(start_process, REACH)
    with client(REACH) as robot:
        robot.subscribe('applied_command')
        robot.connect('episode_status')
        for values in ({'control_hz': '50.0'}, {'task': 'HandReach'}):
            publish_status(robot, **values)
            robot.spin(0.5)
        count = len(robot.received['applied_command'])
        robot.spin_until(
            lambda: len(robot.received['applied_command']) > count + 10, 'more commands'
        )
    end(sim)
    assert policy.poll() is None
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep', control_hz=50.0))
    code, output = finish(policy)
    assert code == 1 and 'Traceback' not in output
    assert output.count('FetchReach.safetensors was trained at 25 Hz; the robot runs at 50') == 2
    assert 'ignored: another robot here, FetchReach at 50 Hz' in output
    assert 'trained on FetchReach, not on HandReach' in output
    end(sim)
