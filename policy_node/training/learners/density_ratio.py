"""Importance weights that take back what choosing goals in hindsight does to the critic.

A goal that was chosen because an action led to it says nothing about how often the action leads
there. For a state s, an action a and a goal g the critic should see the next states s' of the
environment, p(s'|s, a); goals drawn from q(g|s, a, s') make it see p(s'|s, a) q(g|s, a, s') /
q(g|s, a) instead, where q(g|s, a) is the mean over s'. The weight

    w = q(g|s, a) / q(g|s, a, s')

takes that back (Schramm et al. 2022, "USHER", arXiv 2207.01115). They read both densities off a
critic of two goals; here two classifiers learn them, each telling the goals of a batch from the
same goals shuffled: at its optimum the logit is log q(g|...) / q(g) (noise-contrastive estimation,
Gutmann & Hyvarinen 2010), so that w is the exponential of the difference of two logits.

A weight is finite only where goals that do not depend on s' are drawn as well: those of the episode
itself or of others (`actual`). q is the mixture of all of them, so no share has to be known. Under
`torchrun` each worker learns its own classifiers from its part of the batches.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy_node.policies.network_shape import NORMALIZED_CLIP

# Weights beyond it are cut: they come from goals that hindsight all but never chooses.
MOST_WEIGHT = 10.0
_WIDTH = 128
_LEARNING_RATE = 1e-3
# Metres (or units of a quaternion): within about a threshold of success the difference counts.
_NEAR = 20.0
_SMALLEST_DISTANCE = 1e-3


@dataclass(frozen=True, slots=True)
class GoalView:
    """A batch of transitions as it looks with certain goals, each (batch, size).

    Attributes:
        features: Inputs of the networks, of the state and the goal.
        next_features: The same of the next state.
        achieved: Achieved goal of the state.
        next_achieved: The same of the next state.
        goal: The goal.
    """

    features: Tensor
    next_features: Tensor
    achieved: Tensor
    next_achieved: Tensor
    goal: Tensor


class DensityRatio(nn.Module):
    """The two classifiers and their optimiser.

    Args:
        feature_size: Length of the features of a state and a goal.
        goal_size: Length of a goal.
        action_size: Length of an action.
    """

    def __init__(self, feature_size: int, goal_size: int, action_size: int) -> None:
        super().__init__()
        before = feature_size + action_size + goal_size + 1
        self.before = _classifier(before)
        self.after = _classifier(before + feature_size + goal_size + 1)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=_LEARNING_RATE)

    def update(self, chosen: GoalView, shuffled: GoalView, action: Tensor) -> Tensor:
        """Improves the classifiers on a batch and returns its weights (batch,), of mean 1.

        Args:
            chosen: The batch with its goals.
            shuffled: The same with goals of other transitions.
            action: (batch, action_size).
        """
        logits = [self._logits(view, action) for view in (chosen, shuffled)]
        labels = torch.stack([torch.ones(len(action)), torch.zeros(len(action))]).to(action)
        loss = action.new_zeros(())
        for pair in zip(*logits, strict=True):
            loss = loss + nn.functional.binary_cross_entropy_with_logits(torch.stack(pair), labels)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        before, after = (logit.detach() for logit in logits[0])
        weight = (before - after).exp().clamp(max=MOST_WEIGHT)
        return weight / weight.mean()

    def _logits(self, view: GoalView, action: Tensor) -> tuple[Tensor, Tensor]:
        known = torch.cat([view.features, action, _difference(view.goal, view.achieved)], dim=-1)
        led_to = torch.cat([view.next_features, _difference(view.goal, view.next_achieved)], dim=-1)
        after = self.after(torch.cat([known, led_to], dim=-1))
        return self.before(known).squeeze(-1), after.squeeze(-1)


def _difference(goal: Tensor, achieved: Tensor) -> Tensor:
    """How far the goal is, near and far: (batch, goal_size + 1)."""
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
