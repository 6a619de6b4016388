"""`policy_node` as a user meets it: wrong names, other robots, paused robots, other namespaces."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import SetBool

from msgs_spec.codecs import build_status, decode_status
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import topic
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Client,
    Start,
    client,
    end,
    episodes_in,
    finish,
    ros_args,
)

REACH = task_spec('FetchReach')


@pytest.mark.parametrize(
    ('parameters', 'line'),
    [
        ({'policy': 'nosuch'}, "no actor 'nosuch'; shipped: "),
        ({'checkpoint': 'nosuch'}, "no actor 'nosuch'; shipped: "),
        ({'policy': 'FetchReach', 'task': 'HandReach'}, 'trained on FetchReach, not on HandReach'),
    ],
)
def test_a_policy_that_is_not_there_is_noticed_before_a_robot_is(
    start_process: Start, parameters: dict[str, object], line: str
) -> None:
    code, output = finish(start_process(*POLICY_NODE, *ros_args(**parameters)))
    assert code == 2
    assert line in output
    assert 'Traceback' not in output
    assert ('checkpoint is now called policy' in output) == ('checkpoint' in parameters)


def test_a_zip_of_strangers_is_refused_at_the_start(start_process: Start, tmp_path: Path) -> None:
    path = tmp_path / 'model.zip'
    path.write_bytes(b'no zip')
    code, output = finish(start_process(*POLICY_NODE, *ros_args(policy=path)))
    assert (code, 'trust:=true' in output) == (2, True), output
    code, output = finish(
        start_process(*POLICY_NODE, *ros_args(policy=path, trust=True, task='FetchReach'))
    )
    assert (code, 'is not a file of Stable-Baselines3' in output) == (2, True), output


def test_a_robot_that_comes_back_with_another_task_gets_its_own_actor(
    start_process: Start, tmp_path: Path
) -> None:
    policy = start_process(*POLICY_NODE)
    for task in ('FetchReach', 'HandReach', 'FetchReach'):
        arguments = ros_args(
            task=task, episodes=1, mode='lockstep', wait_for_commands=True, episode_dir=tmp_path
        )
        code, output = finish(start_process(*SIM_NODE, *arguments))
        assert code == 0, output
    assert policy.poll() is None
    output = end(policy)
    assert 'the robot changed from FetchReach at 25 Hz to HandReach at 25 Hz' in output
    assert 'HandReach: commands come from actor HandReach.safetensors' in output
    logged = episodes_in(tmp_path)
    assert sorted(e.metadata['task'] for e in logged) == ['FetchReach', 'FetchReach', 'HandReach']
    assert len({e.metadata['checkpoint_sha256'] for e in logged}) == 2


def test_a_paused_robot_is_no_silent_one_and_acting_needs_no_torch(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(wait_for_commands=True))
    policy = start_process(*POLICY_NODE)
    with client(REACH) as robot:
        robot.subscribe('applied_command', '/diagnostics')
        robot.spin_until(lambda: len(robot.received['applied_command']) > 3, 'commands')
        maps = Path(f'/proc/{policy.pid}/maps').read_text()
        assert 'libtorch' not in maps and '_multiarray' in maps
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        robot.spin(4.0)
        reports = [
            message
            for message in robot.received['/diagnostics']
            if message.status[0].name == '/policy_node'
        ]
        assert reports[-1].status[0].message == 'FetchReach: the robot is paused'
        assert float(decode_status(reports[-1])['observation age (s)']) > 2.5
        # Wall time, as REP 107 has it.
        assert abs(reports[-1].header.stamp.sec - time.time()) < 10.0
    assert 'no state' not in end(policy)
    end(sim)


def test_a_pause_ends_with_its_robot(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE)
    sim = _answered_robot(start_process, REACH)
    with client(REACH) as robot:
        robot.subscribe('/diagnostics')
        assert robot.call(SetBool, 'sim_node/pause', data=True).success
        paused = 'FetchReach: the robot is paused'
        robot.spin_until(lambda: _last_report(robot) == paused, 'the pause')
        end(sim)
        # What follows, such as a replay, need not say that it is not paused.
        robot.node.create_publisher(DiagnosticArray, 'episode_status', 1)
        robot.spin_until(lambda: _last_report(robot).startswith('no state: '), 'a report')
    end(policy)


def _last_report(robot: Client) -> str:
    reports = robot.reports('/policy_node')
    return str(reports[-1].message) if reports else ''


def test_a_policy_of_another_rate_is_refused_while_another_acts(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(mode='lockstep', control_hz=50.0))
    policy = start_process(*POLICY_NODE, *ros_args(policy='random'))
    with client(REACH) as robot:
        robot.subscribe('applied_command')
        commands = robot.received['applied_command']
        robot.spin_until(lambda: len(commands) > 3, 'commands')
        result = _set_policy(robot, 'FetchReach')
        assert not result.successful
        assert 'was trained at 25 Hz; the robot runs at 50 Hz' in result.reason
        count = len(commands)
        robot.spin_until(lambda: len(commands) > count + 3, 'more of them')
    end(policy)


def test_an_actor_of_another_task_may_be_set_once_the_robot_is_gone(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE)
    end(_answered_robot(start_process, REACH))
    with client(REACH) as connection:
        status = topic(REACH, 'episode_status').name
        connection.spin_until(lambda: not connection.node.count_publishers(status), 'no robot')
        assert not _set_policy(connection, 'nosuch').successful
        assert _set_policy(connection, 'HandReach').successful
    hand = _answered_robot(start_process, task_spec('HandReach'))
    assert policy.poll() is None
    assert 'HandReach: commands come from actor HandReach.safetensors' in end(policy)
    end(hand)


def _answered_robot(start_process: Start, task: TaskSpec) -> subprocess.Popen[str]:
    """Starts a robot and waits until it is commanded."""
    sim = start_process(*SIM_NODE, *ros_args(task=task.name, wait_for_commands=True))
    with client(task) as robot:
        robot.subscribe('applied_command')
        robot.spin_until(lambda: len(robot.received['applied_command']) > 3, 'commands')
    return sim


def _set_policy(robot: Client, name: str) -> SetParametersResult:
    wanted = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
    parameter = Parameter(name='policy', value=wanted)
    answer = robot.call(SetParameters, 'policy_node/set_parameters', parameters=[parameter])
    (result,) = answer.results
    return result


def test_robots_in_other_namespaces_are_named(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep'), '-r', '__ns:=/arm1')
    # ROS logs to standard error.
    policy = start_process(*POLICY_NODE)
    lines: list[str] = []
    assert policy.stderr is not None
    while not any('/arm1' in line for line in lines):
        line = policy.stderr.readline()
        assert line, lines
        lines.append(line)
    assert 'waiting for a robot on /episode_status' in lines[0]
    assert 'no robot here: found in /arm1; join it with --ros-args -r __ns:=/arm1' in line
    end(policy)
    end(sim)


def test_a_robot_whose_topics_have_other_names_is_found(start_process: Start) -> None:
    arguments = ros_args(episodes=1, mode='lockstep', wait_for_commands=True)
    names = ['joint_states:=/arm/joints', 'commands:=/arm/goals', 'policy_status:=/arm/policy']
    remapped = [word for name in names for word in ('-r', name)]
    policy = start_process(*POLICY_NODE, '--ros-args', *remapped)
    code, output = finish(start_process(*SIM_NODE, *arguments, *remapped))
    assert code == 0, output
    end(policy)


def publish_status(robot: Client, nanosec: int = 0, **values: str) -> None:
    """What a robot says of itself that publishes nothing else."""
    status = topic(REACH, 'episode_status')
    said = EpisodeStatus(
        task='FetchReach',
        episode=0,
        seed=0,
        tick=0,
        phase='waiting',
        control_hz=25.0,
        reward_type='sparse',
        success_rule='gymnasium',
        episode_return=0.0,
        is_success=False,
    )
    message = build_status(status, 0, 'episode', said.to_values() | values)
    message.header.stamp.nanosec = nanosec
    robot.publish(status.name, serialize(status.type_name, message))


def test_topics_that_a_robot_lacks_are_named(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE)
    with client(REACH) as robot:
        publish_status(robot)
        robot.subscribe('/diagnostics')

        def line() -> str:
            reports = robot.reports('/policy_node')
            return str(reports[-1].message) if reports else ''

        robot.spin_until(lambda: 'no publisher of /joint_states, ' in line(), 'report')
    output = end(policy)
    assert 'no state: no publisher of /joint_states, ' in output
    assert 'commands come from' not in output


def test_a_robot_of_a_rate_that_physics_has_not_is_none(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE, *ros_args(policy='random'))
    with client(REACH) as robot:
        robot.connect('episode_status')
        for control_hz in ('0', '30.0'):
            publish_status(robot, control_hz=control_hz)
            robot.spin(2.5)
    assert policy.poll() is None
    output = end(policy)
    for control_hz in ('0', '30'):
        assert f'ignored: episode_status with control_hz {control_hz} is not' in output
    assert 'Traceback' not in output


def test_words_that_nobody_can_act_on_end_nothing(start_process: Start) -> None:
    """Before there is a robot, when nothing is known that they could be held against."""
    policy = start_process(*POLICY_NODE)
    with client(REACH) as robot:
        robot.connect('episode_status')
        publish_status(robot, task='NoSuchTask')
        robot.spin(1.2)
        publish_status(robot, reason='x' * 100_000)
        robot.spin(1.2)
        # More nanoseconds than can be sent again.
        publish_status(robot, nanosec=10**9)
        robot.spin(0.5)
    end(_answered_robot(start_process, REACH))
    output = end(policy)
    assert "ignored: unknown task 'NoSuchTask'; allowed: FetchReach, " in output
    assert 'ignored: stamp with nanosec 1000000000; allowed: less than 1000000000' in output
    assert re.search(r'episode_status ignored: 100\d\d\d bytes given; allowed: up to 65536', output)
    assert 'Traceback' not in output


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


def test_a_robot_that_does_not_fit_ends_nothing_that_works(start_process: Start) -> None:
    policy = start_process(*POLICY_NODE, *ros_args(policy='FetchReach'))
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
    output = end(policy)
    assert 'actor FetchReach.safetensors was trained at 25 Hz; the robot runs at 50 Hz' in output
    assert 'ignored: another robot here, FetchReach at 50 Hz' in output
    assert 'trained on FetchReach, not on HandReach' in output
    assert 'the robot changed' not in output


def test_a_robot_that_comes_back_as_one_that_does_not_fit_is_not_commanded(
    start_process: Start,
) -> None:
    policy = start_process(*POLICY_NODE, *ros_args(policy='FetchReach'))
    end(_answered_robot(start_process, REACH))
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep', control_hz=50.0))
    code, output = finish(policy)
    assert code == 1
    assert 'actor FetchReach.safetensors was trained at 25 Hz; the robot runs at 50 Hz' in output
    end(sim)


@pytest.mark.alone
def test_the_first_command_comes_soon_after_the_start(start_process: Start) -> None:
    """Under 3 s on an idle machine; this one may be busy, so only what it costs is counted."""
    import resource

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = (
        'import threading, os, signal; from policy_node.node import main\n'
        'threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start(); main()'
    )
    process = start_process(sys.executable, '-c', code)
    assert finish(process)[0] == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert used < 2.0
