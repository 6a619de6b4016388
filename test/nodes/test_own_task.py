"""A fourteenth task from another package, from its entry points to a trained actor on the graph."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from support import ROOT
from support.graph import POLICY_NODE, Start, end, finish, logged_run, ros_args
from support.shell_lines import commands, python_blocks, shell_lines

EXAMPLE = ROOT / 'examples' / 'fetch_reach_oriented'
TASK = 'FetchReachOriented'


@pytest.fixture(scope='module')
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pip installed the example."""
    directory = tmp_path_factory.mktemp('site')
    source = tmp_path_factory.mktemp('source') / EXAMPLE.name
    # A copy: building writes beside the source.
    subprocess.run(['cp', '-r', EXAMPLE, source], check=True)
    options = ['--quiet', '--no-deps', '--no-build-isolation', '--no-index', '--target', directory]
    subprocess.run([sys.executable, '-m', 'pip', 'install', *options, source], check=True)
    return directory


def environment(site: Path) -> dict[str, str]:
    return os.environ | {'PYTHONPATH': os.pathsep.join([str(ROOT), str(site)])}


def run(site: Path, *command: object, **options: object) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, *(str(word) for word in command)]
    return subprocess.run(words, env=environment(site), capture_output=True, text=True, **options)


def test_the_policys_side_reads_it_without_mujoco(site: Path) -> None:
    code = (
        'import sys, policy_node.node\n'
        'from msgs_spec.tasks import TASKS, task_spec\n'
        'from msgs_spec.topics import topics\n'
        'print(list(TASKS)[-1], task_spec("FetchReachOriented").robot.action_size)\n'
        'print(*(t.name for t in topics(TASKS["FetchReachOriented"]) if t.name.endswith("goal")))\n'
        'assert "mujoco" not in sys.modules and "fetch_hand_sim" not in sys.modules\n'
    )
    result = run(site, '-c', code)
    assert result.stdout.split('\n')[:2] == [
        f'{TASK} 6',
        'desired_goal achieved_goal set_goal',
    ], result.stderr


def test_the_pages_command_lines_are_understood(site: Path) -> None:
    page = (ROOT / 'docs' / 'own_task.md').read_text()
    lines = [words for line in shell_lines(page) for words in commands(line)]
    (training,) = [words for words in lines if words[:2] == ['fetch_hand_sim', 'train']]
    for command in (training, ['fetch_hand_sim', 'benchmark', '--tasks', TASK]):
        # Arguments before `--help` are checked before the help is printed.
        result = run(site, '-m', *command, '--help')
        assert result.returncode == 0, result.stderr
    (node,) = [words for words in lines if words[0] == 'sim_node']
    assert node[1:] == ros_args(task=TASK)


ANOTHER_REWARD = """
import gymnasium, numpy as np
from fetch_hand_sim.__main__ import main
from fetch_hand_sim.view.page.robot_panel import introduction
from msgs_spec.tasks import task_spec

env = gymnasium.make('fetch_hand_sim:fetch_hand_sim/FetchPushNear-v0')
env.reset(seed=1)
observation, reward, *_ = env.step(np.zeros(4, np.float32))
far = np.linalg.norm(observation['achieved_goal'] - observation['desired_goal'])
print(abs(reward + far / 0.3) < 1e-12, introduction(task_spec('FetchPushNear'))[:13])
policy = ['--policy', 'random', '--task', 'FetchPushNear', '--episodes', '2']
assert main(['episodes', 'generate', *policy, '--output', 'episodes']) == 0
assert main(['episodes', 'check', 'episodes']) == 0
training = ['--task', 'FetchPushNear', '--steps', '50', '--num-envs', '1']
fast = ['--batch-size', '8', '--updates-per-cycle', '1', '--evaluation-episodes', '1']
assert main(['train', *training, *fast, '--output', 'run']) == 0
"""


