"""The single Gymnasium environments, as users of Gymnasium and Stable-Baselines3 meet them."""

from __future__ import annotations

import copy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import fetch_hand_sim
from fetch_hand_sim.gym_envs.env import FetchHandEnv
from fetch_hand_sim.gym_envs.registration import environment_id
from fetch_hand_sim.simulation import rendering
from fetch_hand_sim.simulation.opengl import prepare_opengl
from msgs_spec.tasks import TASKS
from support.tasks import each_task

# Positions are unbounded, and Gymnasium wonders about it.
pytestmark = pytest.mark.filterwarnings('ignore:.*Box observation space')


def make(task: str, **arguments) -> gymnasium.Env:
    return gymnasium.make(f'fetch_hand_sim:{environment_id(task)}', **arguments)


@each_task
def test_gymnasiums_checker_is_content(task):
    env = make(task)
    assert env.spec.id == f'fetch_hand_sim/{task}-v0'
    assert env.spec.max_episode_steps == TASKS[task].episode_ticks
    check_env(env.unwrapped, skip_render_check=True)


def test_goals_are_given_with_a_reset_or_written():
    env, other = make('FetchPush').unwrapped, make('FetchPush').unwrapped
    drawn, _ = other.reset(seed=4)
    first, _ = env.reset(seed=4, options={'goal': [1.3, 0.7, 0.5]})
    kept = env.goal
    assert first['desired_goal'].tolist() == [1.3, 0.7, 0.5]
    assert first['observation'].tobytes() == drawn['observation'].tobytes()
    assert env.step(np.zeros(4))[0]['desired_goal'].tolist() == [1.3, 0.7, 0.5]
    # The next episode draws what it would have drawn.
    second, _ = env.reset()
    assert np.array_equal(second['desired_goal'], other.reset()[0]['desired_goal'])
    env.goal = kept
    env.goal[:] = 1.0
    assert env.step(np.zeros(4))[0]['desired_goal'].tolist() == [1.0] * 3
    # References to goals keep their values.
    assert kept.tolist() == [1.3, 0.7, 0.5]
    # Quaternions are normalised and moved to the hemisphere of the object's.
    goal = [1.0, 0.9, 0.2, -2.0, 0.0, 0.0, 0.0]
    observation, _ = make('HandManipulateBlockRotateXYZ').reset(seed=0, options={'goal': goal})
    quaternion = observation['desired_goal'][3:]
    assert np.abs(quaternion).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert quaternion @ observation['achieved_goal'][3:] >= 0.0


def test_a_goal_of_reset_replaces_that_of_an_overridden_sample_goal():
    env = make('FetchReach').unwrapped
    env._sample_goal = lambda: np.array([1.3, 0.7, 0.6])
    given = np.array([1.2, 0.7, 0.6])
    assert np.array_equal(env.reset(seed=0, options={'goal': given})[0]['desired_goal'], given)
    assert env.reset()[0]['desired_goal'].tolist() == [1.3, 0.7, 0.6]


def test_a_diverged_episode_is_truncated_and_the_next_has_a_goal_of_its_own():
    plain, env = make('FetchPush').unwrapped, make('FetchPush').unwrapped
    env._sample_goal = lambda: np.array([1.3, 0.7, 0.6])
    env.compute_truncated = lambda achieved_goal, desired_goal, info: False
    for each in (plain, env):
        each.reset(seed=0)
        each.goal = np.zeros(3)
        each.simulation.task.batch.bind('qvel')[0, 0] = np.nan
        observation, _, terminated, truncated, info = each.step(np.full(4, np.inf))
        assert (terminated, truncated, info['diverged']) == (False, True, True)
        assert each.observation_space.contains(observation)
    assert observation['desired_goal'].tolist() == [1.3, 0.7, 0.6]


def test_arguments_reach_the_simulation():
    env = make('HandReach', reward_type='dense', success_rule='paper', control_hz=50)
    metric = env.unwrapped.simulation.metric
    assert (metric.reward_type, metric.success_rule) == ('dense', 'paper')
    assert env.unwrapped.simulation.tick_duration == pytest.approx(0.02)
    assert repr(env.metadata['render_fps']) == '50'
    assert make('HandReach', control_hz=12.5).metadata['render_fps'] == 12.5
    assert gymnasium.spec(environment_id('HandReach')).kwargs == {'task': 'HandReach'}


@pytest.mark.parametrize('make_one', [gymnasium.make, gymnasium.make_vec])
def test_an_id_makes_its_own_task_only(make_one):
    name = environment_id('FetchReach')
    with pytest.raises(ValueError, match='FetchReach-v0 is FetchReach, not FetchPush'):
        make_one(name, task='FetchPush')
    assert make_one(make_one(name, task='FetchReach').spec).spec.id == name


def test_looking_at_the_data_starts_no_episode():
    env = make('FetchPush').unwrapped
    assert env.data.time > 0.0
    env.data.qpos[:] += 0.01
    for each in (env, copy.deepcopy(env)):
        with pytest.raises(gymnasium.error.ResetNeeded, match='call reset before step'):
            each.step(np.zeros(4))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r'an action of FetchPush has shape \(4,\), not \(3,\)'):
        env.step(np.zeros(3))
    env.step(np.zeros(4))


