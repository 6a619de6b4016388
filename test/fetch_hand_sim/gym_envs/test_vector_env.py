"""The vectorised environment against Gymnasium's own vectorisation of the single one."""

from __future__ import annotations

import copy
import functools
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import fetch_hand_sim
from fetch_hand_sim.gym_envs.env import FetchHandEnv
from fetch_hand_sim.gym_envs.registration import environment_id
from fetch_hand_sim.gym_envs.vector_env import FetchHandVectorEnv
from support.same_bits import assert_same
from support.tasks import each_task


def make_vec(task: str, num_envs: int, **arguments) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        f'fetch_hand_sim:{environment_id(task)}',
        num_envs=num_envs,
        vectorization_mode='vector_entry_point',
        **arguments,
    )


def members(
    task: str, count: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **arguments
) -> gymnasium.vector.SyncVectorEnv:
    """Gymnasium's own vectorisation."""
    made = [lambda: gymnasium.make(environment_id(task), **arguments)] * count
    return gymnasium.vector.SyncVectorEnv(made, autoreset_mode=mode)


def state_of(env: gymnasium.vector.VectorEnv) -> bytes:
    return env.unwrapped.simulation.task.batch.state.tobytes()


@each_task
def test_the_batch_is_described_like_its_members(task):
    env = make_vec(task, 3)
    single = gymnasium.make(environment_id(task))
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert list(observation) == list(env.observation_space)


def assert_same_steps(env, reference, count: int) -> np.ndarray:
    """Play both; return how often each environment terminated and was truncated, (2, N)."""
    env.action_space.seed(0)
    ends = np.zeros((2, env.num_envs))
    for _ in range(count):
        actions = env.action_space.sample()
        ours, theirs = env.step(actions), reference.step(actions)
        assert list(ours[0]) == list(theirs[0])
        assert_same(ours[:4], theirs[:4])
        # Ours may have more.
        assert_same({name: ours[4][name] for name in theirs[4]}, theirs[4])
        assert ('final_obs' in ours[4]) == ('final_obs' in theirs[4])
        ends += ours[2:4]
    return ends


class Reaching:
    """Ends episodes at the goal, and those whose goal lies to the right."""

    def compute_terminated(self, achieved_goal, desired_goal, info):
        return info['is_success'] > 0.0

    def compute_truncated(self, achieved_goal, desired_goal, info):
        return desired_goal[..., 1] < 0.75


every_mode = pytest.mark.parametrize('mode', [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])


@every_mode
@pytest.mark.parametrize('task', ['FetchPush', 'HandReach', 'HandManipulateBlockRotateParallel'])
def test_it_equals_gymnasiums_vectorisation_over_several_episodes(task, mode):
    arguments = {'max_episode_steps': 4, 'reward_type': 'dense'}
    pair = make_vec(task, 3, autoreset_mode=mode, **arguments), members(task, 3, mode, **arguments)
    assert pair[0].metadata['autoreset_mode'] is mode
    assert_same(*(env.reset(seed=11)[0] for env in pair))
    ends = assert_same_steps(*pair, 13)
    assert ends.tolist() == [[0] * 3, [2 if mode is AutoresetMode.NEXT_STEP else 3] * 3]
    # The masked environment starts again with its seed; the others continue.
    masks = [{'reset_mask': np.array([False, True, False])} for _ in pair]
    resets = (env.reset(seed=[0, 50, 0], options=m) for env, m in zip(pair, masks, strict=True))
    assert_same(*(observation for observation, _ in resets))
    assert_same_steps(*pair, 5)


@every_mode
def test_successes_and_endings_of_a_subclass_count_as_in_gymnasiums_vectorisation(mode):
    arguments = {'max_episode_steps': 3, 'distance_threshold': 10.0}
    pair = (
        make_vec('FetchReach', 2, autoreset_mode=mode, **arguments),
        members('FetchReach', 2, mode, **arguments),
    )
    for env in pair:
        env.reset(seed=0)
    assert_same_steps(*pair, 4)
    arguments = {'task': 'FetchReach', 'distance_threshold': 0.12}
    batch, single = (type('Own', (Reaching, b), {}) for b in (FetchHandVectorEnv, FetchHandEnv))
    pair = (
        batch(num_envs=6, autoreset_mode=mode, **arguments),
        gymnasium.vector.SyncVectorEnv([lambda: single(**arguments)] * 6, autoreset_mode=mode),
    )
    assert_same(*(env.reset(seed=1)[0] for env in pair))
    ends = assert_same_steps(*pair, 8)
    assert ends.any(axis=1).all() and not ends.all()


