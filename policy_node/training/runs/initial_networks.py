"""Networks that a run starts from instead of random ones, and how they fit another run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import to_flat
from policy_node.training.configuration.groups import Critics
from policy_node.training.experience.conditions import acting_input
from policy_node.training.experience.widening import (
    can_widen,
    first_weights,
    widened,
    with_inputs,
)
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.learners.critics import (
    Ensemble,
    count_critics,
    critic_tensors,
    is_ensemble,
)
from policy_node.training.learners.network_shape import network_shape
from policy_node.training.runs.training_state import part_of

# Updates of the critics alone where one starts from nothing beside an actor that is already good:
# the gradient of a critic that knows nothing would ruin it.
CRITIC_FIRST = 5_000
# A critic of runs that differ in these says what has no meaning: dense rewards are distances, and
# values are per tick.
VALUED_BY = ('reward_type', 'control_hz')
# Parts of a training state that are critics.
_CRITICS = ('critic', 'target_critic')
_PREFIXES = tuple(f'{part}.' for part in _CRITICS)


def described(shape: NetworkShape, goal_features: str) -> dict[str, object]:
    """Sizes and inputs of networks by name, for who compares two."""
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


@dataclass(frozen=True, slots=True)
class InitialNetworks:
    """Weights and normalisers to start from.

    Attributes:
        tensors: Named as in a training state; without optimisers, counters and generators.
        shape: What they fit.
        goal_features: Their kind of inputs.
        norm: What normalises hidden layers of the critic alone.
        origin: Where they come from, for the record: name, task, environment steps and command.
        valued_by: Fields of the run that its critic's values are of, see `VALUED_BY`.
    """

    tensors: dict[str, Tensor]
    shape: NetworkShape
    goal_features: str
    norm: str
    origin: dict[str, Any]
    valued_by: dict[str, Any] = field(default_factory=dict)

    @property
    def has_critic(self) -> bool:
        """Whether there is more than an actor."""
        return any(name.startswith('critic.') for name in self.tensors)

    def require_fit(self, config: TrainConfig) -> None:
        """Refuses networks that another run cannot start from.

        Raises:
            ValueError: One line names the sizes of both.
        """
        ours = described(network_shape(config), config.network.goal_features)
        theirs = described(self._with_past_of(config).shape, self.goal_features)
        if can_widen(self.shape.hidden_sizes, config.network.hidden_sizes):
            theirs['hidden_sizes'] = config.network.hidden_sizes
        differing = [
            f'{name} {old}, now {ours[name]}' for name, old in theirs.items() if old != ours[name]
        ]
        if theirs['hidden_sizes'] != ours['hidden_sizes']:
            differing.append('allowed hidden_sizes: as many, each a whole multiple')
        if differing:
            origin = f'{self.origin["name"]} ({self.origin["task"]})'
            raise ValueError(f'{config.task} cannot start from {origin}: {"; ".join(differing)}')

    def fitted(self, config: TrainConfig) -> InitialNetworks:
        """These networks for another run, in which other inputs may begin to count.

        A critic whose hidden layers are normalised otherwise, or whose values are of other rewards,
        is left behind; one of another `gamma` is kept, and `critic_first` gives its values time.
        Hidden layers may become wider, and past actions may become inputs.

        Where the position of an object did not count, the goal's position was always about the
        object's own: networks have learnt nothing from it, and what they do elsewhere is chance (an
        actor that dropped 1 block in 200 dropped half of them). So they start blind to it: its
        weights become zero. They start blind to a condition as well.

        Raises:
            ValueError: If the run cannot start from them; one line names the sizes of both.
        """
        self.require_fit(config)
        before, now = task_spec(self.origin['task']), task_spec(config.task)
        fitted = self._with_past_of(config)
        shape = fitted.shape
        # The critic's inputs are the actor's, then the action.
        if shape.goal_features is not None and now.position_counts and not before.position_counts:
            inputs = shape.goal_features.goal_position(shape.observation_size, shape.goal_size)
            changed = {name: fitted.tensors[name].clone() for name in first_weights(fitted.tensors)}
            for weight in changed.values():
                weight[:, inputs] = 0.0
            fitted = replace(fitted, tensors=fitted.tensors | changed)
        if acting_input(config) is not None:
            tensors = with_inputs(fitted.tensors, shape.feature_size, 1)
            fitted = replace(fitted, tensors=tensors)
        critic = config.find(Critics) or Critics()
        values = {name: to_flat(config)[name] for name in self.valued_by}
        if critic.norm != self.norm or values != self.valued_by:
            fitted = fitted.without_critic()
        else:
            fitted = fitted.with_critics(critic.critics)
        if config.network.hidden_sizes == shape.hidden_sizes:
            return fitted
        wider = replace(shape, hidden_sizes=config.network.hidden_sizes)
        tensors = widened(fitted.tensors, config.network.hidden_sizes)
        return replace(fitted, tensors=tensors, shape=wider)

    def _with_past_of(self, config: TrainConfig) -> InitialNetworks:
        """These networks with the past actions of a run as inputs, if they have none.

        The weights of these inputs start at zero; the normaliser starts at mean 0 and deviation 1.
        """
        shape = replace(self.shape, past_actions=config.network.past_actions)
        if self.shape.past_actions or not shape.past_actions:
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
        """The actor and its normalisers alone."""
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        return replace(self, tensors=tensors, origin=self.origin | {'critic': False})

    @property
    def critics(self) -> int:
        """How many critics there are."""
        return count_critics(part_of(self.tensors, 'critic'))

    def with_critics(self, critics: int) -> InitialNetworks:
        """These networks, critics named as those of so many are; there may be fewer of them."""
        if critics == 1 == self.critics and not is_ensemble(part_of(self.tensors, 'critic')):
            return self
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        for part in _CRITICS:
            named = critic_tensors(part_of(self.tensors, part), critics)
            tensors |= {f'{part}.{name}': value for name, value in named.items()}
        known = {'critics': min(critics, self.critics)}
        return replace(self, tensors=tensors, origin=self.origin | known)

    def completed(self, learner: ActorCritic) -> dict[str, Tensor]:
        """The tensors, and the learner's own for critics of which there are none."""
        tensors = dict(self.tensors)
        for part, module in learner.modules().items():
            given = part_of(tensors, part)
            if given and isinstance(module, Ensemble):
                completed = module.completed(given)
                tensors |= {f'{part}.{name}': value for name, value in completed.items()}
        return tensors
