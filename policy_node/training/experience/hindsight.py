"""Hindsight experience replay: relabel goals when a batch is drawn; rewards are recomputed.

Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv 1707.01495). The `futureactual`
mixture is from Pitis et al. 2020 (arXiv 2007.02832). A new source of goals is a function in
`SOURCES` and a name in `configuration.config.SOURCES`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from msgs_spec.rotations import quaternion_conjugate, quaternion_multiply
from msgs_spec.tasks import GoalKind
from policy_node.training.experience.replay import Starts

RewardFunction = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
Source = Callable[[Starts, np.random.Generator], Array32]
"""A function that returns goals (batch, goal_size) for transitions."""
_NEAR_TICKS = 10


def goal_mixture(strategy: str, k: int = 4, goals: Mapping[str, float] = {}) -> dict[str, float]:
    """Return the probability of each goal source.

    Args:
        strategy: `none`, `final`, `future`, `episode`, `random`: k relabelled goals for each real
            one. `futureactual`: k/2 future goals, k/2 desired goals of other episodes, 1 real goal.
        goals: Mixture instead of the strategy; the rest up to 1 keeps the goals of episodes.
    """
    share = k / (k + 1)
    if goals:
        left = 1.0 - sum(goals.values())
        return {**goals, 'real': goals.get('real', 0.0) + left} if left > 1e-9 else dict(goals)
    if strategy == 'none':
        return {'real': 1.0}
    if strategy == 'futureactual':
        return {'future': share / 2, 'actual': share / 2, 'real': 1.0 - share}
    return {strategy: share, 'real': 1.0 - share}


def draw_sources(
    mixture: dict[str, float], count: int, generator: np.random.Generator
) -> NDArray[np.intp]:
    """Draw goal sources: indices (count,) into the names of the mixture."""
    bounds = np.cumsum(list(mixture.values()))
    return np.searchsorted(bounds / bounds[-1], generator.random(count), side='right')


def goals_of(
    starts: Starts,
    source: NDArray[np.intp],
    names: Sequence[str],
    generator: np.random.Generator,
    sources: Mapping[str, Source] | None = None,
) -> Array32:
    """Return goals (batch, goal_size), each from the source `names[source]`.

    Args:
        starts: Where the transitions begin.
        source: Index of the source of each goal, (batch,).
        names: Names of the sources; `real` keeps the goal of the episode.
        sources: Functions by name, by default `SOURCES`.
    """
    sources = SOURCES if sources is None else sources
    goal = starts.episodes.desired_goal.take(starts.row, axis=0)
    for index, name in enumerate(names):
        chosen = np.flatnonzero(source == index)
        if name != 'real' and len(chosen):
            goal[chosen] = sources[name](starts.select(chosen), generator)
    return goal


def _future(starts: Starts, generator: np.random.Generator) -> Array32:
    """Achieved later in the episode. This includes the state that the transition leads to."""
    return _achieved(starts, generator.integers(starts.tick + 1, starts.last + 1))


def _final(starts: Starts, generator: np.random.Generator) -> Array32:
    """Achieved at the end of the episode."""
    del generator
    return _achieved(starts, starts.last)


def _episode(starts: Starts, generator: np.random.Generator) -> Array32:
    """Achieved at any time in the episode."""
    return _achieved(starts, generator.integers(1, starts.last + 1))


def _random(starts: Starts, generator: np.random.Generator) -> Array32:
    """Achieved at any time in any episode."""
    row = generator.integers(len(starts.episodes), size=len(starts.row))
    return _episode(replace(starts, row=row), generator)


def _actual(starts: Starts, generator: np.random.Generator) -> Array32:
    """Desired goals of any episodes."""
    row = generator.integers(len(starts.episodes), size=len(starts.row))
    return starts.episodes.desired_goal.take(row, axis=0)


def _displaced(starts: Starts, generator: np.random.Generator) -> Array32:
    """Goals near the achieved ones that do not depend on where the transitions lead.

    If a goal is chosen because a step led there, the critic learns that such steps lead there; with
    contacts this is partly luck. Here the achieved goal moves by the distance of another one within
    ten ticks of its episode.
    """
    episodes, count = starts.episodes, len(starts.row)
    row = generator.integers(len(episodes), size=count)
    last = replace(starts, row=row).last
    span = generator.integers(1, min(_NEAR_TICKS, episodes.ticks) + 1, size=count)
    span = np.minimum(span, last)
    tick = generator.integers(last + 1 - span)
    achieved = episodes.achieved_goal
    here = achieved[starts.row, starts.tick]
    return displace(here, achieved[row, tick], achieved[row, tick + span])


SOURCES: dict[str, Source] = {
    'future': _future,
    'final': _final,
    'episode': _episode,
    'random': _random,
    'actual': _actual,
    'displaced': _displaced,
}


def displace(here: Array32, before: Array32, after: Array32) -> Array32:
    """Return goals (batch, goal_size): `here` moved, and turned, as `before` moved to `after`."""
    moved: Array32 = here + (after - before)
    if moved.shape[-1] == GoalKind.POSE.size:
        turn = quaternion_multiply(after[:, 3:], quaternion_conjugate(before[:, 3:]))
        moved[:, 3:] = quaternion_multiply(turn, here[:, 3:])
    return moved


def _achieved(starts: Starts, state: NDArray[np.int64]) -> Array32:
    """Return the goals (batch, goal_size) achieved in these states of the episodes."""
    achieved = flat(starts.episodes.achieved_goal)
    return achieved.take(starts.row * (starts.episodes.ticks + 1) + state, axis=0)


def flat(values: Array32) -> Array32:
    """Return the rows of all episodes, one after the other."""
    return values.reshape(-1, values.shape[-1])
