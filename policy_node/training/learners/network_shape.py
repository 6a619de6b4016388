"""The shape of networks that a configuration asks for."""

from __future__ import annotations

from msgs_spec.tasks import task_spec
from policy_node.policies.goal_features import goal_features
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Held


def network_shape(config: TrainConfig) -> NetworkShape:
    """Shape of the actor, and of the critic, that a configuration asks for."""
    spec = task_spec(config.task)
    return NetworkShape(
        observation_size=spec.observation_size,
        goal_size=spec.goal.size,
        # How long the action holds is one more.
        action_size=spec.robot.action_size + (config.find(Held) is not None),
        hidden_sizes=config.network.hidden_sizes,
        layer_norm=config.network.layer_norm,
        goal_features=goal_features(config.network.goal_features, spec),
        past_actions=config.network.past_actions,
    )
