"""The ring of episodes, the weights of episodes and ticks, and running statistics."""

from __future__ import annotations

import numpy as np
import pytest

from msgs_spec.tasks import task_spec
from policy_node.policies.actor import Normalizer
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.episode_files import load_replay, save_replay
from policy_node.training.experience.experience import (
    Experience,
    RunningStatistics,
    ticks_until_dropped,
)
from policy_node.training.experience.replay import EpisodeReplay, Episodes, has_moved
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers


def numbered(first, count, ticks=3):
    """Episodes whose every value is their number."""
    number = np.arange(first, first + count, dtype=np.float32)

    def fill(*shape):
        return np.broadcast_to(number.reshape(-1, *[1] * len(shape)), (count, *shape)).copy()

    return Episodes(fill(ticks + 1, 5), fill(ticks + 1, 2), fill(2), fill(ticks, 4))


def test_the_ring_keeps_the_latest_episodes_whole():
    replay = EpisodeReplay(5, ticks=3, observation_size=5, goal_size=2, action_size=4)
    assert len(replay) == 0
    for first in range(0, 8, 2):
        replay.add(numbered(first, 2))
        assert len(replay) == min(first + 2, 5)
    held = replay.episodes
    assert sorted(held.desired_goal[:, 0].tolist()) == [3, 4, 5, 6, 7]
    for values in (held.observation, held.achieved_goal, held.action):
        flat = values.reshape(len(held), -1)
        assert (flat == held.desired_goal[:, :1]).all()


def test_the_newest_episodes_are_kept_in_order(tmp_path):
    first, file = EpisodeReplay(8, 3, 5, 2, 4), tmp_path / 'replay.safetensors'
    for number in range(13):
        first.add(numbered(number, 1))
    for transitions, kept in ((0, []), (1, [12]), (9, [10, 11, 12]), (1000, list(range(5, 13)))):
        save_replay(file, first, transitions)
        second = EpisodeReplay(8, 3, 5, 2, 4)
        load_replay(file, second)
        assert second.newest(8).action[:, 0, 0].tolist() == kept
    with pytest.raises(ValueError, match=r'replay\.safetensors'):
        load_replay(file, EpisodeReplay(8, 3, 5, 2, action_size=1))


def test_what_cannot_fit_is_refused():
    with pytest.raises(ValueError, match='3 episodes exceed the capacity of 2'):
        EpisodeReplay(2, 3, 5, 2, 4).add(numbered(0, 3))


def test_moved_episodes_are_those_whose_goal_left_its_start():
    episodes = numbered(0, 3)
    episodes.achieved_goal[1, 2, 1] += 0.02
    episodes.achieved_goal[2, 1:] += 0.005
    assert has_moved(episodes).tolist() == [False, True, False]


def test_the_moved_share_of_a_draw():
    replay = EpisodeReplay(8, 3, 5, 2, 4)
    generator = np.random.default_rng(0)
    replay.add(numbered(0, 6))
    assert set(replay.draw(1000, 0.5, generator).tolist()) == set(range(6))
    moved = numbered(6, 2)
    moved.achieved_goal[:, -1] += 1.0
    replay.add(moved)
    assert (replay.draw(8000, 0.0, generator) >= 6).mean() == pytest.approx(1 / 4, abs=0.02)
    assert (replay.draw(8000, 0.6, generator) >= 6).mean() == pytest.approx(0.7, abs=0.02)
    replay.add(numbered(8, 8))
    assert set(replay.draw(1000, 1.0, generator).tolist()) == set(range(8))


PEN = task_spec('HandManipulatePenRotate')
TICKS = PEN.episode_ticks


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
    episodes = pen_episodes(poses(heights))
    for more, expected in ((0, [TICKS, 4, 10, 1]), (2, [TICKS, 6, 12, 3]), (99, [TICKS] * 4)):
        count = ticks_until_dropped(PEN, more)
        assert count is not None and count(episodes).tolist() == expected
    assert ticks_until_dropped(PEN, -1) is None
    assert ticks_until_dropped(task_spec('FetchPush'), 3) is None


def test_every_valid_transition_is_as_likely_as_any_other():
    heights = np.full((3, TICKS + 1), 0.2)
    heights[0, 20:] = 0.0
    sizes = PEN.observation_size, 7, 20
    replay = EpisodeReplay(8, TICKS, *sizes, count_ticks=ticks_until_dropped(PEN, 0))
    replay.add(pen_episodes(poses(heights)))
    row = replay.draw(22_000, 0.0, np.random.default_rng(0))
    assert np.bincount(row) / 22_000 == pytest.approx([20 / 220, 100 / 220, 100 / 220], abs=0.012)


def pen_episodes(achieved):
    """Episodes of these poses, seen as they are; the first value observed is the tick."""
    count = len(achieved)
    observation = np.zeros((count, TICKS + 1, PEN.observation_size))
    observation[..., 0] = np.arange(TICKS + 1)
    observation[..., -7:] = achieved
    return Episodes(
        *(values.astype(np.float32) for values in (observation, achieved, achieved[:, 0])),
        np.zeros((count, TICKS, 20), np.float32),
    )


def test_a_batch_follows_the_configuration():
    changes = {'moved_share': 1.0, 'ticks_after_drop': 1}
    config = recipe_config(
        'HandManipulatePenRotate', 'best', batch_size=500, num_envs=3, goals='final=1', **changes
    )
    heights = np.full((3, TICKS + 1), 0.2)
    heights[1, 3:] += 0.01 * np.arange(TICKS - 2)
    heights[1, 20:] = 0.0
    achieved = poses(heights)
    achieved[..., 0] = np.arange(3)[:, None]
    episodes = pen_episodes(achieved)
    reward = lambda achieved, desired: -np.ones(len(achieved))  # noqa: E731
    sampler = TransitionSampler(reward, config.gamma)
    parts = sampler, np.random.default_rng(0)
    experience = Experience(config, PEN, Workers(), *parts)
    experience.replay.add(episodes)
    batch = experience.batch()
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
    heights = np.full((2, TICKS + 1), 0.2)
    heights[0, 20:] = 0.0
    achieved = poses(heights)
    achieved[..., 1] = np.arange(TICKS + 1)
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
    left = np.where(row == 0, 21, TICKS) - tick
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


def test_statistics_over_parts_are_those_of_everything():
    generator = np.random.default_rng(0)
    values = generator.normal([3.0, -2.0], [0.5, 4.0], size=(40, 25, 2))
    statistics, normalizer = RunningStatistics(2), Normalizer(2)
    for part in np.array_split(values, 7):
        statistics.update(part, Workers())
    statistics.write(normalizer)
    flat = values.reshape(-1, 2)
    np.testing.assert_allclose(normalizer.mean, flat.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(normalizer.std, flat.std(axis=0), rtol=1e-5)


def test_std_has_a_floor_and_values_a_ceiling():
    statistics, normalizer = RunningStatistics(2), Normalizer(2)
    statistics.update([[7.0, 1e6], [7.0, 1e6]], Workers())
    statistics.write(normalizer)
    assert normalizer.mean.tolist() == [7.0, 200.0]
    np.testing.assert_allclose(normalizer.std, 0.01)


def test_an_empty_batch_changes_no_statistics():
    statistics, normalizer = RunningStatistics(3), Normalizer(3)
    statistics.update(np.zeros((0, 3)), Workers())
    statistics.write(normalizer)
    assert normalizer.std.tolist() == [1.0, 1.0, 1.0]