@pytest.mark.release
def test_the_pages_other_reward_trains_and_is_checked(tmp_path: Path) -> None:
    blocks = python_blocks((ROOT / 'docs' / 'own_reward.md').read_text())
    specification, simulation = (block for block in blocks if 'FetchPushNear' in block)
    package = tmp_path / 'near'
    package.mkdir()
    (package / '__init__.py').touch()
    (package / 'specification.py').write_text(specification)
    (package / 'simulation.py').write_text(simulation)
    # As pip writes it.
    metadata = tmp_path / 'near-1.dist-info'
    metadata.mkdir()
    (metadata / 'METADATA').write_text('Metadata-Version: 2.1\nName: near\nVersion: 1\n')
    (metadata / 'entry_points.txt').write_text(
        '[fetch_hand_sim_tasks.specification]\nFetchPushNear = near.specification:SPECIFICATION\n'
        '[fetch_hand_sim_tasks.simulation]\nFetchPushNear = near.simulation:FetchPushNear\n'
    )
    result = run(tmp_path, '-c', ANOTHER_REWARD, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith('True FetchPushNear')


GYMNASIUM = """
import os, warnings
os.environ['MUJOCO_GL'] = 'egl'
warnings.simplefilter('ignore')
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env
from msgs_spec.rotations import quaternion_multiply

name = 'fetch_hand_sim:fetch_hand_sim/FetchReachOriented-v0'
env = gymnasium.make(name)
check_env(env.unwrapped, skip_render_check=True)
batch = gymnasium.make_vec(name, num_envs=4)
rows, _ = batch.reset(seed=3)
reached = 0.0
for tick in range(50):
    achieved, desired = rows['achieved_goal'], rows['desired_goal']
    inverse = achieved[:, 3:] * [1, -1, -1, -1]
    turn = 2.0 * quaternion_multiply(desired[:, 3:], inverse)[:, 1:]
    action = np.concatenate([10 * (desired - achieved)[:, :3], 2.5 * turn], axis=1)
    rows, reward, _, _, info = batch.step(action.astype(np.float32))
print(info['is_success'].sum(), reward.tolist())
single, _ = env.reset(seed=3)
first, _ = batch.reset(seed=3)
print(all((single[key] == first[key][0]).all() for key in single))
env = gymnasium.make(name, render_mode='rgb_array')
env.reset(seed=0)
try:
    print(env.render().std() > 10.0)
except RuntimeError as error:
    print(str(error).startswith('rendering needs OpenGL'))
from fetch_hand_sim.view.page.robot_panel import introduction
from msgs_spec.tasks import task_spec
print(introduction(task_spec('FetchReachOriented')))
"""


def test_gymnasium_the_batch_a_controller_of_three_lines_and_pictures(site: Path) -> None:
    result = run(site, '-c', GYMNASIUM)
    assert result.stdout.splitlines()[:3] == ['4.0 [0.0, 0.0, 0.0, 0.0]', 'True', 'True'], (
        result.stderr
    )
    pytest.importorskip('mujoco.studio')
    assert result.stdout.splitlines()[3] == (
        f'{TASK} is a third-party task. The goal turns green when it is reached.'
    ), result.stderr


@pytest.mark.release
def test_it_is_trained_run_by_the_nodes_logged_checked_and_replayed(
    site: Path, start_process: Start, tmp_path: Path, ros_environment: dict[str, str]
) -> None:
    node_environment = ros_environment | {'PYTHONPATH': environment(site)['PYTHONPATH']}
    start = partial(start_process, env=node_environment)
    few = ['--steps', '800', '--num-envs', '4', '--torch-threads', '1', '--threads', '1']
    brief = ['updates_per_cycle=2', 'evaluation_episodes=4', 'moved_share=0', 'batch_size=32']
    settings = [word for each in brief for word in ('--set', each)]
    trained = run(
        site,
        *('-m', 'policy_node.training.train_her', '--task', TASK, '--output', tmp_path / 'run'),
        *few,
        *settings,
        *('--set', 'goal_features=relative'),
    )
    assert trained.returncode == 0, trained.stderr
    actor = tmp_path / 'run' / 'latest.safetensors'

    policy = start(*POLICY_NODE, *ros_args(checkpoint=actor))
    (episode,) = logged_run(start, tmp_path / 'episodes', task=TASK, episodes=1)
    checked = run(site, '-m', 'fetch_hand_sim', 'episodes', 'check', tmp_path / 'episodes')
    assert checked.returncode == 0, checked.stdout + checked.stderr

    replay = (sys.executable, '-m', 'fetch_hand_sim.replay_node')
    arguments = ros_args(path=episode.path, rate=10.0, wait_for_commands=True)
    code, output = finish(start(*replay, *arguments), timeout=60.0)
    assert code == 0, output
    end(policy)
