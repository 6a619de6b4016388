"""Lockstep on a real graph: equal bytes everywhere, stalls that say why, commanders that return."""

from __future__ import annotations

import signal
from pathlib import Path

from std_srvs.srv import Trigger

from fetch_hand_sim.episode_log import Episode, read_summary
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
    finish,
    ros_args,
)

REACH = task_spec('FetchReach')
SEED = 7


def logged_run(start: Start, directory: Path, **parameters: object) -> list[Episode]:
    """The episodes of one run of a robot."""
    settings = {'mode': 'lockstep', 'wait_for_commands': True, 'log_compiled_model': False}
    arguments = ros_args(seed=SEED, episode_dir=directory, **settings, **parameters)
    code, output = finish(start(*SIM_NODE, *arguments), timeout=60.0)
    assert code == 0, output
    return episodes_in(directory)


def generated(directory: Path, episodes: int, policy: str, *options: str) -> list[Episode]:
    """The same without ROS."""
    arguments = ['--task', 'FetchReach', '--policy', policy, '--num-envs=1', '--threads=1']
    numbers = [f'--episodes={episodes}', f'--first-seed={SEED}', f'--output={directory}']
    assert generate_episodes.main([*arguments, *numbers, *options]) == 0
    return episodes_in(directory)


def test_logs_are_equal_between_runs_and_without_ros(start_process: Start, tmp_path: Path) -> None:
    # One policy for all of them: what it did before must not matter.
    policy = start_process(*POLICY_NODE)
    runs = [logged_run(start_process, tmp_path / name, episodes=2) for name in ('1', '2')]
    runs.append(generated(tmp_path / 'batch', 2, 'FetchReach'))
    end(policy)
    for episodes in zip(*runs, strict=True):
        first, *others = episodes
        for episode in others:
            for part in ('topics', 'result', 'attachments'):
                assert getattr(episode, part) == getattr(first, part), part
            assert list(episode.metadata) == list(first.metadata)
            # A commit may come between the runs.
            same = first.metadata.keys() - {'started', 'source_revision'}
            assert all(episode.metadata[key] == first.metadata[key] for key in same)
    assert runs[0][0].topics['/joint_states'] != runs[0][1].topics['/joint_states']


def test_a_disturbed_episode_is_the_same_over_ros_in_the_batch_and_in_its_check(
    start_process: Start, tmp_path: Path
) -> None:
    policy = start_process(*POLICY_NODE, *ros_args(policy='robust'))
    logged = logged_run(start_process, tmp_path / '1', episodes=2, disturbances='hardware')
    end(policy)
    batch = generated(tmp_path / '2', 2, 'FetchReach_robust', '--disturbances=hardware')
    assert [each.topics for each in logged] == [each.topics for each in batch]
    topics = logged[0].topics
    assert [m.data for m in topics['/ground_truth/joint_states'].messages] != [
        m.data for m in topics['/joint_states'].messages
    ]
    for episode in logged:
        assert check_episode(episode.path).difference is None
        assert 'action_latency' in episode.metadata['variation']


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
        mode='lockstep', seed=SEED, episodes=60, wait_for_commands=True, episode_dir=tmp_path / '1'
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
    episodes = {int(e.metadata['episode']): e for e in episodes_in(tmp_path / '1')}
    undisturbed = generated(tmp_path / 'batch', max(episodes) + 1, 'FetchReach')
    cut = [number for number, episode in episodes.items() if not episode.is_complete]
    assert len(cut) > 1
    for number in episodes.keys() - cut:
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
