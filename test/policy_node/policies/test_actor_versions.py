"""Actors of earlier versions: loaded, and acting as they did."""

from __future__ import annotations

import hashlib

import numpy as np

from policy_node import load_actor, load_policy
from support import ROOT

# Trained and shipped by version 0.1, as of revision 2ce2393; never to be written again.
OLD = ROOT / 'test' / 'data' / 'actors_0_1' / 'FetchReach.safetensors'
SHA256 = '09eb61122b4f452d09e80929eb26176ea204a80b3976a53faea874723777aa56'
# Its actions then, for the observations below: torch, float32, printed to six digits.
ACTIONS = [
    [0.904434, -0.98054, -0.985772, 0.840785],
    [0.999993, 0.993948, -0.960085, 0.81581],
    [-0.999991, 1.0, 0.860816, 0.405477],
]


def observations() -> dict[str, np.ndarray]:
    """Three in the middle of where FetchReach is, drawn as they were for `ACTIONS`."""
    generator = np.random.default_rng(0)
    generator.normal(size=(3, 10)), generator.normal(size=(3, 3)), generator.normal(size=(3, 3))
    centre = np.array([1.3, 0.75, 0.5])
    state = 0.1 * generator.normal(size=(3, 10))
    state[:, :3] += centre
    goal = centre + 0.05 * generator.normal(size=(3, 3))
    return {'observation': state, 'achieved_goal': state[:, :3], 'desired_goal': goal}


def test_an_actor_of_version_0_1_loads_and_acts_as_it_did() -> None:
    assert hashlib.sha256(OLD.read_bytes()).hexdigest() == SHA256
    loaded = load_policy(OLD)
    assert loaded.task == 'FetchReach'
    for actor in (loaded.policy, load_actor(OLD, 'FetchReach')):
        actions, _ = actor.predict(observations(), deterministic=True)
        # Twice what NumPy and torch were seen to differ by (docs/training.md).
        np.testing.assert_allclose(actions, ACTIONS, rtol=0, atol=3e-5)
