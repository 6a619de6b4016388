"""Deep deterministic policy gradient (Lillicrap et al. 2016) as in the paper's appendix B."""

from __future__ import annotations

import contextlib
import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from msgs_spec.arrays import Array32
from msgs_spec.tasks import task_spec
from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Density, Held, OffPolicy
from policy_node.training.experience.conditions import acting_input, fold
from policy_node.training.experience.frame_skip import plain_actor
from policy_node.training.experience.transitions import Transitions
from policy_node.training.learners.actor_critic import ActorCritic, Losses
from policy_node.training.learners.critics import (
    AGGREGATES,
    AdvantageCritic,
    Critic,
    Ensemble,
    make_critic,
)
from policy_node.training.learners.density_ratio import DensityRatio, GoalView
from policy_node.training.learners.quantiles import pooled, quantile_costs
from policy_node.training.machine.devices import uses_bfloat16
from policy_node.training.machine.distributed import Workers

# Fields of `Transitions` that every batch has.
_ALWAYS = ('observation', 'next_observation', 'goal', 'action', 'reward', 'discount')


@dataclass(frozen=True, slots=True)
class Known:
    """A batch as tensors, and what the networks see of both its states."""

    observation: Tensor
    next_observation: Tensor
    goal: Tensor
    features: Tensor
    next_features: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor


