"""Deterministic evaluation of a policy on fresh episodes, in the batch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.training.learning.collector import Policy

# Two-sided 95 % quantile of the standard normal distribution.
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class EpisodeOutcomes:
    """What happened in each evaluated episode, arrays (episodes,).

    Attributes:
        seed: Seed of the reset.
        success_gymnasium: Success at the last step, rule of the released code.
        success_paper: Success at the last step, rule of the paper's text.
        touched: Success (rule of the simulation) at any step.
        episode_return: Sum of rewards.
        diverged: MuJoCo lost the episode; it counts as a failure.
    """

    seed: NDArray[np.int64]
    success_gymnasium: NDArray[np.bool_]
    success_paper: NDArray[np.bool_]
    touched: NDArray[np.bool_]
    episode_return: NDArray[np.float64]
    diverged: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.seed)

    def join(self, other: EpisodeOutcomes) -> EpisodeOutcomes:
        """Both, one after the other."""
        names = EpisodeOutcomes.__slots__
        pairs = [(getattr(self, name), getattr(other, name)) for name in names]
        return EpisodeOutcomes(*(np.concatenate(pair) for pair in pairs))

    def first(self, count: int) -> EpisodeOutcomes:
        """The first `count` episodes."""
        return EpisodeOutcomes(*(getattr(self, n)[:count] for n in EpisodeOutcomes.__slots__))


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """95 % interval of a success probability (Wilson 1927)."""
    if episodes < 1:
        raise ValueError(f'{episodes} episodes; allowed: 1 or more')
    rate, square = successes / episodes, _Z95**2
    centre = rate + square / (2 * episodes)
    spread = _Z95 * math.sqrt(rate * (1 - rate) / episodes + square / (4 * episodes**2))
    scale = 1 + square / episodes
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def summarize(outcomes: EpisodeOutcomes) -> dict[str, Any]:
    """Rates and mean return of an evaluation, ready for JSON."""
    episodes = len(outcomes)
    summary: dict[str, Any] = {'episodes': episodes, 'first_seed': int(outcomes.seed[0])}
    for name in ('success_gymnasium', 'success_paper', 'touched'):
        count = int(getattr(outcomes, name).sum())
        summary[name] = count / episodes
        summary[f'{name}_interval_95'] = list(wilson_interval(count, episodes))
    summary['mean_return'] = float(outcomes.episode_return.mean())
    summary['diverged'] = int(outcomes.diverged.sum())
    return summary


def run_episodes(simulation: Simulation, policy: Policy, seeds: list[int]) -> EpisodeOutcomes:
    """Runs one episode per simulation, without noise.

    Args:
        simulation: The simulations; both success rules are applied whatever theirs is.
        policy: The policy.
        seeds: One per simulation; an episode depends on its seed alone.
    """
    observation = simulation.reset(seed=seeds)
    count = simulation.num_envs
    touched, diverged = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    episode_return = np.zeros(count)
    for _ in range(simulation.spec.episode_ticks):
        action, _ = policy.predict(observation, deterministic=True)
        result = simulation.step(action)
        observation = result.observation
        touched |= result.success & ~diverged
        diverged |= result.diverged
        episode_return += result.reward
    goals = observation['achieved_goal'], observation['desired_goal']
    metric = simulation.metric
    return EpisodeOutcomes(
        seed=np.array(seeds),
        success_gymnasium=replace(metric, success_rule='gymnasium').success(*goals) & ~diverged,
        success_paper=replace(metric, success_rule='paper').success(*goals) & ~diverged,
        touched=touched,
        episode_return=episode_return,
        diverged=diverged,
    )


def evaluate(
    simulation: Simulation,
    policy: Policy,
    episodes: int,
    first_seed: int,
    hopeless: Callable[[EpisodeOutcomes], bool] | None = None,
) -> EpisodeOutcomes:
    """Evaluates a policy on episodes with seeds `first_seed`, `first_seed` + 1, ...

    Args:
        simulation: The simulations; the result does not depend on their number.
        policy: The policy.
        episodes: Number of episodes.
        first_seed: Seed of the first.
        hopeless: Asked after each batch; True ends the evaluation early.
    """
    outcomes: EpisodeOutcomes | None = None
    done = 0
    while done < episodes:
        seeds = list(range(first_seed + done, first_seed + done + simulation.num_envs))
        batch = run_episodes(simulation, policy, seeds)
        outcomes = batch if outcomes is None else outcomes.join(batch)
        done = len(outcomes)
        if hopeless is not None and done < episodes and hopeless(outcomes):
            break
    if outcomes is None:
        raise ValueError(f'{episodes} episodes; allowed: 1 or more')
    return outcomes.first(episodes)
