"""Batches that depend on the learner: chosen hindsight goals and corrected n-step returns.

An n-step return propagates rewards n times as fast. But it contains the actions taken, not those
that the actor would take now. `correction=lambda` draws the number of steps from a geometric
distribution cut at n. The mean target is then the truncated lambda-return (Sutton and Barto 2018,
12.3); the average of MHER(lambda) (arXiv 2102.12962) gives the longest return less weight.
`correction=cut` ends a return before the first action that differs from the actor's action for the
same goal by more than `cut_distance`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from policy_node.policies.actor import Actor
from policy_node.training.experience.hindsight import SOURCES, draw_sources, goals_of
from policy_node.training.experience.replay import Starts, Transitions
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.ddpg import DDPG, CriticLoss

# Number of future goals to choose from.
CANDIDATES = 8


@torch.no_grad()
def bellman(learner: DDPG, batch: Transitions) -> Array32:
    """Return |value - target| of each transition, (batch,), averaged over the critics."""
    with learner.precision():
        errors = CriticLoss.errors(learner.critic_loss, learner, learner.tensors(batch))
    error = errors.abs().float()
    found: Array32 = (error if error.ndim == 1 else error.mean(dim=0)).cpu().numpy()
    return found


@torch.no_grad()
def uncertain(learner: DDPG, batch: Transitions) -> Array32:
    """Return the standard deviation of the critics' values of each transition, (batch,)."""
    tensors = learner.tensors(batch)
    with learner.precision():
        value = learner.critic(tensors.features, tensors.action).float()
    spread: Array32 = value.std(dim=0).cpu().numpy()
    return spread


SCORES: dict[str, Callable[[DDPG, Transitions], Array32]] = {
    'bellman': bellman,
    'uncertain': uncertain,
}
"""Scores of transitions by `goal_choice`."""


@dataclass(frozen=True, kw_only=True)
class ChoosingSampler(TransitionSampler):
    """Draws 8 future goals per transition and keeps the one with the highest score.

    Attributes:
        judge: The learner whose critics score the goals.
        choice: The score, `bellman` (error of the value) or `uncertain` (spread of the critics).
    """

    judge: DDPG
    choice: str

    def relabel(
        self, starts: Starts, mixture: dict[str, float], generator: np.random.Generator
    ) -> Array32:
        """Draw a goal for each transition, (batch, goal_size); choose future goals by score."""
        source = draw_sources(mixture, len(starts.row), generator)
        goal = goals_of(starts, source, list(mixture), generator)
        rows = np.flatnonzero(np.array(list(mixture))[source] == 'future')
        if len(rows):
            goal[rows] = self._best(starts.select(rows), goal[rows], generator)
        return goal

    def _best(self, starts: Starts, first: Array32, generator: np.random.Generator) -> Array32:
        """Return the highest-scored goals among `first` and seven new future goals for each."""
        more = (SOURCES['future'](starts, generator) for _ in range(CANDIDATES - 1))
        candidates = [first, *more]
        repeated = starts.select(np.tile(np.arange(len(first)), CANDIDATES))
        batch = self.single(repeated, np.concatenate(candidates))
        score = SCORES[self.choice](self.judge, batch)
        # The first of equals.
        best: NDArray[np.intp] = score.reshape(CANDIDATES, -1).argmax(axis=0)
        return np.stack(candidates)[best, np.arange(len(first))]


@dataclass(frozen=True, kw_only=True)
class LambdaSampler(TransitionSampler):
    """Draws returns of random n; their mean is the truncated lambda-return with lambda `trace`."""

    trace: float = 0.7

    def steps(
        self, starts: Starts, goal: Array32, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw the length of each n-step return, (batch,): 1 step or more, up to `most_steps`."""
        most = super().steps(starts, goal, generator)
        return np.minimum(generator.geometric(1.0 - self.trace, len(most)), most)


@dataclass(frozen=True, kw_only=True)
class CuttingSampler(TransitionSampler):
    """Ends n-step returns before the first action that is far from the actor's action.

    Attributes:
        actor: The actor that learns; its actions are compared with those in a return.
        cut_distance: Largest root mean square distance of an action in a return from that action.
    """

    actor: Actor
    cut_distance: float = 0.3

    def steps(
        self, starts: Starts, goal: Array32, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return the length of each n-step return, (batch,): 1 step or more, up to `most_steps`."""
        most = super().steps(starts, goal, generator)
        steps = np.ones_like(most)
        episodes = starts.episodes
        for step in range(1, self.most_steps):
            going = np.flatnonzero((steps == step) & (most > step))
            if not len(going):
                break
            place = starts.row[going], starts.tick[going] + step
            taken = episodes.action[place]
            own = self.actor.act(episodes.observation[place], goal[going])
            distance = np.sqrt(np.square(taken - own).mean(axis=-1))
            steps[going[distance <= self.cut_distance]] += 1
        return steps
