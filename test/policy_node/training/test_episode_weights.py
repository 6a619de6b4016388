"""Weights of episodes and ticks that are worth drawing, on episodes whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from msgs_spec.tasks import task_spec
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.experience import Experience, ticks_until_dropped
from policy_node.training.experience.replay import EpisodeReplay, Episodes, has_moved
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers

PEN = task_spec('HandManipulatePenRotate')
TICKS = 10


def episodes_of(achieved):
    """Episodes with these achieved goals (episodes, T + 1, goal size)."""
    achieved = np.asarray(achieved, np.float32)
    count, states, _ = achieved.shape
    return Episodes(
        achieved, achieved, achieved[:, 0], np.zeros((count, states - 1, 1), np.float32)
    )


def poses(heights):
    """Poses (episodes, T + 1, 7) at these heights, not turned."""
    achieved = np.zeros((*heights.shape, 7))
    achieved[..., 2], achieved[..., 3] = heights, 1.0
    return achieved


def test_ticks_count_until_some_after_the_drop():
    heights = np.full((4, TICKS + 1), 0.2)
    heights[1, 4:] = 0.03
    heights[2, 10:] = 0.03
    heights[3, 1:] = 0.03
    episodes = episodes_of(poses(heights))
    for more, expected in ((0, [10, 4, 10, 1]), (2, [10, 6, 10, 3]), (99, [10] * 4)):
        count = ticks_until_dropped(PEN, more)
        assert count is not None and count(episodes).tolist() == expected
    assert ticks_until_dropped(PEN, -1) is None
    assert ticks_until_dropped(task_spec('FetchPush'), 3) is None


def test_every_valid_transition_is_as_likely_as_any_other():
    heights = np.full((3, TICKS + 1), 0.2)
    heights[0, 2:] = 0.0
    replay = EpisodeReplay(8, TICKS, 7, 7, 1, count_ticks=ticks_until_dropped(PEN, 0))
    replay.add(episodes_of(poses(heights)))
    row = replay.draw(22_000, 0.0, np.random.default_rng(0))
    assert np.bincount(row) / 22_000 == pytest.approx([2 / 22, 10 / 22, 10 / 22], abs=0.012)


def pen_episodes(achieved):
    """Episodes of these poses, seen as they are; the first value observed is the tick."""
    count = len(achieved)
    observation = np.zeros((count, PEN.episode_ticks + 1, PEN.observation_size))
    observation[..., 0] = np.arange(PEN.episode_ticks + 1)
    observation[..., -7:] = achieved
    return Episodes(
        *(values.astype(np.float32) for values in (observation, achieved, achieved[:, 0])),
        np.zeros((count, PEN.episode_ticks, 20), np.float32),
    )


def test_a_batch_follows_the_configuration():
    """A batch has only the one episode that was lifted, and only until its drop."""
    changes = {'moved_share': 1.0, 'ticks_after_drop': 1}
    config = recipe_config(
        'HandManipulatePenRotate', 'best', batch_size=500, num_envs=3, goals='final=1', **changes
    )
    heights = np.full((3, PEN.episode_ticks + 1), 0.2)
    heights[1, 3:] += 0.01 * np.arange(PEN.episode_ticks - 2)
    heights[1, 20:] = 0.0
    achieved = poses(heights)
    achieved[..., 0] = np.arange(3)[:, None]
    episodes = pen_episodes(achieved)
    reward = lambda achieved, desired: -np.ones(len(achieved))  # noqa: E731
    sampler = TransitionSampler(reward, config.gamma)
    parts = sampler, np.random.default_rng(0)
    experience = Experience(config, PEN, Workers(), *parts)
    experience.replay.add(episodes)
    batch = experience.batch(env_steps=0)
    assert set(batch.observation[:, -7]) == {1.0}
    assert set(batch.observation[:, 0]) == set(range(21))
    assert has_moved(episodes).tolist() == [0.0, 1.0, 0.0]


def sideways(achieved, goal):
    """Return -1 if the distance to the goal along y is above 0.5, else 0."""
    return -1.0 * (np.abs(achieved - goal)[..., 1] > 0.5)


@pytest.mark.parametrize('source', ['real', 'future'])
@pytest.mark.parametrize('n_step', [1, 3])
def test_a_drop_that_is_lost_is_worth_minus_one_for_ever(n_step, source):
    """Episode 0 drops its pen at tick 20, episode 1 never; rewards are -1 but at tick 5.

    With goals in hindsight, but at the tick that the goal is of: that of the loss perhaps.
    """
    changes = {'ticks_after_drop': 1, 'drop_is_lost': True, 'gamma': 0.9, 'n_step': n_step}
    config = recipe_config('HandManipulatePenRotate', 'best', **changes)
    heights = np.full((2, PEN.episode_ticks + 1), 0.2)
    heights[0, 20:] = 0.0
    achieved = poses(heights)
    achieved[..., 1] = np.arange(PEN.episode_ticks + 1)
    episodes = pen_episodes(achieved)
    episodes.desired_goal[:, 1] = 5.0
    sampler = TransitionSampler(sideways, 0.9, n_step, lost_value=config.lowest_value)
    valid = ticks_until_dropped(PEN, 1)(episodes)
    row = np.repeat([0, 1], 4000)
    generator = np.random.default_rng(0)
    batch = sampler.sample(episodes, row, {source: 1.0}, generator, valid)
    ends = batch.discount == 0
    assert ends[:4000].any() and not ends[4000:].any()
    tick, goal = batch.observation[:, 0].astype(int), batch.goal[:, 1]
    left = np.where(row == 0, 21, PEN.episode_ticks) - tick
    assert (ends == ((row == 0) & (left <= n_step))).all()
    expected = []
    for index, count in enumerate(np.minimum(left, n_step)):
        reached = [float(tick[index] + step + 1 == goal[index]) for step in range(count)]
        total = sum(0.9**step * (hit - 1.0) for step, hit in enumerate(reached))
        expected.append(total + 0.9**count * ends[index] * -10.0)
    np.testing.assert_allclose(batch.reward, expected, rtol=1e-5)
    # -1 for every later tick, plus the reward of a goal that is reached on the way.
    worth = -10.0 + 0.9 ** (goal - tick - 1.0) * (source == 'future')
    np.testing.assert_allclose(batch.reward[ends], worth[ends], rtol=1e-5)
    assert len(set(batch.reward[~ends])) > n_step, 'goals are met where nothing is lost as well'
