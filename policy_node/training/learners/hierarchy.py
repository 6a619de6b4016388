"""Two levels that learn: a high one whose actions are goals, and the actor that pursues them.

Levy et al. 2019, "Learning Multi-Level Hierarchies with Hindsight" (HAC, arXiv 1712.00948), on one
replay of whole episodes (`hindsight_actions.py`). The actor learns as ever, half of the goals that
are not exchanged being the subgoals it pursued. It is given the goal itself where it is evaluated
and saved: then it is an actor like any other, and what the high level was good for shows in what it
has learnt from.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.hindsight_actions import HierarchicalTransitions
from policy_node.training.experience.subgoals import Proposer
from policy_node.training.experience.transitions import Transitions
from policy_node.training.learners.actor_critic import HIGH_LEVEL, Losses
from policy_node.training.learners.ddpg import DDPG, Known
from policy_node.training.machine.distributed import Workers


class HighLevel(DDPG):
    """The learner of the high level: its actions are goals.

    Args:
        shape: Of the actor.
        config: The configuration.
        device: Where networks live.
        workers: With whom gradients are averaged.
        actor: Whose normalisers it shares.
    """

    def __init__(
        self,
        shape: NetworkShape,
        config: TrainConfig,
        device: torch.device,
        workers: Workers,
        actor: Actor,
    ) -> None:
        shape = replace(shape, action_size=shape.goal_size)
        # A penalty of large actions would prefer goals in the middle of all; subgoals may jump.
        config = replace(config, learner=replace(config.learner, action_l2=0.0))
        super().__init__(shape, config, device, workers)
        self.actor.observation_normalizer = actor.observation_normalizer
        self.actor.goal_normalizer = actor.goal_normalizer
        self._is_pose = task_spec(config.task).goal is GoalKind.POSE

    def _known(self, batch: Transitions) -> Known:
        """As `DDPG`, with goals as actions in [-1, 1]."""
        known = super()._known(batch)
        return replace(known, action=self.actor.goal_normalizer(known.action) / NORMALIZED_CLIP)

    def proposer(self, averaged: bool = False) -> Proposer:
        """A copy, on the CPU, that proposes."""
        actor = self.plain(self.average_actor if averaged else self.actor.network)
        normalizer = actor.goal_normalizer
        return Proposer(actor, normalizer.mean.numpy(), normalizer.std.numpy(), self._is_pose)


class HierarchicalDDPG(DDPG):
    """The actor, which learns as in `DDPG`, and a high level beside it.

    Args:
        shape: Of the actor.
        config: The configuration.
        device: Where networks live.
        workers: With whom gradients are averaged.
    """

    def __init__(
        self, shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
    ) -> None:
        super().__init__(shape, config, device, workers)
        self.high = HighLevel(shape, config, device, workers, self.actor)

    def update(self, batch: Transitions) -> Losses:
        """Improves both levels on a batch; the losses are the actor's.

        Raises:
            TypeError: If the batch has nothing for the high level.
        """
        if not isinstance(batch, HierarchicalTransitions):
            found = type(batch).__name__
            raise TypeError(f'two levels learn from HierarchicalTransitions, not {found}')
        # The count of a resumed run is known to the actor alone.
        self.high.updates = self.updates
        self.high.update(batch.high)
        return super().update(batch)

    def average(self) -> None:
        """As `ActorCritic`, both levels."""
        super().average()
        self.high.average()

    def set_progress(self, progress: float) -> None:
        """As `ActorCritic`, both levels."""
        super().set_progress(progress)
        self.high.set_progress(progress)

    def proposer(self, averaged: bool = False) -> Proposer | None:
        """The high level as it proposes; nothing before it has learnt."""
        return self.high.proposer(averaged) if self.updates else None

    def modules(self) -> dict[str, nn.Module]:
        """What a training state holds, by name."""
        high = {f'{HIGH_LEVEL}{name}': module for name, module in self.high.modules().items()}
        return {**super().modules(), **high}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """The optimisers, by name."""
        high = {f'{HIGH_LEVEL}{name}': value for name, value in self.high.optimizers().items()}
        return {**super().optimizers(), **high}
