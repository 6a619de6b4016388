"""Hindsight experience replay: goals are exchanged when a batch is drawn, rewards recomputed.

Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv 1707.01495); the futureactual
mixture is from Pitis et al. 2020 (arXiv 2007.02832).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from policy_node.training.learning.replay import Array, Episodes

RewardFunction = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

# Where the goal of a transition comes from: the episode's own; a later achieved goal of the
# episode; its last; any of it; any achieved goal of the replay; a desired goal of any episode.
SOURCES = ('real', 'future', 'final', 'episode', 'random', 'actual')


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch for one update, float32.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size).
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`.
    """

    observation: Array
    next_observation: Array
    goal: Array
    action: Array
    reward: Array


def goal_mixture(strategy: str, k: int = 4) -> dict[str, float]:
    """Returns the probability of each goal source.

    Args:
        strategy: `none`, `final`, `future`, `episode`, `random`: k relabelled to 1 real goal;
            `futureactual`: k/2 future, k/2 desired goals of other episodes, 1 real.
        k: Relabelled goals for each real one.
    """
    if strategy == 'none':
        return {'real': 1.0}
    share = k / (k + 1)
    if strategy == 'futureactual':
        return {'future': share / 2, 'actual': share / 2, 'real': 1.0 - share}
    if strategy not in SOURCES[1:-1]:
        raise ValueError(f'strategy {strategy!r}; allowed: none, futureactual, {SOURCES[1:-1]}')
    return {strategy: share, 'real': 1.0 - share}


def sample_transitions(
    episodes: Episodes,
    row: NDArray[np.int64],
    mixture: dict[str, float],
    compute_reward: RewardFunction,
    generator: np.random.Generator,
) -> Transitions:
    """Draws a transition of each chosen episode and relabels its goal.

    Args:
        episodes: Episodes to draw from.
        row: Episode of each transition, (batch,).
        mixture: Probability of each goal source; adds up to 1.
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        generator: Source of all randomness.
    """
    ticks = episodes.ticks
    tick = generator.integers(ticks, size=len(row))
    goal = relabel(episodes, row, tick, mixture, generator)
    state = row * (ticks + 1) + tick
    observation = _flat(episodes.observation)
    achieved = _flat(episodes.achieved_goal).take(state + 1, axis=0)
    reward = compute_reward(achieved.astype(np.float64), goal.astype(np.float64))
    return Transitions(
        observation=observation.take(state, axis=0),
        next_observation=observation.take(state + 1, axis=0),
        goal=goal,
        action=_flat(episodes.action).take(row * ticks + tick, axis=0),
        reward=np.asarray(reward, dtype=np.float32),
    )


def relabel(
    episodes: Episodes,
    row: NDArray[np.int64],
    tick: NDArray[np.int64],
    mixture: dict[str, float],
    generator: np.random.Generator,
) -> Array:
    """Returns goals (batch, goal_size) for transitions `tick` of episodes `row`.

    A transition leads from state `tick` to state `tick + 1`; `future` takes any state from
    `tick + 1` to the last, so the goal may be what this very step achieved.
    """
    goal = episodes.desired_goal.take(row, axis=0)
    bounds = np.cumsum(list(mixture.values()))
    choice = np.searchsorted(bounds / bounds[-1], generator.random(len(row)), side='right')
    for index, source in enumerate(mixture):
        chosen = np.flatnonzero(choice == index)
        if source != 'real' and len(chosen):
            goal[chosen] = _goals(episodes, source, row[chosen], tick[chosen], generator)
    return goal


def _goals(
    episodes: Episodes,
    source: str,
    row: NDArray[np.int64],
    tick: NDArray[np.int64],
    generator: np.random.Generator,
) -> Array:
    ticks = episodes.ticks
    if source == 'actual':
        other = generator.integers(len(episodes), size=len(row))
        return episodes.desired_goal.take(other, axis=0)
    if source == 'future':
        state = generator.integers(tick + 1, ticks + 1)
    elif source == 'final':
        state = np.full(len(row), ticks)
    else:
        state = generator.integers(1, ticks + 1, size=len(row))
        if source == 'random':
            row = generator.integers(len(episodes), size=len(row))
    return _flat(episodes.achieved_goal).take(row * (ticks + 1) + state, axis=0)


def _flat(values: Array) -> Array:
    return values.reshape(-1, values.shape[-1])
