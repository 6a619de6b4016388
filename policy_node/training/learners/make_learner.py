"""Which learner a configuration asks for, and the experience that it learns from."""

from __future__ import annotations

import numpy as np
import torch

from msgs_spec.tasks import TaskSpec
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Hierarchical, Imagined, Ppo
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight_actions import HierarchicalExperience
from policy_node.training.experience.on_policy import OnPolicyExperience
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.learners.hierarchy import HierarchicalDDPG
from policy_node.training.learners.imagined import ImaginingDDPG
from policy_node.training.learners.network_shape import network_shape
from policy_node.training.learners.ppo import PPO
from policy_node.training.machine.distributed import Workers


def make_learner(
    config: TrainConfig,
    spec: TaskSpec,
    device: torch.device,
    workers: Workers,
    sampler: TransitionSampler,
    generator: np.random.Generator,
) -> tuple[ActorCritic, Experience]:
    """Returns a learner and its experience.

    Args:
        config: The configuration.
        spec: The task.
        device: Where networks live.
        workers: This worker among all.
        sampler: Makes transitions.
        generator: Source of relabelling and drawing.
    """
    if config.find(Ppo):
        ppo = PPO(network_shape(config), config, device, workers)
        return ppo, OnPolicyExperience(config, spec, workers, sampler, generator, ppo)
    if config.find(Hierarchical):
        levels = HierarchicalDDPG(network_shape(config), config, device, workers)
        return levels, HierarchicalExperience(config, spec, workers, sampler, generator)
    kind = ImaginingDDPG if config.find(Imagined) else DDPG
    ddpg = kind(network_shape(config), config, device, workers)
    experience = Experience(config, spec, workers, sampler, generator)
    experience.judge = ddpg
    return ddpg, experience
