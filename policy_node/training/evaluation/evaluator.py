"""When a run evaluates its actor, and by which rule."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.actor import Actor
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.evaluation.episodes import EpisodeOutcomes, evaluate, wilson_interval

# Seeds of evaluation episodes start here; those of training runs stay far below.
EVALUATION_SEED = 1_000_000_000


def training_seeds(sequence: np.random.SeedSequence, count: int) -> list[int]:
    """Return seeds of `count` training episodes; evaluation never uses them."""
    return [int(seed) % EVALUATION_SEED for seed in sequence.generate_state(count) >> 2]


class Evaluator:
    """Evaluates on the same episodes each time, in simulations of its own.

    Training episodes therefore do not depend on whether there was an evaluation between them.

    Attributes:
        others: Policies to evaluate beside the actor, by column of `progress.csv`.
    """

    def __init__(self, simulation: Simulation, config: TrainConfig) -> None:
        self._simulation = simulation
        self._config = config
        self.others: dict[str, Policy] = {}

    def evaluate(self, actor: Actor, best_success: float) -> EpisodeOutcomes:
        """Runs the episodes, fewer once their success cannot reach `best_success` any more.

        "Cannot" means that it lies above the 95 % interval of the episodes so far.
        """
        rule = self._config.collect.success_rule

        def hopeless(outcomes: EpisodeOutcomes) -> bool:
            count = int(successes(outcomes, rule).sum())
            return wilson_interval(count, len(outcomes))[1] < best_success

        episodes = self._config.run.evaluation_episodes
        return evaluate(self._simulation, actor, episodes, EVALUATION_SEED, hopeless)

    def evaluate_others(self) -> dict[str, float]:
        """Return the success rates of the other policies in all episodes, by column."""
        episodes, rule = self._config.run.evaluation_episodes, self._config.collect.success_rule
        found = {}
        for column, policy in self.others.items():
            outcomes = evaluate(self._simulation, policy, episodes, EVALUATION_SEED)
            found[column] = success_rate(outcomes, rule)
        return found

    def is_complete(self, outcomes: EpisodeOutcomes) -> bool:
        """Return whether an evaluation ran all its episodes, so that it may select the best."""
        return len(outcomes) >= self._config.run.evaluation_episodes


def successes(outcomes: EpisodeOutcomes, success_rule: str) -> NDArray[np.bool_]:
    """Success of each episode at the last step, by a rule."""
    paper = success_rule == 'paper'
    return outcomes.success_paper if paper else outcomes.success_gymnasium


def success_rate(outcomes: EpisodeOutcomes, success_rule: str) -> float:
    """Share of episodes that succeed at the last step, by a rule."""
    return float(successes(outcomes, success_rule).mean())