def test_actions_of_environments_that_start_are_ignored():
    env = make_vec('FetchReach', 2, max_episode_steps=3)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((2, 4), np.float32))
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        first = copy.deepcopy(env).step(np.full((2, 4), np.nan, np.float32))
        assert_same(first[0], twin.step(np.ones((2, 4), np.float32))[0])
    env.step(np.zeros((2, 4), np.float32))
    with pytest.raises(ValueError, match='is nan'):
        env.step(np.full((2, 4), np.nan, np.float32))


def test_what_is_lost_after_its_episode_ended_draws_nothing():
    pair = [make_vec('FetchPush', 2, max_episode_steps=2) for _ in range(2)]
    for env in pair:
        env.reset(seed=0)
        for _ in range(2):
            env.step(np.zeros((2, 4), np.float32))
    pair[0].unwrapped.simulation.task.batch.bind('qvel')[0, 0] = np.nan
    lost, other = (env.step(np.zeros((2, 4), np.float32)) for env in pair)
    assert pair[0].unwrapped.simulation.divergences == 1
    assert_same(lost[0], other[0])
    assert lost[3].tolist() == other[3].tolist() == [False, False]


def test_without_autoreset_an_ended_episode_waits_for_its_reset():
    env = make_vec('FetchReach', 2, max_episode_steps=2, autoreset_mode='Disabled')
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.reset(options={'reset_mask': np.array([False, True])})
    assert env.step(env.action_space.sample())[3].tolist() == [True, False]
    before = state_of(env)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r'episodes \[0\] have ended'):
        env.step(env.action_space.sample())
    assert state_of(env) == before
    env.reset(options={'reset_mask': np.array([True, False])})
    assert env.step(env.action_space.sample())[3].tolist() == [False, True]


def test_attributes_and_calls_are_those_of_the_members():
    env = make_vec('HandReach', 3).unwrapped
    reference = members('HandReach', 3)
    observation, _ = env.reset(seed=2)
    reference.reset(seed=2)
    for vector in (env, reference):
        vector.set_attr('distance_threshold', 0.2)
        vector.set_attr('reward_type', ['dense'] * 3)
        vector.set_attr('goal', [np.full(15, 0.1 * i) for i in range(3)])
    for name in ('distance_threshold', 'reward_type', 'dt', 'render_mode', 'action_space'):
        assert env.get_attr(name) == reference.get_attr(name)
    assert_same(env.get_attr('goal'), reference.get_attr('goal'))
    assert_same(env.step(np.zeros((3, 20)))[1], reference.step(np.zeros((3, 20)))[1])
    goals = observation['achieved_goal'], observation['desired_goal']
    assert_same(*(each.call('compute_reward', *goals, {}) for each in (env, reference)))
    assert len(env.call('data')) == 3
    with pytest.raises(AttributeError, match="'model' of a batch cannot be set; allowed: goal, "):
        env.set_attr('model', None)
    with pytest.raises(ValueError, match='share distance_threshold'):
        env.set_attr('distance_threshold', [1.0, 1.0, 2.0])
    with pytest.raises(ValueError, match='3 environments take as many values, not 1'):
        env.set_attr('goal', [0.0])
    with pytest.raises(ValueError, match='goals of HandReach'):
        env.set_attr('goal', [[0.3]] * 3)
    with pytest.raises(AttributeError, match='no attribute'):
        env.get_attr('colour')


@pytest.mark.parametrize('kind', [FetchHandEnv, FetchHandVectorEnv])
def test_a_shallow_copy_has_no_physics_in_common(kind):
    env = kind('FetchPush')
    env.reset(seed=0)
    before = state_of(env)
    twin = copy.copy(env)
    twin.step(np.ones(env.action_space.shape, np.float32))
    twin.reset()
    assert state_of(env) == before != state_of(twin)


