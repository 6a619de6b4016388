"""The ring of episodes."""

from __future__ import annotations

import numpy as np
import pytest

from policy_node.training.experience.replay import EpisodeReplay, Episodes, has_moved


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


def test_what_cannot_fit_is_refused():
    with pytest.raises(ValueError, match='capacity 0'):
        EpisodeReplay(0, 3, 5, 2, 4)
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
