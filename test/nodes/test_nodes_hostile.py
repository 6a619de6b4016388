"""Floods, stops, bad parameters, several robots, and Ctrl-C at any time."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from std_msgs.msg import Float64MultiArray

from msgs_spec.codecs import TopicCodec, message_stamp
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, task_spec
from msgs_spec.topics import topic, topics
from support import wait_until
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Start,
    client,
    end,
    finish,
    ros_args,
)
from support.hostile_messages import hostile_bytes

REACH = task_spec('FetchReach')


def resident_kilobytes(process: subprocess.Popen[str]) -> int:
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(re.search(r'VmRSS:\s+(\d+) kB', status)[1])


@pytest.mark.alone
def test_neither_a_stop_nor_a_flood_of_commands_disturbs_the_robot_for_long(
    start_process: Start,
) -> None:
    sim = start_process(*SIM_NODE)
    source = topic(REACH, 'commands')
    good = TopicCodec(source).encode(0, np.full(4, 0.1))
    bad = TopicCodec(source).encode(0, np.full(4, np.nan))
    with client(REACH) as robot:
        robot.subscribe('joint_states', '/diagnostics')
        robot.connect('commands')
        robot.spin_until(lambda: bool(robot.reports()), 'a report')
        before = int(robot.values()['missed ticks'])
        sim.send_signal(signal.SIGSTOP)
        robot.spin(2.0)
        sim.send_signal(signal.SIGCONT)
        robot.spin(0.05)
        began, count = time.monotonic(), len(robot.received['joint_states'])
        robot.spin(1.5)
        rate = (len(robot.received['joint_states']) - count) / (time.monotonic() - began)
        robot.spin_until(lambda: int(robot.values()['missed ticks']) - before >= 45, 'report')
        # 50 missed ticks and 25 Hz on a quiet machine: it never catches up.
        assert int(robot.values()['missed ticks']) - before <= 80
        assert 12.5 < rate < 27.0

        robot.publish('commands', Float64MultiArray(data=np.zeros(1_000_000)))
        robot.spin_until(lambda: int(robot.values()['rejected: too long']) == 1, 'rejection')
        before, sent = resident_kilobytes(sim), 0
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < 3.0:
            while sent < 20_000 * elapsed:
                robot.publish('commands', (good, bad)[sent % 2])
                sent += 1
            robot.spin(0.0005)
        assert sent > 5_000
        grown = resident_kilobytes(sim) - before
        # On a busy machine most push each other out before they are read.
        robot.spin_until(
            lambda: (
                int(robot.values()['rejected: not finite']) > 100
                and int(robot.values()['commands accepted']) > 100
            ),
            'report of the flood',
        )
        states = zip(robot.received['joint_states'], robot.received_at['joint_states'], strict=True)
        during = [message_stamp(state) for state, at in states if began < at < began + 3.0]
        # By the robot's own time: who floods it misses messages itself.
        rate = (during[-1] - during[0]) * 1e-9 * DEFAULT_CONTROL_HZ / 3.0
    # 25 on a machine with a processor to spare; a robot that reads all that comes has next to none.
    assert rate > 12.5
    assert grown < 20_000
    end(sim)


@pytest.mark.alone
def test_hostile_messages_on_every_input_leave_robot_policy_and_log_sound(
    start_process: Start, tmp_path: Path, hostile_count: int
) -> None:
    """`make torture` sends 100,000: the robot ticks on, and its log is identical."""
    task = 'HandReach'
    spec, generator = task_spec(task), np.random.default_rng(11)
    logs = tmp_path / 'logs'
    # An unread pipe would be full after 60,000 messages and block the robot.
    with (tmp_path / 'output').open('w') as output:
        said = {'stdout': output, 'stderr': output}
        sim = start_process(*SIM_NODE, *ros_args(task=task, episode_dir=logs), **said)
        policy = start_process(*POLICY_NODE, *ros_args(task=task), **said)
    inputs = [each for each in topics(spec) if each.direction == 'subscribed']
    with client(spec) as robot:
        robot.subscribe('joint_states', 'policy_status', '/diagnostics')
        for each in inputs:
            robot.connect(each.name)
        robot.spin_until(lambda: bool(robot.received['policy_status']), 'a policy')
        for index in range(hostile_count):
            target = inputs[generator.integers(len(inputs))]
            robot.publish(target.name, hostile_bytes(generator, target))
            # About as fast as they are read, so that hardly any pushes another one out.
            if index % 5 == 0:
                robot.spin(0.005)
        seen = len(robot.received['joint_states'])
        robot.spin_until(lambda: len(robot.received['joint_states']) > seen + 10, 'more ticks')
        robot.spin_until(lambda: len(robot.reports()) > 1, 'a report')
        report = robot.values()
        positions = np.array([message.position for message in robot.received['joint_states']])
        # For a parameter of an unknown type, the services of rclpy raise an error in the node.
        given = [Parameter(name='real_time_factor', value=ParameterValue(type=200))]
        answer = robot.call(SetParameters, 'sim_node/set_parameters', parameters=given)
        together = robot.call(
            SetParametersAtomically, 'sim_node/set_parameters_atomically', parameters=given
        )
    for result in (*answer.results, together.result):
        assert not result.successful
        assert result.reason.startswith('real_time_factor: type 200 given; allowed: 0 (NO')
    assert np.isfinite(positions).all()
    refused = [int(count) for name, count in report.items() if name.startswith('rejected: ')]
    assert sum(refused) > hostile_count / 20
    assert int(report['commands accepted']) > hostile_count / 20
    assert int(report['divergences']) == 0
    end(sim)
    end(policy)
    assert 'Traceback' not in (tmp_path / 'output').read_text()
    check = [sys.executable, '-m', 'fetch_hand_sim', 'episodes', 'check', str(logs)]
    result = subprocess.run(check, capture_output=True, text=True)
    assert any(logs.iterdir()) and result.returncode == 0, result.stdout + result.stderr


@pytest.mark.release
def test_memory_stays_flat_at_twenty_times_real_time(
    start_process: Start, soak_seconds: float, tmp_path: Path
) -> None:
    # Each of ten episodes a second prints a line. An unread pipe would be full after a minute and
    # block the process.
    with (tmp_path / 'log').open('w') as log, client(REACH) as robot:
        said = {'stdout': log, 'stderr': log}
        sim = start_process(*SIM_NODE, *ros_args(real_time_factor=20.0), **said)
        policy = start_process(*POLICY_NODE, *ros_args(policy='random'), **said)
        robot.subscribe('/diagnostics')
        robot.spin_until(
            lambda: (
                bool(robot.reports('/policy_node'))
                and int(robot.values('/policy_node').get('commands', 0)) > 100
            ),
            'commands',
        )
        robot.spin_until(lambda: bool(robot.reports()), 'a report')
        robot.spin(2.0)
        before = [resident_kilobytes(process) for process in (sim, policy)]
        ticks = int(robot.values()['ticks'])
        deadline = time.monotonic() + soak_seconds
        while time.monotonic() < deadline:
            robot.spin(5.0)
            assert robot.reports() and robot.reports('/policy_node'), 'both go on'
            robot.received.clear()
            robot.received_at.clear()
        robot.spin_until(lambda: bool(robot.reports()), 'a report')
        after = [resident_kilobytes(process) for process in (sim, policy)]
        ticks = int(robot.values()['ticks']) - ticks
    print(f'{ticks} ticks; kB before {before}, after {after}')
    assert ticks > 100 * soak_seconds
    assert max(b - a for a, b in zip(before, after, strict=True)) < 4_000
    for process in (sim, policy):
        end(process)


def has_handler(process: subprocess.Popen[str]) -> bool:
    """Return whether a process catches SIGTERM: Python itself catches SIGINT from its start."""
    assert process.poll() is None
    status = Path(f'/proc/{process.pid}/status').read_text()
    return bool(int(re.search(r'SigCgt:\s+(\w+)', status)[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize(
    'command',
    [SIM_NODE, pytest.param(POLICY_NODE, marks=pytest.mark.release)],
    ids=['sim_node', 'policy_node'],
)
def test_ctrl_c_at_any_moment_ends_with_0_and_no_traceback(
    start_process: Start, command: tuple[str, ...]
) -> None:
    arguments = ros_args(policy='FetchReach') if command is POLICY_NODE else ros_args()
    robot = start_process(*SIM_NODE, *ros_args(mode='lockstep'))
    delays = (0.0, 0.1, 0.4, 1.2)
    for group in (delays[::2], delays[1::2]):
        processes = [start_process(*command, *arguments) for _ in group]
        for process in processes:
            wait_until(lambda: has_handler(process), 'signal handler')  # noqa: B023
        began = time.monotonic()
        for process, delay in zip(processes, group, strict=True):
            time.sleep(max(0.0, began + delay - time.monotonic()))
            process.send_signal(signal.SIGINT)
        for process, delay in zip(processes, group, strict=True):
            code, output = finish(process)
            assert code == 0, (delay, output)
            assert 'Traceback' not in output, (delay, output)
    end(robot)
