"""Experience of a learner that learns from what its present actor did, and from nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import TaskSpec
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Ppo
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import OUTCOME
from policy_node.training.experience.outcomes import EPISODES, Outcomes, with_outcomes_achieved
from policy_node.training.experience.replay import draw_by
from policy_node.training.experience.rollouts import (
    Critique,
    RolloutMaker,
    Rollouts,
    goals_in_hindsight,
)
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.experience.transitions import Transitions
from policy_node.training.machine.distributed import Workers


class OnPolicyExperience(Experience):
    """Whole episodes of the newest cycle, with their own goals and `hindsight_k` others each.

    Args:
        config: The configuration; `trace` is the lambda of the advantages.
        spec: The task.
        workers: This worker among all.
        sampler: Knows the rewards; makes transitions for the normalisers.
        generator: Source of all randomness.
        critique: Of the actor as it is.
    """

    def __init__(
        self,
        config: TrainConfig,
        spec: TaskSpec,
        workers: Workers,
        sampler: TransitionSampler,
        generator: np.random.Generator,
        critique: Critique,
    ) -> None:
        super().__init__(config, spec, workers, sampler, generator)
        options = config.find(Ppo) or Ppo()
        limits = options.gamma, options.trace, options.importance == 'decision'
        self._maker = RolloutMaker(critique, sampler.compute_reward, *limits)
        self._metric = sampler.metric
        self._newest = workers.share(config.collect.num_envs)
        self._rollouts: Rollouts | None = None
        self._made_after = -1
        self._weight_up_to = np.zeros(0)

    def batch(self, env_steps: int) -> Transitions:
        """Draws from the rollouts of the newest cycle; the first call after it makes them."""
        if self._rollouts is None or env_steps != self._made_after:
            self._rollouts, self._made_after = self._roll_out(), env_steps
            self._weight_up_to = np.cumsum(self._weigh(self._rollouts.episodes))
        return self._rollouts.draw(self._draw_rows(), self.config.learner.gamma, self.generator)

    def _draw_rows(self) -> NDArray[np.int64]:
        """Draws the rollout of each transition of a batch."""
        generator, count, share = self.generator, self.batch_size, self.config.replay.moved_share
        row = generator.integers(len(self._weight_up_to), size=count)
        if share > 0.0 and self._weight_up_to[-1] > 0.0:
            chosen = np.flatnonzero(generator.random(count) < share)
            row[chosen] = draw_by(self._weight_up_to, len(chosen), generator)
        return row

    def mixture(self) -> dict[str, float]:
        """Probability of each goal source of single transitions."""
        return with_outcomes_achieved(super().mixture())

    def _roll_out(self) -> Rollouts:
        # Fewer where MuJoCo lost some: those before are of another actor.
        episodes = self.replay.newest(min(self._newest, self.replay.last_added))
        mixture = super().mixture()
        mixture.pop('real', None)
        copies, outcomes = self.config.goals.hindsight_k if mixture else 0, None
        if OUTCOME in mixture and self._metric is not None:
            past = self.replay.newest(EPISODES)
            outcomes = Outcomes.of(past, self._metric, self.generator)
        goals = [
            goals_in_hindsight(episodes, mixture, self.generator, outcomes) for _ in range(copies)
        ]
        return self._maker.make(episodes, goals)
