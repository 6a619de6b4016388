"""Checks of Stable-Baselines3's hindsight replay on environments of this project."""

from __future__ import annotations

from typing import Any

import numpy as np


def assert_goals_are_exchanged(model: Any) -> None:
    """Goals of sampled transitions are others than those pursued, and so are the rewards."""
    batch = model.replay_buffer.sample(256)
    goals = batch.observations['desired_goal'].numpy()
    reached = np.linalg.norm(batch.next_observations['achieved_goal'].numpy() - goals, axis=1)
    assert len(np.unique(goals, axis=0)) > 3
    clear = np.abs(reached - 0.05) > 1e-6
    expected = -(reached > 0.05).astype(np.float32)
    assert 0.0 in expected
    assert np.array_equal(batch.rewards.numpy()[clear, 0], expected[clear])
