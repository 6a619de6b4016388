"""Lockstep on a real graph: equal bytes everywhere, stalls that say why, commanders that return."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from std_srvs.srv import Trigger

from fetch_hand_sim.episode_log import read_summary
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.tick import TickEncoder
from policy_node.node.responder import Responder
from policy_node.policies.loading import load_policy
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Start,
    client,
    end,
    episodes_in,
    finish,
    payload,
    ros_args,
)

REACH = task_spec('FetchReach')
SEED = 7


def logged_run(start: Start, directory: Path, **parameters: object):
    """Episodes of one run of a robot, each a dict of all message bytes."""
    arguments = ros_args(seed=SEED, wait_for_commands=True, episode_dir=directory, **parameters)
    code, output = finish(start(*SIM_NODE, *arguments), timeout=60.0)
    assert code == 0, output
    return [payload(episode) for episode in episodes_in(directory)]


def batch_run(
    spec: TaskSpec, episodes: int, disturbances: str = 'none', policy: str = ''
) -> list[dict[str, list[bytes]]]:
    """The same without ROS: bytes by topic for each episode."""
    simulation = Simulation(spec.name, num_threads=1, disturbances=disturbances)
    runner = EpisodeRunner(simulation, first_seed=SEED, episodes=episodes)
    encoder, buffer = TickEncoder(spec), CommandBuffer(spec.robot, 0.0)
    status = runner.waiting_status()
    sent: list[bytes] = []
    loaded = load_policy(policy, status.task)
    responder = Responder(loaded, status, lambda data: sent.append(data) or True)
    result: list[dict[str, list[bytes]]] = []
    while not runner.is_done:
        tick = runner.advance(buffer.take())
        messages = encoder.encode(tick, latched=tick.status.phase != 'running')
        if tick.status.phase == 'reset':
            buffer.start_episode(runner.resting_command())
            result.append({})
        for source, data in messages:
            result[-1].setdefault('/' + source.name.lstrip('/'), []).append(data)
        responder.note_phase(tick.status.phase, tick.stamp_ns)
        published = {source.name: data for source, data in messages}
        for source in responder.topics:
            responder.receive(source.name, published[source.name])
        responder.answer()
        command = deserialize('std_msgs/msg/Float64MultiArray', sent[-1])
        buffer.accept(command.data)
        if tick.status.phase != 'finished':
            result[-1].setdefault('/commands', []).append(sent[-1])
    return result


def without_times(episode) -> dict[str, list[bytes]]:
    return {name: [data for _, _, data in messages] for name, messages in episode.items()}


def test_bytes_are_equal_between_runs_and_without_ros(start_process: Start, tmp_path: Path) -> None:
    # One policy for all of them: what it did before must not matter.
    policy = start_process(*POLICY_NODE)
    first = logged_run(start_process, tmp_path / '1', mode='lockstep', episodes=2)
    second = logged_run(start_process, tmp_path / '2', mode='lockstep', episodes=2)
    assert first == second
    assert [without_times(episode) for episode in first] == batch_run(REACH, 2)
    assert first[0]['/joint_states'] != first[1]['/joint_states']
    end(policy)


def test_a_disturbed_episode_is_the_same_over_ros_in_the_batch_and_in_its_check(
    start_process: Start, tmp_path: Path
) -> None:
    policy = start_process(*POLICY_NODE, *ros_args(policy='robust'))
    logged = logged_run(
        start_process, tmp_path, mode='lockstep', episodes=2, disturbances='hardware'
    )
    end(policy)
    batch = batch_run(REACH, 2, 'hardware', 'FetchReach_robust')
    assert [without_times(each) for each in logged] == batch
    assert logged[0]['/ground_truth/joint_states'] != logged[0]['/joint_states']
    for path in tmp_path.iterdir():
        assert check_episode(path).difference is None
        assert 'action_latency' in read_summary(path).metadata['variation']


def test_disturbances_change_between_episodes(start_process: Start, tmp_path: Path) -> None:
    policy = start_process(*POLICY_NODE)
    arguments = ros_args(mode='lockstep', wait_for_commands=True, episode_dir=tmp_path)
    sim = start_process(*SIM_NODE, *arguments, '-p', 'log_compiled_model:=false')
    with client(REACH) as robot:
        robot.subscribe('reward')
        robot.spin_until(lambda: robot.received['reward'], 'ticks')
        for value, is_right in (('severe*2', True), ('sever', False)):
            result = robot.set_parameter('sim_node', 'disturbances', value)
            assert result.successful == is_right and ('mild' in result.reason) != is_right
        count = len(robot.received['reward'])
        robot.spin_until(lambda: len(robot.received['reward']) > count + 120, 'two episodes')
    end(sim)
    end(policy)
    first, *_, last = sorted(tmp_path.iterdir())
    assert 'disturbances' not in read_summary(first).metadata
    assert 'latency' in read_summary(last).metadata['disturbances']
    assert check_episode(last).difference is None


def test_resets_leave_a_policy_no_tick_behind(start_process: Start, tmp_path: Path) -> None:
    """A command on its way at a reset answers the state before it, and is not applied after it."""
    policy = start_process(*POLICY_NODE)
    arguments = ros_args(
        mode='lockstep', seed=SEED, episodes=60, wait_for_commands=True, episode_dir=tmp_path
    )
    sim = start_process(*SIM_NODE, *arguments, '-p', 'log_compiled_model:=false')
    with client(REACH) as robot:
        robot.subscribe('reward')
        for _ in range(4):
            count = len(robot.received['reward'])
            robot.spin_until(lambda: len(robot.received['reward']) > count + 70, 'ticks')  # noqa: B023
            assert robot.call(Trigger, 'sim_node/reset').success
        end(sim)
    end(policy)
    episodes = {int(e.metadata['episode']): e for e in episodes_in(tmp_path)}
    undisturbed = batch_run(REACH, max(episodes) + 1)
    cut = [number for number, episode in episodes.items() if not episode.is_complete]
    assert len(cut) > 1
    for number in episodes.keys() - cut:
        for name in ('/applied_command', '/reward'):
            messages = episodes[number].topics[name].messages
            assert [message.data for message in messages] == undisturbed[number][name], number


def test_every_command_of_a_burst_has_its_own_tick(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep'))
    with client(REACH) as robot:
        robot.subscribe('applied_command', 'joint_states')
        robot.connect('commands')
        robot.spin_until(lambda: bool(robot.received['joint_states']), 'the reset')
        applied = robot.received['applied_command']
        # A command whose tick arrives shows that both directions are connected.
        while not applied:
            robot.command(0, 0, 0, 0)
            robot.spin(0.3)
        robot.spin(0.3)
        applied.clear()
        sent = [0.125 * number for number in range(1, 8)]
        for value in sent:
            robot.command(value, 0, 0, 0)
        robot.spin_until(lambda: len(applied) >= len(sent), 'a tick for each')
        robot.spin(0.3)
        assert [message.data[0] for message in applied] == sent
    end(sim)


def test_commander_comes_late_dies_and_returns(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(mode='lockstep'))
    with client(REACH) as robot:
        robot.subscribe('reward', 'joint_states')
        robot.connect('set_goal')
        # The reset tick is long gone when the first commander appears.
        policy = start_process(*POLICY_NODE, *ros_args(policy='resting'))
        ticks = robot.received['reward']
        robot.spin_until(lambda: len(ticks) > 20, 'ticks')
        policy.kill()
        policy.wait()
        robot.spin(0.2)
        count = len(ticks)
        robot.spin(0.5)
        assert len(ticks) == count
        assert len({str(m.header.stamp) for m in robot.received['joint_states']}) <= count + 9
        again = start_process(*POLICY_NODE, *ros_args(policy='resting'))
        robot.spin_until(lambda: len(ticks) > count + 20, 'ticks of the next commander')
        again.send_signal(signal.SIGSTOP)
        robot.spin(0.2)
        count = len(ticks)
        # The robot logs the missing command once in five seconds.
        robot.spin(5.2)
        assert len(ticks) == count
        again.send_signal(signal.SIGCONT)
        robot.spin_until(lambda: len(ticks) > count + 20, 'ticks after the stop')
    output = end(sim)
    assert 'of episode' in output
    assert 'waits for a valid command; /policy_node sends none' in output


def test_two_commanders_are_reported_and_health_is_published(start_process: Start) -> None:
    sim = start_process(*SIM_NODE, *ros_args(real_time_factor=4.0))
    policy = start_process(*POLICY_NODE, *ros_args(policy='random', use_sim_time=True))
    with client(REACH) as robot:
        robot.subscribe('/diagnostics', 'real_time_factor', 'policy_status', 'joint_states')
        robot.connect('commands')

        def message(node: str) -> str:
            return robot.reports(node)[-1].message

        robot.spin_until(lambda: '/client' in message('/sim_node'), 'a report')
        assert '2 publish commands: /client, /policy_node' in message('/sim_node')
        robot.command(0, 0, 0)
        robot.spin_until(lambda: '1 commands rejected' in message('/sim_node'), 'the rejection')
        assert robot.reports()[-1].level == b'\x01'
        values = robot.values()
        assert values['rejected: wrong size'] == '1'
        assert values['log'] == 'off'
        assert float(values['tick time p99 (ms)']) > 0.0
        robot.spin_until(lambda: 'commands per second' in message('/policy_node'), 'a policy')
        assert float(robot.values('/policy_node')['inference p50 (ms)']) > 0.0
        # Both in wall time, though one node follows the simulated; who commands, in the robot's.
        for each in robot.received['/diagnostics'][-2:]:
            assert abs(message_stamp(each) - time.time_ns()) < 10e9
        (introduction,) = robot.received['policy_status']
        assert 0 < message_stamp(introduction) < robot.stamps('joint_states')[-1]
        factors = robot.received['real_time_factor']
        robot.spin_until(lambda: any(abs(m.data - 4.0) < 0.4 for m in factors), 'factor of 4')
        robot.set_parameter('sim_node', 'real_time_factor', 0.1)
        factors.clear()
        robot.spin_until(lambda: any(abs(m.data - 0.1) < 0.05 for m in factors), 'factor of 0.1')
    for process in (sim, policy):
        process.send_signal(signal.SIGTERM)
    code, output = finish(sim)
    assert code == 0
    assert '2 publish commands: /client, /policy_node' in output
    assert finish(policy)[0] == 0
