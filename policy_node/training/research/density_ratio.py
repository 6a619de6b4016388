"""Importance weights that remove the bias of hindsight from the critic.

A goal that was chosen because an action led to it does not show how often the action leads there.
For a state s, an action a and a goal g the critic should get the next states s' of the environment,
p(s'|s, a). With goals drawn from q(g|s, a, s') it gets p(s'|s, a) q(g|s, a, s') / q(g|s, a)
instead, where q(g|s, a) is the mean over s'. The weight

    w = q(g|s, a) / q(g|s, a, s')

removes this factor (Schramm et al. 2022, "USHER", arXiv 2207.01115). USHER gets both densities from
a critic of two goals. Here two classifiers learn them: each separates the goals of a batch from the
same goals shuffled. At its optimum the logit is log q(g|...) / q(g) (noise-contrastive estimation,
Gutmann & Hyvarinen 2010), so w is the exponential of the difference of two logits.

A weight is finite only if goals that do not depend on s' are drawn as well: the desired goal of the
episode itself, or those of other episodes (goal source `actual`). q is the mixture of all sources,
so their shares need not be known. With `torchrun` each worker learns its own classifiers from its
part of the batches.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from msgs_spec.arrays import Array32
from msgs_spec.tasks import task_spec
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.ddpg import DDPG, TensorBatch

# Largest weight. Larger ones belong to goals that hindsight almost never chooses.
MOST_WEIGHT = 10.0
_WIDTH = 128
_LEARNING_RATE = 1e-3
# Per metre or unit of a quaternion: resolves differences of about a success threshold.
_NEAR = 20.0
_SMALLEST_DISTANCE = 1e-3


Inputs = tuple[Tensor, Tensor]
"""Inputs (batch, size) of the classifiers without and with the next state."""


class DensityRatio(nn.Module):
    """Estimates the weight q(g|s, a) / q(g|s, a, s') of a hindsight goal g with two classifiers."""

    def __init__(self, feature_size: int, goal_size: int, action_size: int) -> None:
        super().__init__()
        before = feature_size + action_size + goal_size + 1
        self.before = _classifier(before)
        self.after = _classifier(before + feature_size + goal_size + 1)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=_LEARNING_RATE)

    def update(self, chosen: Inputs, shuffled: Inputs) -> Tensor:
        """Train both classifiers one step; return the weights of `chosen`, (batch,), mean 1.

        `chosen` are inputs with the batch's own goals, `shuffled` with goals of other transitions.
        """
        logits = [
            (self.before(before).squeeze(-1), self.after(after).squeeze(-1))
            for before, after in (chosen, shuffled)
        ]
        one = torch.ones_like(logits[0][0])
        labels = torch.stack([one, torch.zeros_like(one)])
        loss = one.new_zeros(())
        for pair in zip(*logits, strict=True):
            loss = loss + nn.functional.binary_cross_entropy_with_logits(torch.stack(pair), labels)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        before, after = (logit.detach() for logit in logits[0])
        weight: Tensor = (before - after).exp().clamp(max=MOST_WEIGHT)
        return weight / weight.mean()


def _difference(goal: Tensor, achieved: Tensor) -> Tensor:
    """Return the difference of two goals as inputs of the classifiers, (batch, goal_size + 1).

    The scaled, clipped difference of each value shows small distances; the logarithm of the norm
    shows large ones.
    """
    difference = goal - achieved
    distance = difference.norm(dim=-1, keepdim=True)
    near = (_NEAR * difference).clamp(-NORMALIZED_CLIP, NORMALIZED_CLIP)
    return torch.cat([near, (distance + _SMALLEST_DISTANCE).log()], dim=-1)


def _classifier(inputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, _WIDTH),
        nn.ReLU(),
        nn.Linear(_WIDTH, _WIDTH),
        nn.ReLU(),
        nn.Linear(_WIDTH, 1),
    )


class WeightedDDPG(DDPG):
    """`DDPG` whose critic loss is weighted with the importance weights of `DensityRatio`."""

    def _set_up(self, shape: NetworkShape) -> None:
        sizes = shape.feature_size, shape.goal_size, shape.action_size
        self._ratio = DensityRatio(*sizes).to(self.device)
        self.modules['ratio'] = self._ratio
        self.optimizers['ratio_optimizer'] = self._ratio.optimizer
        start = task_spec(self.config.task).achieved_goal_start
        self._achieved = slice(start, start + shape.goal_size)

    def _update_critic(self, batch: TensorBatch) -> Tensor:
        self._weight = self._weights(batch)
        return super()._update_critic(batch)

    def _loss_of_critic(self, batch: TensorBatch) -> Tensor:
        return (self._weight * self.critic_loss.costs(self, batch)).mean()

    def _weights(self, batch: TensorBatch) -> Tensor:
        """Train the classifiers on a batch; return its importance weights, (batch,)."""
        goal = batch.goal.roll(1, dims=0)
        features = self.actor.features(batch.observation, goal)
        next_features = self.actor.features(batch.next_observation, goal)
        shuffled = replace(batch, features=features, next_features=next_features, goal=goal)
        return self._ratio.update(self._inputs(batch), self._inputs(shuffled))

    def _inputs(self, batch: TensorBatch) -> Inputs:
        achieved, led_to = (
            _difference(batch.goal, seen[:, self._achieved])
            for seen in (batch.observation, batch.next_observation)
        )
        before = torch.cat([batch.features, batch.action, achieved], dim=-1)
        return before, torch.cat([before, batch.next_features, led_to], dim=-1)

    def importance(self, batch: Transitions) -> Array32:
        """Train the classifiers on a NumPy batch, without actor and critic; return its weights."""
        weight: Array32 = self._weights(self.tensors(batch)).cpu().numpy()
        return weight
