"""Imagine subgoals on the way to a goal, and pull the actor towards its actions for them.

Chane-Sane et al. 2021, "Goal-Conditioned Reinforcement Learning with Imagined Subgoals" (RIS, arXiv
2107.00541). The actor learns near goals before distant ones. So its action for a distant goal is
drawn towards its action for a subgoal on the way. A network h imagines that subgoal. For a state s
and a goal g, h learns from several visited states s', its candidates. The best candidates have the
lowest

    cost(s') = max(-V(s, g'), -V(s', g)),     g' is the goal achieved in s'.

The weights of candidates are the softmax of -cost. The mean of (a - a')^2 times `subgoal_prior` is
added to the loss of the actor, where a' is the action of the target actor for h(s, g). As in RIS,
the acting policy does not use h. Unlike in RIS, the weights compare the candidates of a state with
each other, not with h. So V is evaluated only for visited states.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.learners.ddpg import DDPG, TensorBatch

# Candidate states of a subgoal, for every fourth transition of a batch. Their values are most of
# the additional cost of an update.
CANDIDATES = 8
_EVERY = 4
# Temperature of the softmax, in units of value: a tick costs about 1 (RIS: 0.1, over a batch).
_TEMPERATURE = 1.0


class ImaginingDDPG(DDPG):
    """`DDPG` that pulls the actor towards its own actions for imagined subgoals.

    Attributes:
        imagination: Network that maps the features of a state and a goal to a normalized subgoal.
    """

    def _set_up(self, shape: NetworkShape) -> None:
        self.imagination = MLP(shape.feature_size, shape.goal_size, shape).to(self.device)
        self._imagination_parameters = list(self.imagination.parameters())
        self.workers.broadcast(self._imagination_parameters)
        self._imagination_optimizer = self._adam(self._imagination_parameters)
        self.modules['imagination'] = self.imagination
        self.optimizers['imagination_optimizer'] = self._imagination_optimizer
        spec = task_spec(self.config.task)
        start = spec.achieved_goal_start
        self._achieved = slice(start, start + shape.goal_size)
        self._is_pose = spec.goal is GoalKind.POSE

    def _update_actor(self, batch: TensorBatch) -> tuple[Tensor, Tensor]:
        actor_updates = self.updates // self.config.policy_delay
        if actor_updates % self.config.imagination_interval == 0:
            self._update_imagination(batch)
        return super()._update_actor(batch)

    def _update_imagination(self, batch: TensorBatch) -> None:
        with self.precision():
            loss = self._imagination_loss(batch)
        self.step(self._imagination_optimizer, loss, self._imagination_parameters)

    def _imagination_loss(self, batch: TensorBatch) -> Tensor:
        count = -(-len(batch.goal) // _EVERY)
        # The transitions of a batch are independent, so those that follow are random candidates.
        following = [batch.observation.roll(-i - 1, dims=0)[:count] for i in range(CANDIDATES)]
        visited = torch.cat(following)
        subgoal = visited[:, self._achieved]
        state = batch.observation[:count].repeat(CANDIDATES, 1)
        goal = batch.goal[:count].repeat(CANDIDATES, 1)
        with torch.no_grad():
            # One pass for all values.
            value = self._values(torch.cat([state, visited]), torch.cat([subgoal, goal]))
            cost = torch.maximum(*(-value).chunk(2)).reshape(CANDIDATES, count)
            weight = (-cost / _TEMPERATURE).softmax(dim=0)
            wanted = self.actor.goal_normalizer(subgoal).reshape(CANDIDATES, count, -1)
        error = self.imagination(batch.features[:count]) - wanted
        loss: Tensor = (weight * error.square().mean(dim=-1)).sum(dim=0).mean()
        return loss

    def _values(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return the values (batch,) of the actor's actions, as the mean over the critics."""
        features = self.actor.features(observation, goal)
        value: Tensor = self.critic(features, self.actor(features))
        return value if value.ndim == 1 else value.mean(dim=0)

    def _penalty(self, batch: TensorBatch, action: Tensor) -> Tensor:
        """Return the actor penalty of `DDPG` plus `subgoal_prior` times a mean squared difference.

        The difference is between `action` and the target actor's actions for imagined subgoals.
        """
        with torch.no_grad():
            features = self.actor.features(batch.observation, self.imagine(batch.features))
            prior = torch.tanh(self.target_actor(features))
        distance: Tensor = (action - prior).float().square().mean()
        return super()._penalty(batch, action) + self.config.subgoal_prior * distance

    def imagine(self, features: Tensor) -> Tensor:
        """Return subgoals (batch, goal_size) for features (batch, size), in the units of goals.

        `features` are network inputs for a state and a goal. Quaternions have unit length.
        """
        normalizer = self.actor.goal_normalizer
        subgoal: Tensor = normalizer.mean + normalizer.std * self.imagination(features)
        if not self._is_pose:
            return subgoal
        rotation = nn.functional.normalize(subgoal[:, 3:], dim=-1)
        return torch.cat([subgoal[:, :3], rotation], dim=-1)
