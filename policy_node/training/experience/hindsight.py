"""Hindsight experience replay: goals are exchanged when a batch is drawn, rewards recomputed.

Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv 1707.01495); the futureactual
mixture is from Pitis et al. 2020 (arXiv 2007.02832).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from msgs_spec.rotations import quaternion_conjugate, quaternion_multiply
from msgs_spec.tasks import GoalKind
from policy_node.training.configuration.config import STRATEGIES
from policy_node.training.experience.subgoals import subgoals_of
from policy_node.training.experience.transitions import Starts

RewardFunction = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

OUTCOME = 'outcome'
_NEAR_TICKS = 10
# One more, where there is a high level: what it had the actor pursue.
_SUBGOAL = 'subgoal'


def goal_mixture(strategy: str, k: int = 4) -> dict[str, float]:
    """Returns the probability of each goal source.

    Args:
        strategy: `none`, `final`, `future`, `episode`, `random`: k relabelled to 1 real goal;
            `futureactual`: k/2 future, k/2 desired goals of other episodes, 1 real.
        k: Relabelled goals for each real one.

    Raises:
        ValueError: If the strategy is unknown.
    """
    if strategy == 'none':
        return {'real': 1.0}
    share = k / (k + 1)
    if strategy == 'futureactual':
        return {'future': share / 2, 'actual': share / 2, 'real': 1.0 - share}
    if strategy not in STRATEGIES:
        allowed = ', '.join(('none', 'futureactual', *STRATEGIES))
        raise ValueError(f'strategy {strategy!r}; allowed: {allowed}')
    return {strategy: share, 'real': 1.0 - share}


def complete_mixture(goals: dict[str, float]) -> dict[str, float]:
    """Return the mixture with the rest up to 1 for the goals of episodes; empty stays empty."""
    left = 1.0 - sum(goals.values())
    if not goals or left <= 1e-9:
        return dict(goals)
    return {**goals, 'real': goals.get('real', 0.0) + left}


def with_subgoals(mixture: dict[str, float]) -> dict[str, float]:
    """The mixture with half of the goals that are not exchanged replaced by subgoals.

    HAC would replace all, but its lowest level is never given the goal itself.
    """
    kept = mixture.get('real', 0.0) / 2
    return mixture if kept == 0.0 else {**mixture, 'real': kept, _SUBGOAL: kept}


def draw_sources(
    mixture: dict[str, float], count: int, generator: np.random.Generator
) -> NDArray[np.intp]:
    """Draws where goals come from: indices (count,) into the names of the mixture."""
    bounds = np.cumsum(list(mixture.values()))
    return np.searchsorted(bounds / bounds[-1], generator.random(count), side='right')


def goals_of(
    starts: Starts,
    source: NDArray[np.intp],
    names: Sequence[str],
    generator: np.random.Generator,
) -> Array32:
    """Returns goals (batch, goal_size), each from the source `names[source]`.

    A transition leads from state `tick` to state `tick + 1`; `future` takes any state from
    `tick + 1` to the last, so the goal may be what this very step achieved.
    """
    goal = starts.episodes.desired_goal.take(starts.row, axis=0)
    for index, name in enumerate(names):
        chosen = np.flatnonzero(source == index)
        if name != 'real' and len(chosen):
            goal[chosen] = _goals(starts.select(chosen), name, generator)
    return goal


def _goals(starts: Starts, source: str, generator: np.random.Generator) -> Array32:
    episodes, count = starts.episodes, len(starts.row)
    if source == 'actual':
        return episodes.desired_goal.take(generator.integers(len(episodes), size=count), axis=0)
    if source == _SUBGOAL:
        return subgoals_of(starts)
    if source == 'displaced':
        return _displaced(starts, generator)
    if source == 'random':
        starts = replace(starts, row=generator.integers(len(episodes), size=count))
    tick, last = starts.tick, starts.last
    if source == 'future':
        state = generator.integers(tick + 1, last + 1)
    elif source == 'near':
        state = generator.integers(tick + 1, np.minimum(tick + _NEAR_TICKS, last) + 1)
    elif source == 'next':
        state = tick + 1
    elif source == 'final':
        state = last
    else:
        state = generator.integers(1, last + 1)
    achieved = flat(episodes.achieved_goal)
    return achieved.take(starts.row * (episodes.ticks + 1) + state, axis=0)


def _displaced(starts: Starts, generator: np.random.Generator) -> Array32:
    """Goals near the achieved ones, which know nothing of where the transitions lead.

    A goal that is chosen because a step led there tells the critic that such steps lead there;
    where contacts decide, that is half luck. Here the state's achieved goal moves as far as any
    other did within ten ticks of its episode.
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


def displace(here: Array32, before: Array32, after: Array32) -> Array32:
    """Goals (batch, goal_size) as far from `here` as `after` is from `before`, poses turned too."""
    moved: Array32 = here + (after - before)
    if moved.shape[-1] == GoalKind.POSE.size:
        turn = quaternion_multiply(after[:, 3:], quaternion_conjugate(before[:, 3:]))
        moved[:, 3:] = quaternion_multiply(turn, here[:, 3:])
    return moved


def flat(values: Array32) -> Array32:
    """Rows of all episodes, one after the other."""
    return values.reshape(-1, values.shape[-1])
