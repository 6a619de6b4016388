"""Compare the values of a critic with the returns of its actor in new episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.training.configuration.config import DEFAULTS, TrainConfig
from policy_node.training.configuration.flat import changed, config_from_dict, to_flat
from policy_node.training.evaluation import FIRST_SEED
from policy_node.training.experience.hindsight import RewardFunction
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.machine import Workers
from policy_node.training.research.registry import (
    make_learner,
    make_sampler,
    make_simulation,
)
from policy_node.training.runs.run_folder import STATE_FILE
from policy_node.training.runs.training_state import load_state, read_state

# Rewards after the episode are taken as the mean of its last ticks.
_LAST_TICKS = 20
# Shares of an episode at which values are compared with returns.
_SHARES = (0.0, 0.25, 0.5)
# Fields with which values are not those of actions; quantiles have a mean.
_OTHER_VALUES = ('algorithm', 'longest_hold', 'advantage', 'subgoal_every', 'condition')


@dataclass(frozen=True, slots=True)
class Comparison:
    """Values and returns from one tick on.

    Attributes:
        tick: The tick.
        value: Value of the actor's action, mean over the episodes.
        episode_return: Discounted training rewards from this tick on, mean over the episodes.
        correlation: Correlation of both over the episodes; NaN if one is constant.
    """

    tick: int
    value: float
    episode_return: float
    correlation: float


def measure(run: Path, episodes: int) -> list[Comparison]:
    """Compare values with returns in new episodes of the collecting actor of a run.

    Raises:
        ValueError: If the folder contains no run, or its values are not those of actions.
    """
    config, progress = _read_config(run / STATE_FILE)
    simulation = make_simulation(config, episodes, 0)
    sampler = make_sampler(config, simulation.metric)
    learner, experience = make_learner(
        config,
        simulation.spec,
        torch.device('cpu'),
        Workers(),
        sampler,
        np.random.default_rng(0),
    )
    load_state(run / STATE_FILE, learner, {**learner.modules(), **experience.statistics})
    values, rewards = _play(simulation, learner, sampler.at(progress).compute_reward)
    returns = discounted(rewards * sampler.reward_scale, config.tick_gamma)
    ticks = [int(share * len(values)) for share in _SHARES]
    return [_compared(tick, values[tick], returns[tick]) for tick in ticks]


def _read_config(file: Path) -> tuple[TrainConfig, float]:
    """Return the configuration of a run and its progress, 0 to 1."""
    state = read_state(file)
    config = config_from_dict(state.extra['config'])
    flat = to_flat(config)
    found = {name: flat[name] for name in _OTHER_VALUES}
    odd = [f'{name} {value}' for name, value in found.items() if value != DEFAULTS[name]]
    if odd:
        raise ValueError(f'{file.parent} has no values of actions: {", ".join(odd)}')
    config = changed(config, replay_transitions=1, learning_starts=0, device='cpu')
    return config, state.counters.env_steps / config.total_steps


def _play(
    simulation: Simulation, learner: ActorCritic, compute_reward: RewardFunction
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return values and rewards (ticks, episodes) of one episode in each simulation."""
    count = simulation.num_envs
    observation = simulation.reset(seed=[FIRST_SEED + index for index in range(count)])
    values, rewards = [], []
    for _ in range(simulation.spec.episode_ticks):
        value, action = _judge(learner, observation['observation'], observation['desired_goal'])
        observation = simulation.step(action).observation
        goals = observation['achieved_goal'], observation['desired_goal']
        values.append(value)
        rewards.append(compute_reward(*goals))
    return np.array(values), np.array(rewards)


@torch.no_grad()
def _judge(
    learner: ActorCritic, observation: NDArray[np.float64], goal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return values (episodes,) and actions (episodes, action size) of the actor."""
    seen, wanted = (learner.tensor(values).float() for values in (observation, goal))
    features = learner.actor.features(seen, wanted)
    action = learner.actor(features)
    value = learner.critic(features, action)
    if value.ndim > 1:
        value = value.mean(dim=0)
    return value.double().numpy(), action.double().numpy()


def discounted(rewards: NDArray[np.float64], gamma: float) -> NDArray[np.float64]:
    """Return returns (ticks, episodes); after the end, rewards stay the mean of the last ticks."""
    following = rewards[-_LAST_TICKS:].mean(axis=0) / (1.0 - gamma)
    returns = np.empty_like(rewards)
    for tick in reversed(range(len(rewards))):
        returns[tick] = following = rewards[tick] + gamma * following
    return returns


def _compared(tick: int, value: NDArray[np.float64], returns: NDArray[np.float64]) -> Comparison:
    varies = value.std() > 0.0 and returns.std() > 0.0
    correlation = float(np.corrcoef(value, returns)[0, 1]) if varies else float('nan')
    return Comparison(tick, float(value.mean()), float(returns.mean()), correlation)
