"""A subgoal that is only imagined, halfway by value, as a prior on the actor.

Chane-Sane et al. 2021, "Goal-Conditioned Reinforcement Learning with Imagined Subgoals" (RIS, arXiv
2107.00541): what the actor does for a goal that is far away should be near to what it does for one
on the way there, which it has learnt sooner. A network h says which: for a state s and a goal g it
learns, of several states s' that were visited, those with the least

    cost(s') = max(-V(s, g'), -V(s', g)),     g' what is achieved in s',

weighted by the softmax of -cost. The loss of the actor gets the mean of (a - a')^2 times
`subgoal_prior`, a' being the action of its slow copy for h(s, g). As there, h plays no part once
the actor acts. Here the weights compare the candidates of a state with each other, not with h, so
that V is asked about states that were visited and about nothing else.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Imagined
from policy_node.training.learners.ddpg import DDPG, Known
from policy_node.training.machine.distributed import Workers

# States that a subgoal is chosen of, for every fourth transition of a batch: values of candidates
# are what an update costs more.
CANDIDATES = 8
_EVERY = 4
# Temperature of the softmax, in units of value: a tick costs about 1 (RIS: .1, over a batch).
_TEMPERATURE = 1.0


class ImaginingDDPG(DDPG):
    """`DDPG` whose actor is drawn to what it does for imagined subgoals.

    Args:
        shape: Of both networks.
        config: The configuration.
        device: Where they live.
        workers: With whom gradients are averaged.

    Attributes:
        imagination: Features of a state and a goal -> normalised subgoal.
    """

    def __init__(
        self, shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
    ) -> None:
        super().__init__(shape, config, device, workers)
        self._imagined = config.find(Imagined) or Imagined()
        self.imagination = MLP(shape.feature_size, shape.goal_size, shape).to(device)
        self._imagination_parameters = list(self.imagination.parameters())
        workers.broadcast(self._imagination_parameters)
        self._imagination_optimizer = self._adam(self._imagination_parameters)
        spec = task_spec(config.task)
        start = spec.achieved_goal_start
        self._achieved = slice(start, start + shape.goal_size)
        self._is_pose = spec.goal is GoalKind.POSE

    def _update_actor(self, known: Known) -> tuple[Tensor, Tensor]:
        actor_updates = self.updates // self.options.policy_delay
        if actor_updates % self._imagined.imagination_interval == 0:
            self._update_imagination(known)
        return super()._update_actor(known)

    def _update_imagination(self, known: Known) -> None:
        with self._precision():
            loss = self._imagination_loss(known)
        self.step(self._imagination_optimizer, loss, self._imagination_parameters)

    def _imagination_loss(self, known: Known) -> Tensor:
        count = -(-len(known.goal) // _EVERY)
        # Transitions of a batch have nothing to do with each other: those that follow are any.
        following = [known.observation.roll(-i - 1, dims=0)[:count] for i in range(CANDIDATES)]
        visited = torch.cat(following)
        subgoal = visited[:, self._achieved]
        state = known.observation[:count].repeat(CANDIDATES, 1)
        goal = known.goal[:count].repeat(CANDIDATES, 1)
        with torch.no_grad():
            # All in one pass: what an update costs more is mostly this.
            value = self._value(torch.cat([state, visited]), torch.cat([subgoal, goal]))
            cost = torch.maximum(*(-value).chunk(2)).reshape(CANDIDATES, count)
            weight = (-cost / _TEMPERATURE).softmax(dim=0)
            wanted = self.actor.goal_normalizer(subgoal).reshape(CANDIDATES, count, -1)
        error = self.imagination(known.features[:count]) - wanted
        loss: Tensor = (weight * error.square().mean(dim=-1)).sum(dim=0).mean()
        return loss

    def _value(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Values (batch,) of states; of several critics the mean."""
        features = self.actor.features(observation, goal)
        value: Tensor = self.critic(features, self.actor(features))
        return value if value.ndim == 1 else value.mean(dim=0)

    def _penalty(self, known: Known, action: Tensor) -> Tensor:
        """As `DDPG`, and how far actions are from those for imagined subgoals."""
        with torch.no_grad():
            features = self.actor.features(known.observation, self.imagine(known.features))
            prior = torch.tanh(self.target_actor(features))
        distance: Tensor = (action - prior).float().square().mean()
        return super()._penalty(known, action) + self._imagined.subgoal_prior * distance

    def imagine(self, features: Tensor) -> Tensor:
        """Subgoals (batch, goal_size) in units of the task for the features of states and goals."""
        normalizer = self.actor.goal_normalizer
        subgoal: Tensor = normalizer.mean + normalizer.std * self.imagination(features)
        if not self._is_pose:
            return subgoal
        rotation = nn.functional.normalize(subgoal[:, 3:], dim=-1)
        return torch.cat([subgoal[:, :3], rotation], dim=-1)

    def modules(self) -> dict[str, nn.Module]:
        """What a training state holds, by name."""
        return {**super().modules(), 'imagination': self.imagination}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """The optimisers, by name."""
        return {**super().optimizers(), 'imagination_optimizer': self._imagination_optimizer}
