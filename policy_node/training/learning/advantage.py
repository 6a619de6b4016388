"""Values of states and rates of advantage instead of action values (DAU, arXiv 1901.09732).

The more frequent actions are, the less a single one of them matters: action values become values of
states, and what an actor is to climb vanishes. Here Q(s, a) = V(s) + dt (A(s, a) - A(s, pi(s))), so
that A keeps its size whatever dt is and the actor climbs A. dt is 1 for a tick of 40 ms.
"""

from __future__ import annotations

from torch import Tensor, nn

from policy_node.policies.network_shape import NetworkShape
from policy_node.training.learning.critics import Critic


class AdvantageCritic(nn.Module):
    """Value of a state and advantage of an action, two networks.

    Args:
        features: Length of the features, a condition included.
        shape: Of the actor; hidden layers are the same.
        norm: What normalises them: `none` or `layer`.
        duration: Of a tick, in units of 40 ms.
    """

    def __init__(self, features: int, shape: NetworkShape, norm: str, duration: float) -> None:
        super().__init__()
        self._duration = duration
        self.state_value = Critic(features, shape, norm)
        self.advantage = Critic(features + shape.action_size, shape, norm)

    def value(self, features: Tensor) -> Tensor:
        """Values (batch,) of states."""
        nothing = features.new_zeros((len(features), 0))
        value: Tensor = self.state_value(features, nothing)
        return value

    def forward(self, features: Tensor, action: Tensor, own: Tensor) -> Tensor:
        """Values (batch,) of actions, of which `own` has the value of its state."""
        gain: Tensor = self.advantage(features, action) - self.advantage(features, own)
        return self.value(features) + self._duration * gain
