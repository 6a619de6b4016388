"""Lockstep on a real graph: equal bytes everywhere, stalls that say why, commanders that return."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from std_srvs.srv import Trigger

from fetch_hand_sim.episode_log import Episode
from fetch_hand_sim.episodes.checker import check_episode
from msgs_spec.tasks import task_spec
from policy_node.training import generate_episodes
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Start,
    client,
    end,
    episodes_in,
    logged_run,
    ros_args,
)

REACH = task_spec('FetchReach')
SEED = 7


def generated(directory: Path, episodes: int, policy: str, *options: str) -> list[Episode]:
    """Run episodes without ROS."""
    arguments = ['--task', 'FetchReach', '--policy', policy, '--num-envs=1', '--threads=1']
    numbers = [f'--episodes={episodes}', f'--first-seed={SEED}', f'--output={directory}']
    assert generate_episodes.main([*arguments, *numbers, *options]) == 0
    return episodes_in(directory)


@pytest.mark.parametrize(
    ('policy', 'disturbances', 'runs'),
    [('FetchReach', 'hardware*0', 2), ('FetchReach_robust', 'hardware', 1)],
)
def test_logs_are_equal_between_runs_without_ros_and_in_their_check(
    start_process: Start, tmp_path: Path, policy: str, disturbances: str, runs: int
) -> None:
    # One policy for all of them: what it did before must not matter.
    node = start_process(*POLICY_NODE, *ros_args(policy=policy.removeprefix('FetchReach_')))
    settings = {'disturbances': disturbances, 'log_compiled_model': False, 'seed': SEED}
    folders = [tmp_path / str(run) for run in range(runs)]
    logs = [logged_run(start_process, folder, episodes=2, **settings) for folder in folders]
    end(node)
    logs.append(generated(tmp_path / 'batch', 2, policy, f'--disturbances={disturbances}'))
    for episodes in zip(*logs, strict=True):
        first, *others = episodes
        for episode in others:
            for part in ('topics', 'result', 'attachments'):
                assert getattr(episode, part) == getattr(first, part), part
            assert list(episode.metadata) == list(first.metadata)
            # A commit may come between the runs.
            same = first.metadata.keys() - {'started', 'source_revision'}
            assert all(episode.metadata[key] == first.metadata[key] for key in same)
        assert check_episode(first.path).difference is None
        assert ('action_latency' in first.metadata.get('variation', '')) == (runs == 1)
    topics = logs[0][0].topics
    assert topics['/joint_states'] != logs[0][1].topics['/joint_states']
    if disturbances == 'hardware':
        measured, true = topics['/joint_states'], topics['/ground_truth/joint_states']
        assert [m.data for m in measured.messages] != [m.data for m in true.messages]


def test_resets_leave_a_policy_no_tick_behind_and_disturbances_change_between_episodes(
    start_process: Start, tmp_path: Path
) -> None:
    """A command on its way at a reset answers the state before it, and is not applied after it."""
    policy = start_process(*POLICY_NODE)
    arguments = ros_args(
        mode='lockstep', seed=SEED, episodes=90, wait_for_commands=True, episode_dir=tmp_path / '1'
    )
    sim = start_process(*SIM_NODE, *arguments, '-p', 'log_compiled_model:=false')
    with client(REACH) as robot:
        robot.subscribe('reward')

        def run(ticks: int) -> None:
            count = len(robot.received['reward'])
            robot.spin_until(lambda: len(robot.received['reward']) > count + ticks, 'ticks')

        for _ in range(4):
            run(70)
            assert robot.call(Trigger, 'sim_node/reset').success
        for value, is_right in (('severe*2', True), ('sever', False)):
            result = robot.set_parameter('sim_node', 'disturbances', value)
            assert result.successful == is_right and ('mild' in result.reason) != is_right
        run(120)
        end(sim)
    end(policy)
    episodes = {int(e.metadata['episode']): e for e in episodes_in(tmp_path / '1')}
    disturbed = [number for number, e in episodes.items() if 'disturbances' in e.metadata]
    last = max(number for number in disturbed if episodes[number].is_complete)
    assert 'latency' in episodes[last].metadata['disturbances']
    assert check_episode(episodes[last].path).difference is None
    assert disturbed == list(range(min(disturbed), max(episodes) + 1))
    undisturbed = generated(tmp_path / 'batch', min(disturbed), 'FetchReach')
    cut = [number for number, episode in episodes.items() if not episode.is_complete]
    assert len(cut) > 1
    for number in episodes.keys() - {*cut, *disturbed}:
        for name in ('/applied_command', '/reward'):
            first, second = (e[number].topics[name].messages for e in (episodes, undisturbed))
            assert [m.data for m in first] == [m.data for m in second], number


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
