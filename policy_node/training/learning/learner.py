"""What the trainer needs of whatever learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from policy_node.policies.actor import Actor
from policy_node.training.learning.subgoals import Proposer
from policy_node.training.learning.transitions import Transitions


@dataclass(frozen=True, slots=True)
class Losses:
    """Scalars of one update, tensors on the device so that nothing waits for them."""

    critic: Tensor
    actor: Tensor
    value: Tensor


class Learner(Protocol):
    """Networks, their optimisers, and one update.

    Attributes:
        actor: Holds the normalisers of all inputs.
        updates: Updates so far.
        critic_first: The actor learns after this many of them.
    """

    actor: Actor
    updates: int
    critic_first: int

    def update(self, batch: Transitions) -> Losses:
        """Improves the networks on a batch."""
        ...

    def average(self) -> None:
        """Moves the averaged actor towards the actor; the trainer calls it once per cycle."""
        ...

    def set_progress(self, progress: float) -> None:
        """Sets what changes over a run of which the share `progress` is over."""
        ...

    def acting_actor(self) -> Actor:
        """A copy, on the CPU, of the actor that collects."""
        ...

    def proposer(self, averaged: bool = False) -> Proposer | None:
        """Who gives the actor subgoals; None where nobody does. Averaged as in evaluations."""
        ...

    def evaluation_actor(self) -> Actor:
        """A copy, on the CPU, of the actor to evaluate."""
        ...

    def modules(self) -> dict[str, nn.Module]:
        """What a training state holds, by name; an actor may come without what is no actor."""
        ...

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """The optimisers, by name, whose states a training state holds."""
        ...
