"""Select the simulation, collector, sampler and learner of a run by its configuration.

This is the only module of the folder that other folders import.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import TaskSpec
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import DEFAULTS, TrainConfig
from policy_node.training.experience.collector import Collector
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.replay import Weigh, has_moved
from policy_node.training.experience.sampling import TransitionSampler, sampler_fields
from policy_node.training.learners.actor_critic import ActorCritic, extra_actions, network_shape
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.learners.imagined import ImaginingDDPG
from policy_node.training.machine import Workers
from policy_node.training.research import (
    conditions,
    critics,
    density_ratio,
    frequent_actions,
    gamble,
    hierarchy,
    judged,
    rollouts,
)
from policy_node.training.research.conditions import acting_input, without_input
from policy_node.training.research.critics import as_one, members_of
from policy_node.training.research.ppo import PPO

__all__ = [
    'acting_input',
    'as_one',
    'make_collector',
    'make_ddpg',
    'make_learner',
    'make_sampler',
    'make_simulation',
    'members_of',
    'without_input',
]

# Learners that take the place of `DDPG`, by the field that selects them.
_LEARNERS: dict[str, type[DDPG]] = {
    'subgoal_every': hierarchy.HierarchicalDDPG,
    'condition': conditions.ConditionedDDPG,
    'longest_hold': frequent_actions.HoldingDDPG,
    'advantage': critics.AdvantageDDPG,
    'importance': density_ratio.WeightedDDPG,
    'subgoal_prior': ImaginingDDPG,
}


def make_simulation(config: TrainConfig, num_envs: int, num_threads: int) -> Simulation:
    """Return `num_envs` simulations of the task, with the options that the configuration sets."""
    options: dict[str, Any] = {
        'num_envs': num_envs,
        'num_threads': num_threads,
        'reward_type': config.reward_type,
        'success_rule': config.success_rule,
        'control_hz': config.control_hz,
        'disturbances': config.disturbances,
    }
    return (gamble.GambleSimulation if config.gamble else Simulation)(config.task, **options)


def make_collector(simulation: Simulation, seeds: list[int], config: TrainConfig) -> Collector:
    """Return the collector that the configuration selects; `seeds` has one per simulation."""
    if config.longest_hold > 1:
        return frequent_actions.HoldingCollector(simulation, seeds, config)
    if config.subgoal_every:
        return hierarchy.GuidedCollector(simulation, seeds, config)
    kind = frequent_actions.PerturbingCollector if config.parameter_noise else Collector
    return kind(simulation, seeds, config)


def make_sampler(
    config: TrainConfig, metric: GoalMetric, judge: DDPG | None = None
) -> TransitionSampler:
    """Return the sampler of transitions that the configuration selects.

    `judge` is the learner that `ChoosingSampler` and `CuttingSampler` need. Without it,
    `TransitionSampler` takes their place.

    Raises:
        ValueError: If the configuration would replace the reward that a third-party task defines.
    """
    fields = sampler_fields(config, metric)
    if config.longest_hold > 1:
        return frequent_actions.HoldingSampler(**fields | {'most_steps': config.longest_hold})
    if judge is not None and config.goal_choice != 'uniform':
        return judged.ChoosingSampler(**fields, choice=config.goal_choice, judge=judge)
    if config.condition == 'horizon':
        return conditions.HorizonSampler(**fields, ticks=metric.spec.episode_ticks)
    if config.condition == 'threshold':
        widest = config.widest_threshold
        return conditions.ThresholdSampler(**fields, metric=metric, widest=widest)
    if config.correction == 'lambda':
        return judged.LambdaSampler(**fields, trace=config.trace)
    if judge is not None and config.correction == 'cut':
        return judged.CuttingSampler(**fields, actor=judge.actor)
    if config.subgoal_every:
        return TransitionSampler(**fields, sources=hierarchy.LOW_SOURCES)
    return TransitionSampler(**fields)


def make_learner(
    config: TrainConfig,
    metric: GoalMetric,
    device: torch.device,
    workers: Workers,
    generator: np.random.Generator,
) -> tuple[ActorCritic, Experience]:
    """Return the learner that the configuration selects, and the `Experience` of its batches.

    Raises:
        ValueError: If the configuration would replace the reward that a third-party task defines.
    """
    spec = metric.spec
    common = config, spec, workers, make_sampler(config, metric), generator
    weigh = _weights_of(config, spec)
    if config.algorithm == 'ppo':
        ppo = PPO(network_shape(config), config, device, workers)
        return ppo, rollouts.OnPolicyExperience(*common, ppo, metric, weigh)
    learner = make_ddpg(network_shape(config), config, device, workers)
    if config.subgoal_every:
        # The subgoal, and whether it is tested.
        return learner, hierarchy.HierarchicalExperience(*common, spec.goal.size + 1, weigh)
    experience = Experience(*common, extra_actions(config), weigh)
    experience.batch_sampler = make_sampler(config, metric, learner)
    return learner, experience


def make_ddpg(
    shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
) -> DDPG:
    """Return the learner that the configuration selects, `DDPG` or a variant of it."""
    kinds = (kind for name, kind in _LEARNERS.items() if getattr(config, name) != DEFAULTS[name])
    return next(kinds, DDPG)(shape, config, device, workers, critics.critic_loss(config))


def _weights_of(config: TrainConfig, spec: TaskSpec) -> Weigh:
    """Return a function that gives each episode the weight 1 if its achieved goal moved, else 0.

    With `config.gamble`, the jump to a landing does not count as a motion.
    """
    if not config.gamble:
        return has_moved
    return lambda episodes: has_moved(gamble.without_landings(episodes, spec))
