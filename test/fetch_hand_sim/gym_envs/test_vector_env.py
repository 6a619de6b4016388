"""The vectorised environment against Gymnasium's own vectorisation of the single one."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from fetch_hand_sim.gym_envs.registration import environment_id
from msgs_spec.tasks import TASKS


def make_vec(task: str, num_envs: int, **arguments) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        f'fetch_hand_sim:{environment_id(task)}',
        num_envs=num_envs,
        vectorization_mode='vector_entry_point',
        **arguments,
    )


def state_of(env: gymnasium.vector.VectorEnv) -> bytes:
    return env.unwrapped.simulation._task.batch.state.tobytes()


def assert_same(first, second) -> None:
    """Equal to the bit, dictionaries of arrays included."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for name in first:
            assert_same(first[name], second[name])
    else:
        assert np.asarray(first).tobytes() == np.asarray(second).tobytes()


@pytest.mark.parametrize('task', TASKS)
def test_the_batch_is_described_like_its_members(task):
    env = make_vec(task, 3)
    single = gymnasium.make(environment_id(task))
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    assert env.metadata['autoreset_mode'] is AutoresetMode.NEXT_STEP
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach', 'HandManipulateBlockRotateParallel'])
def test_it_equals_gymnasiums_vectorisation_over_several_episodes(task):
    env = make_vec(task, 3, max_episode_steps=4, reward_type='dense')
    members = [
        lambda: gymnasium.make(environment_id(task), max_episode_steps=4, reward_type='dense')
    ] * 3
    reference = gymnasium.vector.SyncVectorEnv(members)
    assert_same(env.reset(seed=11)[0], reference.reset(seed=11)[0])
    env.action_space.seed(0)
    ends = 0
    for _ in range(13):
        actions = env.action_space.sample()
        ours, theirs = env.step(actions), reference.step(actions)
        for mine, other in zip(ours[:4], theirs[:4], strict=True):
            assert_same(mine, other)
        assert_same(ours[4]['is_success'], theirs[4].get('is_success', np.zeros(3)))
        assert_same(ours[4]['_is_success'], theirs[4].get('_is_success', np.zeros(3, dtype=bool)))
        ends += ours[3].all()
    assert ends == 2


def test_a_masked_reset_starts_only_the_masked():
    env = make_vec('FetchPush', 3, max_episode_steps=3)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    before = env.unwrapped.simulation._task.batch.state.copy()
    mask = np.array([False, True, False])
    observation, _ = env.reset(seed=[0, 50, 0], options={'reset_mask': mask})
    after = env.unwrapped.simulation._task.batch.state
    assert after[~mask].tobytes() == before[~mask].tobytes()
    expected, _ = gymnasium.make(environment_id('FetchPush')).reset(seed=50)
    for name, values in expected.items():
        assert observation[name][1].tobytes() == values.tobytes()
    truncations = [env.step(env.action_space.sample())[3].tolist() for _ in range(4)]
    # The masked episode is one step younger; who ends starts again at the next step.
    assert truncations == [
        [False, False, False],
        [True, False, True],
        [False, True, False],
        [False, False, False],
    ]


def test_a_diverged_environment_is_truncated_and_starts_again():
    env = make_vec('FetchPush', 3)
    env.reset(seed=0)
    env.unwrapped.simulation._task.batch.bind('qvel')[1, 0] = np.nan
    _, _, terminated, truncated, info = env.step(np.zeros((3, 4)))
    assert truncated.tolist() == info['diverged'].tolist() == [False, True, False]
    assert not terminated.any()
    _, reward, _, truncated, info = env.step(np.zeros((3, 4)))
    assert not truncated.any()
    assert reward[1] == 0.0
    assert info['_is_success'].tolist() == [True, False, True]


BAD_RESETS = {
    'options': ({'options': [1]}, TypeError, r'a dictionary or None, not \[1\]'),
    'unknown option': (
        {'options': {'ids': [0]}},
        ValueError,
        "'ids' is not known; allowed: reset_",
    ),
    'mask type': ({'options': {'reset_mask': [True, False]}}, TypeError, 'is a boolean array'),
    'mask of numbers': ({'options': {'reset_mask': np.ones(2)}}, TypeError, 'is a boolean array'),
    'mask shape': (
        {'options': {'reset_mask': np.ones(3, dtype=bool)}},
        ValueError,
        r'shape \(2,\), not \(3,\)',
    ),
    'negative seed': ({'seed': -5}, ValueError, 'must not be negative'),
    'too many seeds': ({'seed': [1, 2, 3]}, ValueError, '2 environments take as many seeds, not 3'),
}


@pytest.mark.parametrize('bad', BAD_RESETS)
def test_bad_resets_move_nothing(bad):
    arguments, error, message = BAD_RESETS[bad]
    env = make_vec('FetchPush', 2)
    env.reset(seed=0)
    before = state_of(env)
    with pytest.raises(error, match=message):
        env.reset(**arguments)
    assert state_of(env) == before


def test_bad_actions_move_nothing():
    env = make_vec('HandReach', 2)
    env.reset(seed=0)
    before = state_of(env)
    with pytest.raises(ValueError, match=r'shape \(2, 20\), not \(2, 4\)'):
        env.step(np.zeros((2, 4)))
    assert state_of(env) == before


def test_an_episode_has_at_least_one_step():
    with pytest.raises(ValueError, match='max_episode_steps must be at least 1, not 0'):
        make_vec('FetchReach', 2, max_episode_steps=0)