def test_importing_the_package_registers_without_mujoco():
    code = (
        'import sys, gymnasium, fetch_hand_sim\n'
        'assert not {"mujoco", "torch", "rclpy"} & set(sys.modules)\n'
        'print(*(i for i in gymnasium.registry if i.startswith("fetch_hand_sim/")))'
    )
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert result.stdout.split() == [environment_id(task) for task in TASKS], result.stderr


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'render_mode': 'ansi'}, "render_mode 'ansi'; allowed: human, rgb_array, depth_"),
        ({'height': 0}, r'height 0; allowed: whole numbers 1 \.\.\. 4096'),
        ({'default_camera_config': {'distance': 'a'}}, r"distance 'a'; allowed: as \d"),
        ({'default_camera_config': {'lookat': [np.nan] * 3}}, 'lookat .*nan.*: finite'),
        ({'default_camera_config': {'type': 3}}, r"type '3'; allowed: 0 \(free\), 1 \(trac"),
        (
            {'default_camera_config': {'type': 2, 'fixedcamid': 99}},
            r"fixedcamid '99'; allowed: 0 \.\.\. \d",
        ),
        (
            {'default_camera_config': {'type': 1, 'trackbodyid': 9999}},
            r"trackbodyid '9999'; allowed: 0 \.",
        ),
        ({'distance_threshold': 'a'}, r"distance_threshold 'a'; allowed: 0 ... 1e\+06"),
        ({'control_hz': '25'}, "control_hz '25' given"),
        (
            {'rewardtype': 'dense'},
            "no argument 'rewardtype'; allowed: task, .*, timing; did you mean 'reward_type'",
        ),
        ({'default_camera_config': 5}, "default_camera_config: '5' given; allowed: a mapping"),
        ({'disturbances': 'x' * 1000}, 'is neither a file nor a preset'),
        ({'default_camera_config': {'zoom': 2}}, "has no 'zoom'; allowed: azimuth,"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        FetchHandEnv('FetchReach', **arguments)


def test_a_single_environment_rejects_a_number_of_environments():
    with pytest.raises(TypeError, match=r'num_envs is for fetch_hand_sim\.make_vec'):
        fetch_hand_sim.make('FetchReach', num_envs=4)


@pytest.fixture
def draw(monkeypatch):
    """Makes a started environment with small pictures, where EGL works."""
    monkeypatch.setenv('MUJOCO_GL', 'egl')
    try:
        prepare_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))

    def draw(task='FetchReach', make=make, **arguments):
        small = {'render_mode': 'rgb_array', 'width': 96, 'height': 64}
        env = make(task, **small | arguments)
        env.reset(seed=0)
        return env

    return draw


def test_pictures_have_the_mode_and_the_size_that_were_asked_for(draw):
    env = draw(render_mode='rgb_array_list')
    env.step(env.action_space.sample())
    pictures = np.array(env.render())
    assert (pictures.shape, pictures.dtype) == ((2, 64, 96, 3), np.uint8)
    assert pictures.std() > 10.0
    env = draw('FetchPush', render_mode='depth_array', default_camera_config={'distance': 1.0})
    depth = env.render()
    assert (depth.shape, depth.dtype) == ((64, 96), np.float32)
    assert 0.3 < depth.min() < 1.0
    env = draw(distance_threshold=0.04).unwrapped
    before = env.render()
    env.distance_threshold = 0.01
    assert (before != env.render()).any()
    env.distance_threshold = 0.04
    assert (before == env.render()).all()


def test_any_thread_draws_with_egl(draw):
    """A thread that draws and ends leaves an environment that others draw and close."""
    env = draw()
    with ThreadPoolExecutor(1) as first:
        before = first.submit(env.render).result()
    assert (env.render() == before).all()
    with ThreadPoolExecutor(1) as another:
        assert (another.submit(env.render).result() == before).all()
        another.submit(env.close).result()
    assert (env.render() == before).all()


def test_pictures_of_gymnasiums_own_environments_stay_as_they_are(draw):
    """Gymnasium takes its own context once and expects it to stay."""
    ours, theirs = draw(), draw('Hopper-v5', gymnasium.make)
    before = theirs.render(), ours.render()
    after = theirs.render(), ours.render()
    for one, other in zip(before, after, strict=True):
        assert one.any() and (one == other).all()
    ours.close()
    assert (theirs.render() == before[0]).all()
    theirs.close()


def test_an_error_names_the_thread_that_holds_the_context(draw, monkeypatch):
    monkeypatch.setattr(rendering, 'context_of_its_own', nullcontext)
    env = draw()
    before = env.render()
    with ThreadPoolExecutor(1) as another:
        for call in (env.render, env.close):
            with pytest.raises(RuntimeError, match='OpenGL works in one thread only'):
                another.submit(call).result()
    assert (env.render() == before).all()
    env.close()


