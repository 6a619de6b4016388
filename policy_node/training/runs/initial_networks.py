"""Networks that a run starts from instead of random ones, adapted to its configuration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import to_flat
from policy_node.training.learners.actor_critic import ActorCritic, first_weights, with_inputs
from policy_node.training.research.registry import (
    Ensemble,
    acting_input,
    count_critics,
    critic_tensors,
    is_ensemble,
    network_shape,
)
from policy_node.training.runs.training_state import part_of

# Updates of the critics alone if a random critic starts beside a trained actor: the gradient of an
# untrained critic would ruin the actor.
CRITIC_FIRST = 5_000
# If these differ, the values of a critic have another meaning: dense rewards are distances, and
# discounts are per tick.
VALUED_BY = ('reward_type', 'control_hz')
# Parts of a training state that are critics.
_CRITICS = ('critic', 'target_critic')
_PREFIXES = tuple(f'{part}.' for part in _CRITICS)


@dataclass(frozen=True, slots=True)
class InitialNetworks:
    """Weights and normalisers to start from.

    Attributes:
        tensors: Named as in a training state, without optimisers and generators.
        origin: Name, task, environment steps and command of their training, for the record.
        valued_by: Fields of the run that give the values of its critic a meaning (`VALUED_BY`).
    """

    tensors: dict[str, Tensor]
    shape: NetworkShape
    goal_features: str
    norm: str
    origin: dict[str, Any]
    valued_by: dict[str, Any] = field(default_factory=dict)

    @property
    def has_critic(self) -> bool:
        """True if they contain a critic."""
        return any(name.startswith('critic.') for name in self.tensors)

    def require_fit(self, config: TrainConfig) -> None:
        """Raise ValueError if a run with this configuration cannot start from these networks."""
        ours = _described(network_shape(config), config.goal_features)
        theirs = _described(self._shape_in(config), self.goal_features)
        differing = [
            f'{name} {old}, now {ours[name]}' for name, old in theirs.items() if old != ours[name]
        ]
        if differing:
            origin = f'{self.origin["name"]} ({self.origin["task"]})'
            raise ValueError(f'{config.task} cannot start from {origin}: {"; ".join(differing)}')

    def fitted(self, config: TrainConfig) -> InitialNetworks:
        """Return these networks, adapted to another run.

        - A critic is left out if its hidden layers have another normalisation, or its values
          another meaning. A critic with another `gamma` stays; `critic_first` lets it adapt.
        - Past actions may become inputs.
        - If the object's position counts only in the new task, the weights of the goal position
          become zero. In the old task it equalled that of the object, so the networks have learnt
          nothing from it. An actor that dropped 1 block in 200 would drop half.
        - A condition input gets zero weights.

        Raises:
            ValueError: If the run cannot start from them.
        """
        self.require_fit(config)
        before, now = task_spec(self.origin['task']), task_spec(config.task)
        fitted = self._with_past_of(config)
        shape = fitted.shape
        # The critic has the inputs of the actor, then the action.
        if shape.goal_features is not None and now.position_counts and not before.position_counts:
            inputs = shape.goal_features.goal_position(shape.observation_size, shape.goal_size)
            changed = {name: fitted.tensors[name].clone() for name in first_weights(fitted.tensors)}
            for weight in changed.values():
                weight[:, inputs] = 0.0
            fitted = replace(fitted, tensors=fitted.tensors | changed)
        if acting_input(config) is not None:
            tensors = with_inputs(fitted.tensors, shape.feature_size, 1)
            fitted = replace(fitted, tensors=tensors)
        values = {name: to_flat(config)[name] for name in self.valued_by}
        if config.norm != self.norm or values != self.valued_by:
            return fitted.without_critic()
        return fitted.with_critics(config.critics)

    def _shape_in(self, config: TrainConfig) -> NetworkShape:
        """Return the shape with the past actions of a run, or with their own if they have some."""
        past = self.shape.past_actions or config.past_actions
        return replace(self.shape, past_actions=past)

    def _with_past_of(self, config: TrainConfig) -> InitialNetworks:
        """Return these networks with the past actions of a run as inputs, if they have none.

        The weights of these inputs start at zero; the normaliser starts at mean 0 and deviation 1.
        """
        shape = self._shape_in(config)
        if shape == self.shape:
            return self
        tensors = with_inputs(self.tensors, shape.past_start, shape.past_size)
        added = {'mean': 0.0, 'std': 1.0, 'total': 0.0}
        count = tensors.get('observation_statistics.count')
        if count is not None:
            added['total_square'] = float(count)
        for name, tensor in tensors.items():
            part, _, statistic = name.rpartition('.')
            if part.endswith(('observation_normalizer', 'observation_statistics')) and (
                statistic in added
            ):
                more = tensor.new_full((shape.past_size,), added[statistic])
                tensors[name] = torch.cat([tensor, more])
        return replace(self, tensors=tensors, shape=shape)

    def without_critic(self) -> InitialNetworks:
        """Return only the actor and its normalisers."""
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        return replace(self, tensors=tensors, origin=self.origin | {'critic': False})

    @property
    def critics(self) -> int:
        """Number of critics."""
        return count_critics(part_of(self.tensors, 'critic'))

    def with_critics(self, critics: int) -> InitialNetworks:
        """Return these networks with tensor names for `critics` critics; some may be missing."""
        if critics == 1 == self.critics and not is_ensemble(part_of(self.tensors, 'critic')):
            return self
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        for part in _CRITICS:
            named = critic_tensors(part_of(self.tensors, part), critics)
            tensors |= {f'{part}.{name}': value for name, value in named.items()}
        known = {'critics': min(critics, self.critics)}
        return replace(self, tensors=tensors, origin=self.origin | known)

    def completed(self, learner: ActorCritic) -> dict[str, Tensor]:
        """Return the tensors, with those of the learner for missing critics."""
        tensors = dict(self.tensors)
        for part, module in learner.modules().items():
            given = part_of(tensors, part)
            if given and isinstance(module, Ensemble):
                completed = module.completed(given)
                tensors |= {f'{part}.{name}': value for name, value in completed.items()}
        return tensors


def _described(shape: NetworkShape, goal_features: str) -> dict[str, object]:
    """Return sizes and inputs of networks by name."""
    return {
        'observation': shape.observation_size,
        'goal': shape.goal_size,
        'action': shape.action_size,
        'hidden_sizes': shape.hidden_sizes,
        'layer_norm': shape.layer_norm,
        'goal_features': goal_features,
        'past_actions': shape.past_actions,
        'inputs': shape.feature_size,
    }
