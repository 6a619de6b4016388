"""Hindsight experience replay: replace goals in a batch, for example by ones achieved later.

Goals are replaced when a batch is drawn, and rewards are computed for the new goals.
Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv 1707.01495). The `futureactual`
mixture is from Pitis et al. 2020 (arXiv 2007.02832).

A new source of goals needs a function in `SOURCES` and its name in `configuration.config.SOURCES`.
To make it a strategy, also add its name to the field `strategy` there.
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
    """Return the probability of each goal source; they add up to 1.

    Args:
        strategy: `final`, `future`, `episode` and `random` relabel k goals for each goal kept.
            `futureactual` draws k/2 future goals and k/2 desired goals of random episodes for each
            goal kept. `none` keeps all goals.
        k: Number of relabelled goals for each goal kept.
        goals: Probability of each source; replaces `strategy` and `k` unless empty. If they add
            up to less than 1, the rest goes to `real`, which keeps the goal of the episode.
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
    """Return a random goal source for each of `count` transitions, as index of a key of `mixture`.

    `mixture` maps each source to its probability.
    """
    bounds = np.cumsum(list(mixture.values()))
    return np.searchsorted(bounds / bounds[-1], generator.random(count), side='right')


def goals_of(
    starts: Starts,
    source: NDArray[np.intp],
    names: Sequence[str],
    generator: np.random.Generator,
    sources: Mapping[str, Source] | None = None,
) -> Array32:
    """Return a goal for each transition, (batch, goal_size), from the source drawn for it.

    Args:
        starts: The first states of the transitions.
        source: Index into `names` for each transition, (batch,).
        names: Names of the sources; `real` keeps the goal of the episode.
        sources: Function of each source by name, `SOURCES` if None.
    """
    sources = SOURCES if sources is None else sources
    goal = starts.episodes.desired_goal.take(starts.row, axis=0)
    for index, name in enumerate(names):
        chosen = np.flatnonzero(source == index)
        if name != 'real' and len(chosen):
            goal[chosen] = sources[name](starts.select(chosen), generator)
    return goal


def _future(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return goals achieved at a random state from the end of the transition to `starts.last`."""
    return _achieved(starts, generator.integers(starts.tick + 1, starts.last + 1))


def _final(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return the goals achieved at `starts.last`, the last valid state of each episode."""
    del generator
    return _achieved(starts, starts.last)


def _episode(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return goals achieved at a random state of the same episode, from tick 1 to `starts.last`."""
    return _achieved(starts, generator.integers(1, starts.last + 1))


def _random(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return goals achieved in random episodes, at a tick from 1 to the last valid state."""
    row = generator.integers(len(starts.episodes), size=len(starts.row))
    return _episode(replace(starts, row=row), generator)


def _actual(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return the desired goals of random episodes, one for each transition."""
    row = generator.integers(len(starts.episodes), size=len(starts.row))
    return starts.episodes.desired_goal.take(row, axis=0)


def _displaced(starts: Starts, generator: np.random.Generator) -> Array32:
    """Return goals near the goal achieved at the start of each transition.

    The displacement is a motion between two states of a random episode, at most ten ticks apart.
    It is independent of the transition. `future` goals depend on the outcome of the transition and
    lead to overestimated values where contacts make this outcome random.
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
    """Move the goals `here` by the motion from `before` to `after`; all are (batch, goal_size).

    Poses are also turned by the rotation from `before` to `after`.
    """
    moved: Array32 = here + (after - before)
    if moved.shape[-1] == GoalKind.POSE.size:
        turn = quaternion_multiply(after[:, 3:], quaternion_conjugate(before[:, 3:]))
        moved[:, 3:] = quaternion_multiply(turn, here[:, 3:])
    return moved


def _achieved(starts: Starts, state: NDArray[np.int64]) -> Array32:
    """Return the goals achieved at ticks `state`, (batch,), of each transition's own episode."""
    achieved = flat(starts.episodes.achieved_goal)
    return achieved.take(starts.row * (starts.episodes.ticks + 1) + state, axis=0)


def flat(values: Array32) -> Array32:
    """Reshape (episodes, ticks, size) to (episodes * ticks, size), to index it with `take`."""
    return values.reshape(-1, values.shape[-1])
