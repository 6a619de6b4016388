"""The memory of a policy."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from fetch_hand_sim.films.playing import film_episode
from policy_node.policies.policy import past_after, past_before


def test_the_newest_action_comes_first_and_the_oldest_leaves() -> None:
    past = past_before(None, None, (1,), 4)
    for number in (1.0, 2.0, 3.0):
        past = past_after(past, np.full((1, 2), number, np.float32))
    assert past.tolist() == [[3.0, 3.0, 2.0, 2.0]]


def test_an_episode_starts_with_zeros() -> None:
    state = np.ones((2, 4), np.float32)
    assert past_before(state, [True, False], (2,), 4).tolist() == [[0.0] * 4, [1.0] * 4]


def test_a_state_of_another_batch_is_rejected() -> None:
    with pytest.raises(ValueError, match=r'\(3, 4\)'):
        past_before(np.ones((3, 4)), None, (2,), 4)


def test_a_film_passes_the_state_on() -> None:
    states = []

    class Counting:
        def predict(self, observation, state=0, *, deterministic=True):
            states.append(state)
            return np.zeros(4), state + 1

    class Blank(gymnasium.Wrapper):
        def render(self):
            return np.zeros((16, 16, 3), np.uint8)

    env = gymnasium.make('fetch_hand_sim/FetchReach-v0', render_mode='rgb_array')
    film_episode(gymnasium.wrappers.TimeLimit(Blank(env.unwrapped), 3), Counting(), seed=0)
    assert states == [0, 1, 2]
