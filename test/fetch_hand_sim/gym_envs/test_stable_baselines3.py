"""The batch for Stable-Baselines3 beside its own vectorisation of single environments."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from fetch_hand_sim.gym_envs.registration import environment_id
from support.same_bits import assert_same

pytest.importorskip('stable_baselines3')
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from fetch_hand_sim.gym_envs.stable_baselines3 import FetchHandVecEnv


def test_attributes_and_methods_are_asked_of_some_environments():
    env = FetchHandVecEnv('FetchReach', 3, control_hz=50.0)
    first = env.reset()
    assert env.metadata['render_fps'] == 50.0
    env.set_attr('goal', np.ones(3), indices=1)
    assert env.get_attr('goal', indices=[1])[0].tolist() == [1.0, 1.0, 1.0]
    assert env.get_attr('goal', indices=0)[0].tolist() != [1.0, 1.0, 1.0]
    env.set_attr('distance_threshold', 0.5)
    assert env.get_attr('distance_threshold') == [0.5] * 3
    with pytest.raises(ValueError, match='share reward_type'):
        env.set_attr('reward_type', 'dense', indices=[0])
    with pytest.raises(ValueError, match='reset is for all environments of a batch'):
        env.env_method('reset', indices=[1])
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    # To ask for a method is not to call it.
    assert all(env.has_attr(name) for name in ('spec_of_task', 'reset', 'step'))
    assert not env.has_attr('colour')
    (reward,) = env.get_attr('compute_reward', indices=0)
    assert reward(first['achieved_goal'], first['achieved_goal']).tolist() == [0.0] * 3
    assert np.array_equal(env.get_attr('goal', indices=[0]), first['desired_goal'][:1])


def seen(step):
    """Return the values of a step that learners read."""
    *arrays, infos = step
    names = ('is_success', 'diverged', 'TimeLimit.truncated', 'terminal_observation')
    return arrays, [{name: info[name] for name in names if name in info} for info in infos]


def test_episodes_and_reset_options_equal_a_dummy_vec_env():
    arguments = {'max_episode_steps': 4, 'reward_type': 'dense'}
    arguments |= {'disturbances': {'physics': {'friction': [0.5, 2.0]}}}
    ours = FetchHandVecEnv('FetchPush', 2, **arguments)
    name = environment_id('FetchPush')
    theirs = DummyVecEnv([lambda: gymnasium.make(name, **arguments)] * 2)
    pose = [1.25, 0.65, 0.45, 0.6, 0.0, 0.0, 0.8]
    start, variation = {'object_pose': pose}, {'friction': 0.7}
    actions = np.random.default_rng(0).uniform(-1, 1, (9, 2, 4)).astype(np.float32)
    for options in (
        {'goal': pose[:3], 'variation': variation},
        [{}, {'goal': pose[:3]}],
        [{'variation': variation}, {'start': start, 'goal': pose[:3]}],
        None,
    ):
        for env in (ours, theirs):
            env.seed(3)
            env.set_options(options)
        first, second = (env.reset() for env in (ours, theirs))
        simulations = [each.unwrapped.simulation for each in theirs.envs]
        assert [ours.batch.simulation.variation(i) for i in range(2)] == [
            each.variation(0) for each in simulations
        ]
        assert list(first) == list(second)
        assert_same(first, second)
        for action in actions:
            assert_same(*(seen(env.step(action)) for env in (ours, theirs)))
    ours.set_options({'gaol': [0.0] * 3})
    with pytest.raises(ValueError, match="has no 'gaol'; allowed: goal"):
        ours.reset()
    ours.reset()


def test_an_episode_ended_by_a_user_method_has_no_time_limit():
    env = FetchHandVecEnv('FetchReach', 2, max_episode_steps=2)
    env.batch.compute_terminated = lambda achieved_goal, desired_goal, info: np.array([True, False])
    env.reset()
    first, second = (env.step(np.zeros((2, 4), np.float32)) for _ in range(2))
    assert first[2].tolist() == [True, False] and second[2].tolist() == [True, True]
    assert 'terminal_observation' in first[3][0]
    assert [info['TimeLimit.truncated'] for info in second[3]] == [False, True]


def assert_goals_are_exchanged(model):
    """Goals of sampled transitions have goals of other states, and the rewards for these goals."""
    batch = model.replay_buffer.sample(256)
    goals = batch.observations['desired_goal'].numpy()
    reached = np.linalg.norm(batch.next_observations['achieved_goal'].numpy() - goals, axis=1)
    assert len(np.unique(goals, axis=0)) > 3
    clear = np.abs(reached - 0.05) > 1e-6
    expected = -(reached > 0.05).astype(np.float32)
    assert 0.0 in expected
    assert np.array_equal(batch.rewards.numpy()[clear, 0], expected[clear])


def test_it_learns_with_hindsight():
    torch.set_num_threads(1)
    env = VecMonitor(FetchHandVecEnv('FetchReach', 4, max_episode_steps=10))
    model = SAC(
        'MultiInputPolicy',
        env,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={'net_arch': [16]},
        learning_starts=80,
        batch_size=32,
        seed=0,
        device='cpu',
    )
    model.learn(120)
    assert_goals_are_exchanged(model)
    assert len(model.ep_info_buffer) == 12