RENDER = """
import os
{start}
import fetch_hand_sim
env = fetch_hand_sim.make('fetch_hand_sim/FetchReach-v0', render_mode='rgb_array')
env.reset(seed=0)
print(os.environ.get('MUJOCO_GL'))
for _ in range(2):
    try:
        print(env.render().std() > 10.0)
    except RuntimeError as error:
        print(error)
"""


def rendered(start: str = '') -> list[str]:
    """Return the lines that a process prints which runs `start` and renders twice."""
    code = RENDER.format(start=start)
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


@pytest.mark.parametrize('name', ['nonsense', 'osmesa'])
def test_without_the_chosen_opengl_only_pictures_fail(name, monkeypatch):
    """`import mujoco` raises RuntimeError for one, AttributeError if the other is missing."""
    monkeypatch.setenv('MUJOCO_GL', name)
    chosen, *lines = rendered()
    assert chosen == name and lines[0] == lines[1]
    if name == 'nonsense':
        assert 'MUJOCO_GL=nonsense; allowed: egl' in lines[0]
    elif lines[0] != 'True':
        assert lines[0].startswith('rendering needs OpenGL: apt install')


@pytest.mark.release
def test_opengl_is_chosen_after_the_import_and_a_dead_display_is_ignored(monkeypatch):
    for name in ('MUJOCO_GL', 'DISPLAY', 'WAYLAND_DISPLAY'):
        monkeypatch.delenv(name, raising=False)
    choice = 'os.environ["MUJOCO_GL"] = "egl"'
    assert rendered(f'{choice}; import mujoco') == rendered(f'import mujoco; {choice}')
    _, *without = rendered()
    monkeypatch.setenv('DISPLAY', ':4711')
    assert rendered()[1:] == without
    monkeypatch.setenv('MUJOCO_GL', 'glfw')
    assert all(line.startswith('rendering needs OpenGL') for line in rendered()[1:])


FORKED = """
import os, signal, gymnasium, fetch_hand_sim

def draw(env):
    env.reset(seed=0)
    try:
        env.render()
    except RuntimeError as error:
        print(str(error)[:23], flush=True)

arguments = {'render_mode': 'rgb_array', 'width': 32, 'height': 32}
env = gymnasium.make('fetch_hand_sim/FetchReach-v0', **arguments)
draw(env)
if os.fork() == 0:
    signal.alarm(60)
    draw(env)
    draw(gymnasium.make('fetch_hand_sim/FetchReach-v0', **arguments))
    os._exit(0)
os.wait()
"""


def test_a_forked_process_does_not_wait_for_the_opengl_of_its_parent(draw):
    result = subprocess.run([sys.executable, '-c', FORKED], capture_output=True, text=True)
    assert result.stdout.splitlines() == ['this process was forked'] * 2, result.stderr


def test_without_a_display_the_remedy_is_printed(monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    with pytest.raises(RuntimeError, match="render_mode 'human' needs a display"):
        make('FetchReach', render_mode='human').reset(seed=0)


def test_a_task_is_made_by_its_name_alone(monkeypatch):
    # The package of a task may import this one before its specification is read.
    monkeypatch.delitem(gymnasium.registry, environment_id('FetchReach'))
    env = fetch_hand_sim.make('FetchReach', reward_type='dense', control_hz=50)
    assert env.spec.id == 'fetch_hand_sim/FetchReach-v0' and env.spec.max_episode_steps == 100
    assert env.unwrapped.reward_type == 'dense'
    batch = fetch_hand_sim.make_vec('FetchReach', num_envs=2)
    assert batch.num_envs == 2 and batch.spec.id == env.spec.id
    with pytest.raises(gymnasium.error.NameNotFound, match='Did you mean: `FetchReach'):
        fetch_hand_sim.make('fetch_hand_sim/FetchReech-v0')


def test_an_unknown_name_is_answered_with_the_known_ones(monkeypatch):
    for each in [each for each in gymnasium.registry if 'FetchPush' in each or 'HandRea' in each]:
        monkeypatch.delitem(gymnasium.registry, each)
    for name, line in (
        ('FetchPsh', r"unknown task 'FetchPsh'; allowed: FetchReach, .*; did you mean 'FetchPush'"),
        ('FetchPush-v0', r"unknown task 'FetchPush-v0'; .*; did you mean 'FetchPush'\?$"),
        (
            'HandReach-v3',
            r"unknown task 'HandReach-v3'; .*; register_gymnasium_robotics\(\) br",
        ),
    ):
        for made in (fetch_hand_sim.make, fetch_hand_sim.make_vec):
            with pytest.raises(gymnasium.error.NameNotFound, match=line):
                made(name)
    assert fetch_hand_sim.make('CartPole').spec.id == 'CartPole-v1'
    with pytest.raises(gymnasium.error.VersionNotFound, match='v1'):
        fetch_hand_sim.make('CartPole-v7')
    with pytest.raises(ValueError, match=r'wrappers .*Flatten.*; allowed: a list'):
        fetch_hand_sim.make_vec('FetchPush', wrappers=gymnasium.wrappers.FlattenObservation)
