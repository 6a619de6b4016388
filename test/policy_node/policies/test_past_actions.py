"""The memory of a policy."""

from __future__ import annotations

import numpy as np
import pytest

from policy_node.policies.past_actions import past_after, past_before


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
