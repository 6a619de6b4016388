"""A learner whose result is known."""

from __future__ import annotations

import torch

from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.machine import Workers
from policy_node.training.research.registry import make_ddpg

SHAPE = NetworkShape(observation_size=1, goal_size=1, action_size=1, hidden_sizes=(32, 32))


def make_learner(shape: NetworkShape = SHAPE, **changes: object) -> DDPG:
    """A learner of one observation, goal and action, with a discount of 0.5."""
    torch.manual_seed(0)
    options = {'precision': 'float32', 'gamma': 0.5, 'learning_rate': 3e-3, **changes}
    config = recipe_config('FetchReach', 'paper', **options)
    return make_ddpg(shape, config, torch.device('cpu'), Workers())
