"""Which episodes of a replay are worth drawing, and up to which tick."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.tasks.hand_manipulate import PALM_HEIGHT
from msgs_spec.tasks import GoalKind, TaskSpec
from policy_node.training.experience.gamble import without_landings
from policy_node.training.experience.replay import Episodes, has_moved

_GRAVITY = 9.81
# Most that one tick may add to the energy of an episode (Zhao & Tresp 2018: arm, hand).
_MOST_ENERGY = {GoalKind.POINT: 0.5, GoalKind.FINGERTIPS: 0.5, GoalKind.POSE: 2.5}

Weights = Callable[[Episodes], NDArray[np.float64]]
LastTicks = Callable[[Episodes], NDArray[np.int64]]


def episode_weights(kind: str, spec: TaskSpec, control_hz: float, gamble: bool = False) -> Weights:
    """Returns what weighs episodes: 1 or 0 for `moved`, the energy of the goal for `energy`.

    Args:
        kind: One of the two.
        spec: The task.
        control_hz: Action frequency.
        gamble: Whether episodes may end in a random landing, which counts as no motion.
    """

    def weigh(episodes: Episodes) -> NDArray[np.float64]:
        own = without_landings(episodes, spec) if gamble else episodes
        if kind == 'energy':
            return episode_energy(own, spec.goal, control_hz)
        return has_moved(own).astype(np.float64)

    return weigh


def episode_energy(episodes: Episodes, goal: GoalKind, control_hz: float) -> NDArray[np.float64]:
    """Energy given to what the goal is about, joules for unit mass and inertia, (episodes,).

    The rises of potential, kinetic and rotational energy from tick to tick, from rest on, each
    clipped, summed: Zhao & Tresp 2018, "Energy-Based Hindsight Experience Prioritization" (arXiv
    1810.01363).
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


def ticks_until_dropped(spec: TaskSpec, more: int) -> LastTicks | None:
    """Returns what counts the ticks of an episode until `more` ticks after its object fell.

    An object has fallen once its centre is below the palm; in the last `more` ticks that says
    nothing. None where there is nothing to drop, or
    `more` is negative: every tick counts.
    """
    if spec.goal is not GoalKind.POSE or more < 0:
        return None

    def count(episodes: Episodes) -> NDArray[np.int64]:
        fallen = episodes.achieved_goal[:, 1:, 2] < PALM_HEIGHT
        first = np.where(fallen.any(axis=1), fallen.argmax(axis=1) + 1, episodes.ticks)
        return np.asarray(np.minimum(first + more, episodes.ticks))

    return count