class DDPG(ActorCritic):
    """Actor, critic, their targets, and one update.

    Args:
        shape: Of both networks.
        config: The configuration.
        device: Where they live.
        workers: With whom gradients are averaged.
    """

    def __init__(
        self, shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
    ) -> None:
        assert isinstance(config.learner, OffPolicy)
        self.options = config.learner
        self.acting_input = acting_input(config)
        conditioned = self.acting_input is not None
        inputs = shape.feature_size + conditioned
        actor = Actor(shape)
        if conditioned:
            actor.network = MLP(inputs, shape.action_size, shape)
        critic = make_critic(config, inputs, shape)
        # A batch normalisation learns its statistics where values are learnt, nowhere else.
        super().__init__(actor, critic.eval(), config, device, workers)
        self.target_actor, self.target_critic = self.actor.network, self.critic
        if self.options.target == 'polyak':
            self.target_actor = copy.deepcopy(self.actor.network)
            self.target_critic = copy.deepcopy(self.critic)
        self._ratio: DensityRatio | None = None
        if config.find(Density):
            sizes = shape.feature_size, shape.goal_size, shape.action_size
            self._ratio = DensityRatio(*sizes).to(device)
            self._achieved_start = task_spec(config.task).achieved_goal_start
        self._action_size = shape.action_size - (config.find(Held) is not None)
        self._bfloat16 = uses_bfloat16(config.machine.precision, device)
        zero = torch.zeros((), device=device)
        # Loss and value at the actor's last update.
        self._of_actor = zero, zero

    def update(self, batch: Transitions) -> Losses:
        """Improves critic and actor on a batch and, when due, moves the targets."""
        known = self._known(batch)
        weight = None if self._ratio is None else self._weights(self._ratio, known)
        critic_loss = self._update_critic(known, weight)
        if self.updates % self.options.policy_delay == 0:
            self._of_actor = self._update_actor(known)
        actor_loss, value = self._of_actor
        self.updates += 1
        if self.updates % self.options.target_update_interval == 0:
            self._move_targets()
        return Losses(critic_loss.detach(), actor_loss, value)

    def targets(self, reward: Tensor, discount: Tensor, next_features: Tensor) -> Tensor:
        """Targets (batch,) from reward, discount and the features of the next state."""
        next_action = self._target_action(next_features)
        return self._bootstrap(reward, discount, self.target_critic(next_features, next_action))

    def _target_action(self, next_features: Tensor) -> Tensor:
        """The slow actor's actions, with the noise that makes values smooth (TD3, equation 14)."""
        return torch.tanh(self.target_actor(next_features))

    def _bootstrap(self, reward: Tensor, discount: Tensor, next_value: Tensor) -> Tensor:
        """Targets (batch,), clipped to the range of returns of rewards in [-1, 0].

        Episodes are cut, never terminated, so every next state is bootstrapped from.
        """
        critic = self.options.critic
        value = next_value if critic.critics == 1 else AGGREGATES[critic.aggregate](next_value)
        return self._clipped(reward + discount * value)

    def _clipped(self, target: Tensor) -> Tensor:
        return target.clamp(self.config.lowest_value, 0.0)

    def _known(self, batch: Transitions) -> Known:
        """What the networks see of a batch."""
        observation, next_observation, goal, action, reward, discount = (
            self.tensor(getattr(batch, name)) for name in _ALWAYS
        )
        features = self.actor.features(observation, goal)
        next_features = self.actor.features(next_observation, goal)
        if batch.condition is not None:
            features = torch.cat([features, self.tensor(batch.condition)], dim=-1)
            next_condition = self.tensor(batch.next_condition)
            next_features = torch.cat([next_features, next_condition], dim=-1)
        seen = observation, next_observation, goal, features, next_features
        return Known(*seen, action, reward, discount)

    def _update_critic(self, known: Known, weight: Tensor | None) -> Tensor:
        with self._precision():
            cost = self._costs(known)
            loss = (cost if weight is None else weight * cost).mean()
        self.step(self.critic_optimizer, loss, self.critic_parameters)
        return loss

    def _costs(self, known: Known) -> Tensor:
        """What the critic's errors cost: (batch,), of several critics (critics, batch)."""
        if self.options.critic.quantiles > 1:
            return self._costs_of_quantiles(known)
        return self._errors(known).square()

    def _costs_of_quantiles(self, known: Known) -> Tensor:
        """What errors cost where quantiles of the return are learnt."""
        critic, slow = self.critic, self.target_critic
        assert isinstance(critic, Critic | Ensemble) and isinstance(slow, Critic | Ensemble)
        with torch.no_grad():
            following = slow.quantiles(
                known.next_features, self._target_action(known.next_features)
            )
            following = pooled(following, self.options.critic.aggregate == 'truncated')
            target = known.reward[:, None] + known.discount[:, None] * following
        quantiles = critic.quantiles(known.features, known.action)
        return quantile_costs(quantiles, self._clipped(target))

    def _errors(self, known: Known) -> Tensor:
        """Values less targets: (batch,), of several critics (critics, batch)."""
        if self.options.critic.norm == 'batch':
            return self._joint_errors(known)
        if isinstance(self.critic, AdvantageCritic):
            return self._advantage_errors(known, self.critic)
        return self._separate_errors(known)

    def _separate_errors(self, known: Known) -> Tensor:
        with torch.no_grad():
            target = self.targets(known.reward, known.discount, known.next_features)
        error: Tensor = self.critic(known.features, known.action) - target
        return error

    def _advantage_errors(self, known: Known, critic: AdvantageCritic) -> Tensor:
        """Errors of the critic of values of states and of advantages over the actor's actions."""
        slow = self.target_critic
        assert isinstance(slow, AdvantageCritic)
        with torch.no_grad():
            own = torch.tanh(self.actor.network(known.features))
            value = slow.value(known.next_features)
            target = self._bootstrap(known.reward, known.discount, value)
        error: Tensor = critic(known.features, known.action, own) - target
        return error

    def _joint_errors(self, known: Known) -> Tensor:
        """Errors from one pass over states and next states, as CrossQ (arXiv 1902.05605).

        A batch normalisation would otherwise see next actions that its statistics do not know.
        """
        with torch.no_grad():
            next_action = self._target_action(known.next_features)
        self.critic.train()
        both = self.critic(
            torch.cat([known.features, known.next_features]),
            torch.cat([known.action, next_action]),
        )
        self.critic.eval()
        value, next_value = both.chunk(2, dim=-1)
        error: Tensor = value - self._bootstrap(known.reward, known.discount, next_value.detach())
        return error

    def _weights(self, ratio: DensityRatio, known: Known) -> Tensor:
        """Importance weights (batch,) of transitions with goals chosen in hindsight."""
        observation, next_observation = known.observation, known.next_observation
        achieved = slice(self._achieved_start, self._achieved_start + known.goal.shape[-1])
        chosen = GoalView(
            known.features,
            known.next_features,
            observation[:, achieved],
            next_observation[:, achieved],
            known.goal,
        )
        goal = known.goal.roll(1, dims=0)
        features = self.actor.features(observation, goal)
        next_features = self.actor.features(next_observation, goal)
        shuffled = replace(chosen, features=features, next_features=next_features, goal=goal)
        return ratio.update(chosen, shuffled, known.action)

    def _update_actor(self, known: Known) -> tuple[Tensor, Tensor]:
        features = known.features
        with self._precision():
            action = self.actor(features)
            if isinstance(self.critic, AdvantageCritic):
                value = self.critic.advantage(features, action).mean()
            else:
                value = self.critic(features, action).mean()
            loss = -value + self._penalty(known, action)
        if self.updates >= self.critic_first:
            self.step(self.actor_optimizer, loss, self.actor_parameters)
        return loss.detach(), value.detach()

    def _penalty(self, known: Known, action: Tensor) -> Tensor:
        """What the actor's actions cost beside their value."""
        # How long an action holds costs nothing.
        moved = action[..., : self._action_size].float()
        cost: Tensor = self.options.action_l2 * moved.square().mean()
        return cost

    @torch.no_grad()
    def _move_targets(self) -> None:
        if self.options.target == 'none':
            return
        weight = 1.0 - self.options.polyak
        old: list[Tensor] = [*self.target_actor.parameters(), *self.target_critic.parameters()]
        new: list[Tensor] = [*self.actor_parameters, *self.critic_parameters]
        torch._foreach_lerp_(old, new, weight)

    def evaluation_actor(self) -> Actor:
        """As `ActorCritic`; it decides at every tick."""
        return plain_actor(super().evaluation_actor(), self.config)

    def plain(self, network: MLP) -> Actor:
        """A copy of the actor with this network, at the condition under which it acts."""
        if self.acting_input is None:
            return super().plain(network)
        actor = copy.deepcopy(self.actor)
        actor.network = fold(network, actor.shape, self.acting_input)
        return actor.cpu().eval()

    @torch.no_grad()
    def act(self, observation: Array32, goal: Array32) -> Array32:
        """Actions (batch, action_size) of the actor, without noise."""
        inputs = self.tensor(observation), self.tensor(goal)
        features = self.actor.features(*inputs)
        if self.acting_input is not None:
            acting = features.new_full((len(features), 1), self.acting_input)
            features = torch.cat([features, acting], dim=-1)
        action: Array32 = self.actor(features).cpu().numpy()
        return action

    @torch.no_grad()
    def surprise(self, batch: Transitions) -> Array32:
        """Absolute error of each value, (batch,); of several critics the mean."""
        known = self._known(batch)
        with self._precision():
            error = self._separate_errors(known).abs().float()
        found: Array32 = (error if error.ndim == 1 else error.mean(dim=0)).cpu().numpy()
        return found

    @torch.no_grad()
    def disagreement(self, batch: Transitions) -> Array32:
        """Standard deviation of each value over the critics, (batch,)."""
        known = self._known(batch)
        with self._precision():
            value = self.critic(known.features, known.action).float()
        spread: Array32 = value.std(dim=0).cpu().numpy()
        return spread

    def importance(self, batch: Transitions) -> Array32:
        """Importance weights of a batch, (batch,), from what has just learnt from it as well.

        Raises:
            ValueError: If the configuration has none.
        """
        if self._ratio is None:
            raise ValueError('only importance density has weights of its own')
        weight: Array32 = self._weights(self._ratio, self._known(batch)).cpu().numpy()
        return weight

    def modules(self) -> dict[str, nn.Module]:
        """What a training state holds, by name."""
        modules = super().modules()
        # Without targets these are actor and critic themselves.
        if self.options.target != 'none':
            targets = {'target_actor': self.target_actor, 'target_critic': self.target_critic}
            modules = {**modules, **targets}
        return modules if self._ratio is None else {**modules, 'ratio': self._ratio}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """The optimisers, by name."""
        optimizers = super().optimizers()
        if self._ratio is not None:
            optimizers['ratio_optimizer'] = self._ratio.optimizer
        return optimizers

    def _precision(self) -> contextlib.AbstractContextManager[None]:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16)
