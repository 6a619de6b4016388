"""The ids of Gymnasium-Robotics on this package, beside the reference itself."""

from __future__ import annotations

import copy
import itertools
import json
import pickle
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest

import fetch_hand_sim
from fetch_hand_sim.gym_envs.gymnasium_robotics_env import FetchEnv, ManipulateEnv
from fetch_hand_sim.gym_envs.registration import reference_ids
from msgs_spec.tasks import TASKS
from support import SUPPORT
from support.same_bits import assert_same

SIDE_BY_SIDE = SUPPORT / 'gymnasium_robotics_side_by_side.py'
COMPARED = (
    'FetchReach-v4',
    'FetchSlideDense-v4',
    'FetchPickAndPlace-v4',
    'HandReach-v3',
    'HandManipulateBlockRotateParallel-v1',
    'HandManipulatePenDense-v1',
)
# Hooks for subclasses of the reference, and its helpers.
LEFT_OUT = {
    '__setstate__',
    '_env_setup',
    '_ezpickle_args',
    '_ezpickle_kwargs',
    '_initialize_simulation',
    '_mujoco_step',
    '_reset_sim',
    '_set_action',
    '_step_callback',
    'generate_mujoco_observations',
}


@pytest.fixture(scope='module')
def report() -> dict:
    """The differences between the reference and this package."""
    result = subprocess.run(
        [sys.executable, '-O', SIDE_BY_SIDE, *COMPARED], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture(autouse=True)
def registry():
    """Gives back the ids as they were."""
    before = dict(gymnasium.registry)
    yield gymnasium.registry
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


@pytest.fixture
def make(registry):
    """Makes an environment by the reference's id."""
    for name in [name for name in registry if name.startswith(('Fetch', 'Hand'))]:
        del registry[name]
    fetch_hand_sim.register_gymnasium_robotics()
    return lambda name, **arguments: gymnasium.make(name, **arguments).unwrapped


@pytest.mark.parametrize('name', COMPARED)
def test_the_reference_and_ours_are_equal_side_by_side(name, report):
    assert report[name]['apart']['observation'] < 1e-15
    assert max(report[name]['apart'].values()) < 1e-15
    assert report[name]['facts'] == []
    assert report[name]['types'] == []
    assert report[name]['is_goal_env']
    assert set(report[name]['missing']) <= LEFT_OUT


@pytest.mark.parametrize('name', COMPARED)
def test_methods_that_are_overridden_count_as_in_the_reference(name, report):
    overridden = report[name]['overridden']
    assert overridden['differ'] == []
    assert overridden['apart'] < 1e-14
    assert overridden['ended'] == [True, True]


def test_all_ids_of_the_same_physics_are_there(report):
    # Other versions need mujoco-py; touch sensors are not simulated.
    versions = {'Fetch': 'v4', 'HandR': 'v3', 'HandM': 'v1'}
    same_physics = {
        name
        for name in report['known']
        if name.endswith(versions[name[:5]]) and 'TouchSensors' not in name
    }
    assert same_physics == set(reference_ids())
    assert len(same_physics) == 32
    assert {task for task, _ in reference_ids().values()} == set(TASKS)


def test_ids_of_another_package_are_replaced_only_on_request(registry):
    registry.pop('FetchPush-v4', None)
    gymnasium.register('FetchPush-v4', entry_point='somebody:Else')
    before = dict(registry)
    with pytest.raises(gymnasium.error.Error, match=r'_robotics\(override=True\)'):
        fetch_hand_sim.register_gymnasium_robotics()
    assert registry == before
    fetch_hand_sim.register_gymnasium_robotics(override=True)
    fetch_hand_sim.register_gymnasium_robotics()
    assert gymnasium.spec('FetchPush-v4').entry_point.startswith('fetch_hand_sim.')


def test_importing_gymnasium_robotics_later_takes_nothing_back():
    code = (
        'import gymnasium, fetch_hand_sim\n'
        'fetch_hand_sim.register_gymnasium_robotics(override=True)\n'
        'import gymnasium_robotics\n'
        'gymnasium.register_envs(gymnasium_robotics)\n'
        'env = gymnasium.make("FetchPush-v4")\n'
        'env.reset(seed=0)\n'
        'print(type(env.unwrapped).__module__)\n'
        'print(isinstance(env.unwrapped, gymnasium_robotics.core.GoalEnv))\n'
    )
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert result.stdout.split() == ['fetch_hand_sim.gym_envs.gymnasium_robotics_env', 'True']
    # Not even its remark about other environments.
    assert result.stderr == ''


def test_a_worker_process_finds_the_ids_by_their_module(registry, monkeypatch):
    registry.pop('FetchReach-v4', None)
    module = 'fetch_hand_sim.gymnasium_robotics_ids'
    # Only the import of the module registers the id.
    monkeypatch.delitem(sys.modules, module, raising=False)
    name = f'{module}:FetchReach-v4'
    assert fetch_hand_sim.make(name, control_hz=50).spec.max_episode_steps == 100
    workers = gymnasium.vector.AsyncVectorEnv([lambda: gymnasium.make(name)], context='spawn')
    (spec,) = workers.get_attr('spec')
    assert workers.reset(seed=0)[0]['observation'].shape == (1, 10)
    workers.close()
    assert (spec.id, spec.kwargs['task']) == ('FetchReach-v4', 'FetchReach')
    assert spec.entry_point.startswith('fetch_hand_sim.')


def test_settings_can_be_set_and_facts_cannot(make):
    env = make('HandReach-v3', distance_threshold=1e-6)
    env.reset(seed=0)
    env.goal = env._get_obs()['achieved_goal']
    assert env.step(np.zeros(20))[1] == -1.0
    env.distance_threshold = 10.0
    env.goal[:] += 1.0
    observation, reward, _, _, info = env.step(np.zeros(20))
    assert (reward, info['is_success']) == (0.0, 1.0)
    env.reward_type = 'dense'
    goals = observation['achieved_goal'], observation['desired_goal']
    expected = -np.linalg.norm(goals[0] - goals[1])
    assert env.compute_reward(goals[0], goal=goals[1]) == pytest.approx(expected, rel=1e-12)
    for name, value, error, line in (
        ('distance_threshold', -1.0, ValueError, r'distance_threshold -1.0; allowed: 0 '),
        ('rotation_threshold', 0.2, ValueError, 'HandReach has no rotation_threshold'),
        ('palm_xpos', 0.3, AttributeError, 'palm_xpos of HandReach is fixed'),
        ('_set_action', None, TypeError, '_set_action would have no effect here; what may be'),
    ):
        with pytest.raises(error, match=line):
            setattr(env, name, value)
    with pytest.raises(TypeError, match='_step_callback would have no effect here'):
        type('Mine', (FetchEnv,), {'_step_callback': lambda self: None})('FetchReach')
    fetch, block = make('FetchPush-v4'), make('HandManipulateBlock-v1')
    for env in (fetch, block, copy.deepcopy(fetch), pickle.loads(pickle.dumps(block))):
        arrays = [getattr(env, name) for name in sorted(env.stated)]
        arrays = [array for array in arrays if isinstance(array, np.ndarray)]
        assert len(arrays) == 3
        assert not any(a.flags.writeable for a in (*arrays, *getattr(env, 'parallel_quats', ())))


def test_a_batch_takes_and_gives_what_single_environments_do(make):
    make('FetchReach-v4')
    modes = ('sync', 'vector_entry_point')
    asked = {'target_position': 'ignore', 'target_rotation': 'z'}
    for mode in modes:
        name = 'HandManipulateBlock-v1'
        hand = gymnasium.make_vec(name, num_envs=1, vectorization_mode=mode, **asked)
        assert hand.get_attr('target_rotation') == ('z',)
    env = make('HandManipulateBlock-v1', **asked)
    assert env.spec_of_task.name == 'HandManipulateBlockRotateZ'
    with pytest.raises(ValueError, match='allowed: ignore and xyz, random and xyz'):
        make('HandManipulateEgg-v1', target_rotation='parallel')
    with pytest.raises(ValueError, match="task 'FetchReach'; allowed: Hand"):
        ManipulateEnv('FetchReach')
    with pytest.raises(TypeError, match='FetchReach takes neither'):
        gymnasium.make_vec('FetchReach-v4', target_rotation='z')
    pair = [gymnasium.make_vec('FetchReach-v4', num_envs=2, vectorization_mode=m) for m in modes]
    for env in pair:
        env.reset(seed=3, options={'of nobody': 1})
    for _ in range(51):
        first, second = (env.step(np.ones((2, 4), np.float32)) for env in pair)
        assert_same(first[0], second[0])
        assert [each.dtype for each in first[1:4]] == [each.dtype for each in second[1:4]]
        for key in first[4].keys() & {'is_success', '_is_success'}:
            assert first[4][key].dtype == second[4][key].dtype
    for name in ('initial_gripper_xpos', 'n_substeps', 'has_object', 'initial_qpos', 'width'):
        for one, other in zip(*(env.get_attr(name) for env in pair), strict=True):
            assert type(one) is type(other) and np.array_equal(one, other), name
    with pytest.raises(AttributeError):
        pair[1].get_attr('nothing')


def test_what_is_written_into_data_and_model_is_the_simulation(make):
    env, other = make('FetchPush-v4'), make('FetchPush-v4')
    env.reset(seed=0)
    other.reset(seed=1)
    other.data.qpos[:], other.data.qvel[:] = env.data.qpos, env.data.qvel
    other.data.time = env.data.time
    mujoco.mj_forward(other.model, other.data)
    other.goal = env.goal
    for key, values in env._get_obs().items():
        assert np.abs(values - other._get_obs()[key]).max() < 1e-12, key
    held, before = other.data, other.data.time
    other.model.opt.timestep = 0.001
    other.model.body('object0').mass *= 50.0
    other.distance_threshold = 0.5
    copied = copy.deepcopy(other)
    twin = pickle.loads(pickle.dumps(other))
    assert twin.model.body('object0').mass == other.model.body('object0').mass
    moved, observations = [], []
    for each in (env, other, copied, twin):
        each.data.joint('object0:joint').qvel[0] = 1.0
        each.data.qfrc_applied[-6] = 5.0
        observation = each.step(np.ones(4, np.float32))[0]['observation']
        moved.append(each.data.joint('object0:joint').qvel[0])
        velocity = each.simulation.readings()['end_effector_twist'][0, :3]
        assert np.array_equal(observation[20:23], velocity * each.dt)
        observations.append(observation)
    assert held is other.data
    assert held.time == pytest.approx(before + 0.02)
    assert [each.dt for each in (env, other, copied, twin)] == [0.04, 0.02, 0.02, 0.02]
    assert twin.distance_threshold == 0.5
    observations += [each.reset()[0] for each in (env, other, copied, twin)]
    assert_same(observations[1::4] * 2, observations[2::4] + observations[3::4])
    assert abs(moved[0] - moved[1]) > 0.1
    # Goals are drawn around the place of the object.
    hand = make('HandManipulateBlock-v1')
    hand.reset(seed=0)
    hand.data.joint('object:joint').qpos[:3] = 2.0
    assert np.abs(hand._sample_goal()[:3] - 2.0).max() < 0.5


def test_the_helpers_of_the_reference_work_on_model_and_data(make):
    env = make('FetchPush-v4')
    observation, _ = env.reset(seed=0)
    joint = 'robot0:shoulder_pan_joint'
    env._utils.set_joint_qvel(env.model, env.data, joint, 0.5)
    assert env._utils.get_joint_qvel(env.model, env.data, joint).tolist() == [0.5]
    assert env._utils.get_joint_qpos(env.model, env.data, joint).shape == (1,)
    names = [env.model.joint(i).name for i in range(env.model.njnt)]
    qpos, qvel = env._utils.robot_get_obs(env.model, env.data, names)
    assert qpos.shape == qvel.shape == (sum(name.startswith('robot') for name in names),)
    env._utils.set_joint_qvel(env.model, env.data, joint, 0.0)
    grip = env._utils.get_site_xpos(env.model, env.data, 'robot0:grip')
    assert np.array_equal(grip, observation['observation'][:3])
    assert 'robot0:grip' in env._model_names.site_names
    place = np.array([1.3, 0.7, 0.5, 1.0, 0.0, 0.0, 0.0])
    env._utils.set_joint_qpos(env.model, env.data, 'object0:joint', place)
    env._mujoco.mj_forward(env.model, env.data)
    assert env._get_obs()['achieved_goal'] == pytest.approx(place[:3])


def test_commands_follow_the_ranges_written_into_the_model(make):
    env = make('HandReach-v3')
    env.reset(seed=0)
    env.model.actuator_ctrlrange[:] *= 0.5
    halved = env.model.actuator_ctrlrange.copy()
    env.step(np.ones(20, np.float32))
    assert env.data.ctrl == pytest.approx(halved[:, 1], abs=1e-12)
    assert env.data.ctrl[3] == pytest.approx(0.7855)
    twin = pickle.loads(pickle.dumps(env))
    for each in (env, twin):
        each.step(-np.ones(20, np.float32))
        assert each.data.ctrl == pytest.approx(halved[:, 0], abs=1e-12)


def shown_goal(env) -> np.ndarray:
    """Where a user's own renderer of model and data draws the goal."""
    if env.spec_of_task.name.startswith('HandManipulate'):
        return env.data.geom('target').xpos
    names = [f'target{i}' for i in range(env.goal.size // 3)]
    return np.concatenate([env.data.site(name).xpos for name in names])


@pytest.mark.parametrize('name', ['FetchPush-v4', 'HandReach-v3', 'HandManipulateEggRotate-v1'])
def test_model_and_data_show_the_goal_without_a_change_of_trajectories(name, make):
    env, plain = make(name, render_mode='rgb_array'), make(name)
    env.reset(seed=0)
    plain.reset(seed=0)
    beside = np.zeros(env.goal.size)
    if name.startswith('HandManipulate'):
        # As in the reference, where the position of the goal does not count.
        beside = np.array([0.15, 0.0, 0.0])
    for _ in range(3):
        assert shown_goal(env) == pytest.approx(env.goal[: beside.size] + beside, abs=1e-12)
        action = env.action_space.sample()
        assert_same(env.step(action)[0], plain.step(action)[0])
        env._render_callback()
    # The goal stays at its place in a forward pass, too.
    shown = shown_goal(env).copy()
    mujoco.mj_forward(env.model, env.data)
    assert shown_goal(env) == pytest.approx(shown, abs=1e-12)


def test_render_uses_the_settings_of_mujoco_renderer_and_calls_the_callback(make):
    class Marked(FetchEnv):
        def _render_callback(self) -> None:
            super()._render_callback()
            viewer = self.mujoco_renderer._get_viewer(self.render_mode)
            viewer.add_marker(pos=self.goal, size=np.full(3, 0.5), rgba=np.array([1, 0, 0, 1]))

    env, marked = make('FetchReach-v4', render_mode='rgb_array'), Marked('FetchReach')
    marked.render_mode = 'rgb_array'
    for each in (env, marked):
        each.reset(seed=0)
    free = env.render()
    env.mujoco_renderer.default_cam_config = {'distance': 1.0}
    near = env.render()
    env.mujoco_renderer._get_viewer('rgb_array').cam.distance = 5.0
    far = env.render()
    env.mujoco_renderer.camera_id = 0
    pictures = [free, near, far, env.render(), marked.render()]
    env.close()
    assert [picture.shape for picture in pictures] == [(480, 480, 3)] * 5
    for first, second in itertools.combinations(pictures, 2):
        assert np.abs(first.astype(float) - second).mean() > 5.0
    red = (pictures[4][..., 0] > 100) & (pictures[4][..., 1:] < 50).all(axis=-1)
    assert red.mean() > 0.05


def test_pictures_are_made_lists_of_and_depth_is_in_metres_with_either_renderer(make):
    make('FetchReach-v4')
    listed = gymnasium.make('FetchReach-v4', render_mode='rgb_array_list')
    assert isinstance(listed, gymnasium.wrappers.RenderCollection)
    assert listed.unwrapped.render_mode == 'rgb_array'
    env = make('FetchReach-v4', render_mode='depth_array')
    env.reset(seed=0)
    first = env.render()
    assert env.mujoco_renderer is env.mujoco_renderer
    robot = first < 5.0
    assert np.median(np.abs(env.render() - first)[robot]) < 0.1
