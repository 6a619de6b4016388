"""Choose the parts of a run: those of the core, or what a study puts in their place.

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
from policy_node.training.configuration import groups
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.collector import Collector
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.replay import Weigh, has_moved
from policy_node.training.experience.sampling import TransitionSampler, sampler_fields
from policy_node.training.learners import actor_critic
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.learners.ddpg import DDPG, Parts, TargetNetworks
from policy_node.training.learners.imagined import ImaginingDDPG
from policy_node.training.machine import Workers
from policy_node.training.research.conditions import (
    ConditionedDDPG,
    ConditionedSampler,
    acting_input,
    make_condition,
    without_input,
)
from policy_node.training.research.critics import (
    AdvantageDDPG,
    Ensemble,
    NoTargets,
    count_critics,
    critic_loss,
    critic_tensors,
    is_ensemble,
)
from policy_node.training.research.density_ratio import WeightedDDPG
from policy_node.training.research.frequent_actions import (
    HoldingCollector,
    HoldingDDPG,
    HoldingSampler,
    PerturbingCollector,
    plain_actor,
)
from policy_node.training.research.gamble import GambleSimulation, without_landings
from policy_node.training.research.hierarchy import (
    LOW_SOURCES,
    GuidedCollector,
    HierarchicalDDPG,
    HierarchicalExperience,
    subgoal_columns,
)
from policy_node.training.research.judged import (
    ChoosingSampler,
    CuttingSampler,
    Judge,
    JudgedExperience,
    JudgedSampler,
    LambdaSampler,
)
from policy_node.training.research.ppo import PPO
from policy_node.training.research.rollouts import OnPolicyExperience, RolloutSampler

__all__ = [
    'Ensemble',
    'acting_input',
    'count_critics',
    'critic_tensors',
    'is_ensemble',
    'make_collector',
    'make_ddpg',
    'make_learner',
    'make_sampler',
    'make_simulation',
    'network_shape',
    'plain_actor',
    'without_input',
]

# Learners that take the place of `DDPG`, by the option that selects them.
_LEARNERS: dict[type, type[DDPG]] = {
    groups.Hierarchical: HierarchicalDDPG,
    groups.Threshold: ConditionedDDPG,
    groups.Horizon: ConditionedDDPG,
    groups.Held: HoldingDDPG,
    groups.Advantages: AdvantageDDPG,
    groups.Density: WeightedDDPG,
    groups.Imagined: ImaginingDDPG,
}


def make_simulation(config: TrainConfig, num_envs: int, num_threads: int) -> Simulation:
    """Return `num_envs` simulations of the task."""
    options: dict[str, Any] = {
        'num_envs': num_envs,
        'num_threads': num_threads,
        'reward_type': 'dense' if config.find(groups.Dense) else 'sparse',
        'success_rule': config.collect.success_rule,
        'control_hz': config.collect.control_hz,
        'disturbances': config.collect.disturbances,
    }
    return (GambleSimulation if config.collect.gamble else Simulation)(config.task, **options)


def make_collector(simulation: Simulation, seeds: list[int], config: TrainConfig) -> Collector:
    """Return the collector; arguments as `Collector`."""
    if held := config.find(groups.Held):
        return HoldingCollector(simulation, seeds, config, held.longest_hold)
    if guided := config.find(groups.Hierarchical):
        return GuidedCollector(simulation, seeds, config, guided.subgoal_every)
    noisy_weights = config.learner.exploration.parameter_noise
    return (PerturbingCollector if noisy_weights else Collector)(simulation, seeds, config)


def make_sampler(config: TrainConfig, metric: GoalMetric) -> TransitionSampler:
    """Return what makes transitions.

    Raises:
        ValueError: If the configuration replaces the own reward of a third-party task.
    """
    fields = sampler_fields(config, metric)
    if held := config.find(groups.Held):
        return HoldingSampler(**fields | {'most_steps': held.longest_hold})
    if chosen := config.find(groups.Chosen):
        return ChoosingSampler(**fields, choice=chosen.goal_choice)
    if config.find(groups.Threshold) or config.find(groups.Horizon):
        return ConditionedSampler(**fields, condition=make_condition(config, metric))
    returns = config.find(groups.Returns)
    if returns and returns.correction == 'lambda':
        return LambdaSampler(**fields, trace=returns.trace)
    if returns and returns.correction == 'cut':
        return CuttingSampler(**fields)
    if config.find(groups.Hierarchical):
        return TransitionSampler(**fields, sources=LOW_SOURCES)
    if config.find(groups.Ppo):
        return RolloutSampler(**fields, metric=metric)
    return TransitionSampler(**fields)


def make_learner(
    config: TrainConfig,
    spec: TaskSpec,
    device: torch.device,
    workers: Workers,
    sampler: TransitionSampler,
    generator: np.random.Generator,
) -> tuple[ActorCritic, Experience]:
    """Return the learner and its experience."""
    common = config, spec, workers, sampler, generator
    weigh = _weights_of(config, spec)
    if config.find(groups.Ppo):
        ppo = PPO(network_shape(config), config, device, workers)
        return ppo, OnPolicyExperience(*common, ppo, weigh)
    learner = make_ddpg(network_shape(config), config, device, workers)
    if config.find(groups.Hierarchical):
        columns = subgoal_columns(spec.goal.size)
        return learner, HierarchicalExperience(*common, columns, weigh)
    if isinstance(sampler, JudgedSampler):
        judged = JudgedExperience(*common, weigh=weigh)
        judged.judge = Judge(learner)
        return learner, judged
    return learner, Experience(*common, _extra_actions(config), weigh)


def make_ddpg(
    shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
) -> DDPG:
    """Return `DDPG` or the learner that takes its place; arguments as `DDPG`."""
    options = config.learner
    assert isinstance(options, groups.OffPolicy)
    kinds = (kind for option, kind in _LEARNERS.items() if config.find(option))
    targets = NoTargets if options.target == 'none' else TargetNetworks
    parts = Parts(critic_loss(options.critic), targets)
    return next(kinds, DDPG)(shape, config, device, workers, parts)


def network_shape(config: TrainConfig) -> NetworkShape:
    """Return the shape of actor and critic."""
    return actor_critic.network_shape(config, _extra_actions(config))


def _extra_actions(config: TrainConfig) -> int:
    """Return the number of outputs of the actor beside the action: the length of an action."""
    return int(config.find(groups.Held) is not None)


def _weights_of(config: TrainConfig, spec: TaskSpec) -> Weigh:
    """Return the function that finds episodes with a motion, the landing of a gamble left out."""
    if not config.collect.gamble:
        return has_moved
    return lambda episodes: has_moved(without_landings(episodes, spec))
