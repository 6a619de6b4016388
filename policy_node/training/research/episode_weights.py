"""Weights of episodes for `moved_share`: energy, and motion without the landing of a gamble."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import GoalKind, TaskSpec
from policy_node.training.experience.replay import Episodes, Weigh, has_moved
from policy_node.training.research.gamble import without_landings

_GRAVITY = 9.81
# Largest rise of energy per tick that counts (Zhao & Tresp 2018: arm, hand).
_MOST_ENERGY = {GoalKind.POINT: 0.5, GoalKind.FINGERTIPS: 0.5, GoalKind.POSE: 2.5}


def episode_weights(kind: str, spec: TaskSpec, control_hz: float, gamble: bool = False) -> Weigh:
    """Return the function that weights episodes: `moved` (1 or 0) or `energy`.

    Args:
        kind: `moved` or `energy`.
        spec: The task.
        control_hz: Action frequency, Hz.
        gamble: Whether episodes may end in a random landing, which does not count.
    """
    if kind == 'moved' and not gamble:
        return has_moved

    def weigh(episodes: Episodes) -> NDArray[np.float64]:
        own = without_landings(episodes, spec) if gamble else episodes
        if kind == 'energy':
            return episode_energy(own, spec.goal, control_hz)
        return has_moved(own)

    return weigh


def episode_energy(episodes: Episodes, goal: GoalKind, control_hz: float) -> NDArray[np.float64]:
    """Return the energy given to the object or fingertips, joules for unit mass, (episodes,).

    The sum of the rises of potential, kinetic and rotational energy per tick, each clipped: Zhao &
    Tresp 2018, "Energy-Based Hindsight Experience Prioritization" (arXiv 1810.01363).
    """
    achieved = episodes.achieved_goal.astype(np.float64)
    poses = achieved.reshape(*achieved.shape[:2], -1, 7 if goal is GoalKind.POSE else 3)
    velocity = np.diff(poses[..., :3], axis=1) * control_hz
    energy = _GRAVITY * poses[:, 1:, :, 2] + 0.5 * np.square(velocity).sum(axis=-1)
    if goal is GoalKind.POSE:
        before, after = poses[:, :-1, :, 3:], poses[:, 1:, :, 3:]
        # The chord between quaternions, of the nearer sign, keeps the precision of small angles.
        chords = [np.linalg.norm(after - sign * before, axis=-1) for sign in (1.0, -1.0)]
        angle = 4.0 * np.arcsin(np.minimum(np.minimum(*chords) / 2.0, 1.0))
        energy += 0.5 * np.square(angle * control_hz)
    at_rest = _GRAVITY * poses[:, :1, :, 2]
    energy = np.concatenate([at_rest, energy], axis=1).mean(axis=-1)
    rises = np.clip(np.diff(energy, axis=1), 0.0, _MOST_ENERGY[goal])
    return np.asarray(rises.sum(axis=-1))
