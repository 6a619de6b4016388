"""Compare the values of a critic with the returns of its actor in new episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from policy_node.training.configuration.config import changed_fields
from policy_node.training.configuration.flat import changed, config_from_dict
from policy_node.training.evaluation import FIRST_SEED
from policy_node.training.experience.collector import Collector
from policy_node.training.experience.replay import Episodes
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.research.registry import make_sampler
from policy_node.training.runs.run_folder import STATE_FILE, RunFolder
from policy_node.training.runs.trainer import Trainer
from policy_node.training.runs.training_state import load_state, read_state

# Rewards after the episode are taken as the mean of its last ticks.
_LAST_TICKS = 20
# Shares of an episode at which values are compared with returns.
_SHARES = (0.0, 0.25, 0.5)
# Fields with which values are not those of actions; quantiles have a mean.
_OTHER_VALUES = ('algorithm', 'longest_hold', 'advantage', 'subgoal_every', 'condition')


@dataclass(frozen=True, slots=True)
class Comparison:
    """The critic's values and the returns at one tick, as means over episodes.

    Attributes:
        tick: Tick of the episodes at which values and returns are taken.
        value: Value of the actor's action.
        episode_return: Discounted training rewards from this tick on.
        correlation: Correlation of values and returns over episodes; NaN if either is constant.
    """

    tick: int
    value: float
    episode_return: float
    correlation: float


def measure(run: Path, episodes: int) -> list[Comparison]:
    """Compare a critic's values with the returns of its actor in new episodes without noise.

    `run` is the folder of the training run. The actor is the trained one, not its running average.
    The result has comparisons at 0, 25 and 50 % of the ticks of an episode.

    Raises:
        ValueError: If the folder contains no run, or its critic returns no action values.
    """
    state = read_state(run / STATE_FILE)
    config = config_from_dict(state.extra['config'])
    if odd := changed_fields(config, _OTHER_VALUES):
        raise ValueError(f'{run} has no values of actions: {", ".join(odd)}')
    few = {'num_envs': episodes, 'evaluation_episodes': 1, 'replay_transitions': 1}
    config = changed(config, **few, learning_starts=0, device='cpu')
    trainer = Trainer(RunFolder(run, config))
    load_state(run / STATE_FILE, trainer.learner, trainer.modules())
    sampler = make_sampler(config, trainer.simulation.metric)
    progress = state.counters.env_steps / config.total_steps
    compute_reward = sampler.at(progress).compute_reward
    played = _play(trainer)
    achieved, goal = (
        each.astype(np.float64) for each in (played.achieved_goal, played.desired_goal)
    )
    rewards = np.array(
        [compute_reward(achieved[:, tick + 1], goal) for tick in range(played.ticks)]
    )
    returns = discounted(rewards * sampler.reward_scale, config.tick_gamma)
    ticks = [int(share * played.ticks) for share in _SHARES]
    values = {tick: _values(trainer.learner, played, tick) for tick in ticks}
    return [_compared(tick, values[tick], returns[tick]) for tick in ticks]


def _play(trainer: Trainer) -> Episodes:
    """Run an episode without noise in each simulation; return those that did not diverge."""
    simulation = trainer.simulation
    seeds = [FIRST_SEED + index for index in range(simulation.num_envs)]
    collector = Collector(simulation, seeds, trainer.config)
    collector.exploration = 0.0
    return collector.collect(trainer.learner.acting_policy())[0]


@torch.no_grad()
def _values(learner: ActorCritic, episodes: Episodes, tick: int) -> NDArray[np.float64]:
    """Return the critic's values (episodes,) of the actor's actions at a tick."""
    seen = episodes.observation[:, tick], episodes.desired_goal
    features = learner.actor.features(*(learner.tensor(each) for each in seen))
    value = learner.critic(features, learner.actor(features))
    return np.asarray((value if value.ndim == 1 else value.mean(dim=0)).double().numpy())


def discounted(rewards: NDArray[np.float64], gamma: float) -> NDArray[np.float64]:
    """Return the discounted returns (ticks, episodes) from each tick on.

    Rewards after the end of an episode are assumed to equal the mean of its last 20 rewards.
    """
    following = rewards[-_LAST_TICKS:].mean(axis=0) / (1.0 - gamma)
    returns = np.empty_like(rewards)
    for tick in reversed(range(len(rewards))):
        returns[tick] = following = rewards[tick] + gamma * following
    return returns


def _compared(tick: int, value: NDArray[np.float64], returns: NDArray[np.float64]) -> Comparison:
    varies = value.std() > 0.0 and returns.std() > 0.0
    correlation = float(np.corrcoef(value, returns)[0, 1]) if varies else float('nan')
    return Comparison(tick, float(value.mean()), float(returns.mean()), correlation)