def test_episodes_have_the_goals_that_their_reset_was_given():
    env, reference = make_vec('FetchReach', 3), members('FetchReach', 3)
    one = {'goal': np.array([1.3, 0.7, 0.6])}
    assert_same(env.reset(seed=0, options=one)[0], reference.reset(seed=0, options=one)[0])
    mask, goals = np.array([False, True, True]), np.arange(9.0).reshape(3, 3)
    observation, _ = env.reset(options={'reset_mask': mask, 'goal': goals})
    assert observation['desired_goal'].tolist() == [[1.3, 0.7, 0.6], [3, 4, 5], [6, 7, 8]]


def test_a_subclass_ends_episodes_by_booleans_and_has_no_method_that_nothing_calls():
    single = {'_sample_goal': lambda self: np.zeros(3)}
    with pytest.raises(TypeError, match='_sample_goal would have no effect here; a batch calls'):
        type('Batch', (FetchHandVectorEnv,), single)('FetchReach')
    env = FetchHandVectorEnv('FetchReach', 2)
    with pytest.raises(TypeError, match='_get_obs would have no effect here'):
        env._get_obs = None
    env.compute_terminated = lambda achieved_goal, desired_goal, info: np.bool_(True)
    env.compute_reward = lambda achieved_goal, desired_goal, info: [-7, -8]
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r'compute_terminated .* booleans of shape \(2,\), one'):
        env.step(np.zeros((2, 4)))
    env.compute_terminated = lambda achieved_goal, desired_goal, info: True
    _, reward, terminated, *_ = env.step(np.array([[np.inf, -np.inf, 0, 0]] * 2))
    assert (reward.tolist(), terminated.tolist()) == ([-7.0, -8.0], [True, True])


def test_seeds_and_generators_are_those_of_gymnasiums_vectorisation():
    env, reference = make_vec('FetchReach', 3), members('FetchReach', 3)
    one = np.array([False, True, False])
    for arguments, expected in (
        ({'seed': 5}, (5, 6, 7)),
        ({}, (5, 6, 7)),
        ({'seed': [3, None, 9]}, (3, 6, 9)),
        ({'seed': 20, 'options': {'reset_mask': one}}, (3, 21, 9)),
        ({'seed': [1, 2, 4], 'options': {'reset_mask': one}}, (3, 2, 9)),
    ):
        for each in (env, reference):
            # Gymnasium takes the mask out of the dictionary.
            each.reset(**copy.deepcopy(arguments))
            assert each.np_random_seed == each.unwrapped.get_attr('np_random_seed') == expected
    for mine, other in zip(env.np_random, reference.np_random, strict=True):
        assert mine.bit_generator.state == other.bit_generator.state


def test_generators_may_be_read_and_written_before_the_first_episode():
    drawn, read, held = (make_vec('FetchReach', 2) for _ in range(3))
    assert drawn.np_random_seed == (-1, -1)
    assert min(generator.bit_generator.state['state']['state'] for generator in read.np_random) > 0
    for env in (drawn, read):
        first, _ = env.reset()
        assert min(env.np_random_seed) >= 0
        assert_same(make_vec('FetchReach', 2).reset(seed=env.np_random_seed)[0], first)
    generators, goals = held.get_attr('np_random'), []
    for _ in range(2):
        for number, generator in enumerate(held.np_random):
            generator.bit_generator.state = np.random.default_rng(number).bit_generator.state
        goals.append(held.reset()[0])
    assert all(mine is other for mine, other in zip(held.np_random, generators, strict=True))
    assert_same(*goals)


def test_a_diverged_environment_is_truncated_and_starts_again():
    env = make_vec('FetchPush', 3, render_mode='rgb_array')
    mask = np.array([False, True, False])
    with pytest.raises(gymnasium.error.ResetNeeded, match=r'reset_mask leaves out \[0, 2\]'):
        env.reset(options={'reset_mask': mask})
    with pytest.raises(gymnasium.error.ResetNeeded, match='before render'):
        env.render()
    observation, _ = env.reset(seed=0)
    env.unwrapped.simulation.task.batch.bind('qvel')[1, 0] = np.nan
    _, _, terminated, truncated, info = env.step(np.zeros((3, 4)))
    assert truncated.tolist() == info['diverged'].tolist() == [False, True, False]
    assert not terminated.any()
    # Replay buffers ask again: with the info of one step or a list of many.
    goals = observation['achieved_goal'], observation['desired_goal']
    infos = [{'diverged': each} for each in truncated]
    for many in (info, infos, np.array(infos)):
        assert env.unwrapped.compute_truncated(*goals, many).tolist() == truncated.tolist()
    lost = [env.unwrapped.compute_truncated(*goals, one) for one in ({}, None, infos[1])]
    assert lost == [False, False, True]
    _, reward, _, truncated, info = env.step(np.zeros((3, 4)))
    assert not truncated.any()
    assert reward[1] == 0.0
    assert info['_is_success'].tolist() == [True, False, True]


