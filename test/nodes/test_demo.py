"""`fetch_hand_sim demo` with real nodes, until Ctrl-C."""

from __future__ import annotations

import signal
import sys
import tempfile
import time

import pytest

from fetch_hand_sim.commands import demo as command
from fetch_hand_sim.commands.node_processes import start_node, stop_node
from fetch_hand_sim.episode_log import read_summary
from msgs_spec.tasks import task_spec
from policy_node.training import generate_episodes
from support.graph import POLICY_NODE, SIM_NODE, client, finish, ros_args

DEMO = (sys.executable, '-m', 'fetch_hand_sim', 'demo', '--policy', 'resting')


@pytest.mark.parametrize(
    ('number', 'code'),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.release),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.release),
    ],
)
def test_the_demo_logs_episodes_and_stops_in_order(
    number, code, start_process, ros_environment, tmp_path
):
    # Which a parameter file would have as a number and a comment.
    directory = '20261125 #1'
    (tmp_path / 'mine.py').write_text('def make(task): return lambda observation: [0.0] * 4')
    options = ('--episodes', '100', f'--episode-dir=~/{directory}', '--policy=mine:make', '--trust')
    options += ('--seed', '4294967295')
    environment = ros_environment | {'HOME': str(tmp_path)}
    demo = start_process(*DEMO, *options, env=environment, cwd=tmp_path)
    header = 'episode seed steps return success file'
    assert demo.stdout.readline().split() == header.split()
    rows = [demo.stdout.readline().split()[:4] for _ in range(2)]
    # The first seed follows the last.
    assert rows == [['0', '4294967295', '50', '-50'], ['1', '0', '50', '-50']]
    demo.send_signal(number)
    output, errors = demo.communicate(timeout=30)
    assert (demo.returncode, errors) == (code, 'fetch_hand_sim demo: stopping\n')
    assert 'FetchReach: ' in output and 'episodes succeeded' in output
    paths = sorted((tmp_path / directory).iterdir())
    assert read_summary(paths[0]).is_complete
    # The robot had time to close what it was logging.
    assert not [path for path in paths if path.name.startswith('.')]


@pytest.mark.release
def test_the_demo_counts_no_episodes_of_others_in_its_directory(
    start_process, tmp_path, tmp_path_factory
):
    elsewhere = tmp_path_factory.mktemp('elsewhere')
    options = ['--policy', 'resting', '--task', 'FetchReach', '--episodes=1', '--first-seed=7']
    assert generate_episodes.main([*options, '--output', str(elsewhere)]) == 0
    (other,) = elsewhere.iterdir()
    demo = start_process(*DEMO, '--episodes', '1', '--episode-dir', tmp_path)
    assert demo.stdout.readline().startswith('episode')
    other.rename(tmp_path / other.name)
    code, output = finish(demo)
    assert code == 0 and 'FetchReach: 0 of 1 episodes succeeded' in output
    assert other.name not in output


@pytest.mark.parametrize(
    ('node', 'who'),
    [
        ([*SIM_NODE, *ros_args(task='HandReach')], 'a robot'),
        pytest.param(
            [*POLICY_NODE, '--ros-args', '-r', '__node:=actor'], 'actor', marks=pytest.mark.release
        ),
    ],
)
def test_the_demo_is_not_begun_beside_others(node, who, start_process, tmp_path):
    """Robots of one name take each other's commands, and the log would name the actor for it."""
    start_process(*node)
    with client(task_spec('FetchReach')) as connection:
        names = connection.node.get_node_names
        others = {'sim_node', 'actor'}
        connection.spin_until(lambda: others & set(names()), 'the other')
    code, output = finish(start_process(*DEMO, '--episodes', '1', cwd=tmp_path), timeout=60.0)
    assert code == 1
    assert output == (
        f'fetch_hand_sim demo: {who} is running in / and would interact with this demo: stop it, '
        'or set another ROS_DOMAIN_ID\n'
    )


def test_a_policy_that_cannot_be_loaded_is_wrong_usage_as_in_other_commands(
    start_process, tmp_path
):
    (tmp_path / 'mine.py').write_text('def make(task): return lambda observation: 1 / 0')
    demo = start_process(*DEMO, '--policy=mine:make', '--trust', '--episodes=1', cwd=tmp_path)
    code, output = finish(demo)
    assert code == 2 and 'policy_node: mine:make fails: ZeroDivisionError' in output


def test_a_policy_that_fails_during_an_episode_is_an_error_of_the_demo(start_process, tmp_path):
    (tmp_path / 'mine.py').write_text(
        'import itertools\n'
        'calls = itertools.count()\n'
        'def make(task): return lambda observation: [0.0 / (next(calls) < 30)] * 4'
    )
    demo = start_process(*DEMO, '--policy=mine:make', '--trust', '--episodes=2', cwd=tmp_path)
    code, output = finish(demo)
    assert code == 1 and '0 of 2 episodes succeeded' in output
    (error,) = [line for line in output.splitlines() if line.startswith('fetch_hand_sim demo: ')]
    assert 'policy_node: no command: ' in error and 'ZeroDivisionError' in error


@pytest.mark.parametrize(
    ('arguments', 'task'),
    [
        ([], 'FetchReach'),
        (['--policy', 'random'], 'FetchReach'),
        (['--policy', 'HandReach'], 'HandReach'),
        (['--policy', 'HandReach', '--task', 'FetchPush'], 'FetchPush'),
    ],
)
def test_the_task_follows_the_policy_unless_it_is_given(arguments, task):
    assert command._parse(arguments).task == task


def test_a_node_that_is_still_loaded_ends_quietly():
    with tempfile.TemporaryFile('w+') as log:
        process = start_node('sim_node', {'task': 'FetchReach'}, log)
        time.sleep(0.1)
        assert stop_node(process) == 0
        log.seek(0)
        # On a fast machine the policy is loaded by then, and the log has a line about it.
        assert [line for line in log if not line.startswith('[INFO]')] == []