def test_pictures_show_each_environment(monkeypatch):
    monkeypatch.setenv('MUJOCO_GL', 'egl')
    env = make_vec('FetchReach', 2, render_mode='rgb_array', width=96, height=64)
    env.reset(seed=0)
    try:
        pictures = env.render()
    except RuntimeError as error:
        pytest.skip(str(error))
    assert [picture.shape for picture in pictures] == [(64, 96, 3)] * 2
    # The goals differ.
    assert (pictures[0] != pictures[1]).any()
    assert make_vec('FetchReach', 1).render() is None


def test_arguments_of_gymnasium_are_those_of_its_vectorisation():
    env = make_vec('FetchReach', 2, max_episode_steps=-1, disable_env_checker=True)
    env.reset(seed=0)
    assert not any(env.step(np.zeros((2, 4)))[3].any() for _ in range(55))
    with pytest.raises(ValueError, match=r'distance_threshold array\('):
        env.unwrapped.set_attr('distance_threshold', np.array([0.1, 0.1]))
    assert fetch_hand_sim.make_vec('FetchReach', vectorization_mode='vector_entry_point')
    with pytest.raises(ValueError, match="mode 'sync' is for gymnasium"):
        fetch_hand_sim.make_vec('FetchReach', 2, vectorization_mode='sync')


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'autoreset_mode': 'Never'}, "mode 'Never'; allowed: NextStep, SameStep, D"),
        ({'render_mode': 'human'}, "render_mode 'human'; allowed: rgb_array, depth_array"),
        ({'max_episode_steps': 1.5}, 'max_episode_steps .*1.5; allowed: whole'),
        ({'max_episode_steps': 0}, r'max_episode_steps \(-1 for no limit\) 0; allowed: whole'),
        ({'num_threads': True}, 'num_threads True; allowed: whole'),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_vec('FetchReach', 2, **arguments)


def test_wrappers_go_around_the_batch():
    name = environment_id('FetchPush')
    flat = fetch_hand_sim.make_vec(name, 3, wrappers=[gymnasium.wrappers.FlattenObservation])
    assert flat.reset(seed=0)[0].shape == (3, 31)
    scaled = functools.partial(gymnasium.wrappers.RescaleAction, min_action=0.0, max_action=1.0)
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics
    env = fetch_hand_sim.make_vec(name, 2, wrappers=[scaled, counted], max_episode_steps=2)
    assert env.single_action_space.low.tolist() == [0.0] * 4
    env.reset(seed=0)
    env.step(np.full((2, 4), 0.5))
    assert env.step(np.full((2, 4), 0.5))[4]['episode']['l'].tolist() == [2, 2]
    with pytest.raises(ValueError, match='TimeLimit wraps single environments only'):
        fetch_hand_sim.make_vec(name, 2, wrappers=[gymnasium.wrappers.TimeLimit])
    for bad in (5, 'a', ['a'], gymnasium.wrappers.FlattenObservation):
        with pytest.raises(ValueError, match=r'wrappers .*; allowed: a list of them'):
            fetch_hand_sim.make_vec(name, 2, wrappers=bad)


def test_functions_of_a_wrapper_of_single_environments_are_asked_of_each():
    name = environment_id('FetchReach')
    joined = functools.partial(
        gymnasium.wrappers.TransformObservation,
        func=lambda each: np.concatenate([each['observation'], each['desired_goal']]),
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (13,), np.float64),
    )
    shaped = functools.partial(gymnasium.wrappers.TransformReward, func=lambda each: max(each, -9))
    env = fetch_hand_sim.make_vec(name, 2, wrappers=[joined, shaped])
    first, _ = env.reset(seed=0)
    assert env.single_observation_space.shape == (13,)
    assert env.observation_space.contains(first)
    plain, _ = make_vec('FetchReach', 2).reset(seed=0)
    assert_same(first[:, 10:], plain['desired_goal'])
    assert env.step(np.zeros((2, 4), dtype=np.float32))[1].tolist() == [-1.0, -1.0]
