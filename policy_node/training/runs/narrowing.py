"""Goals that are wide at first and narrow as a run goes on: a curriculum of thresholds."""

from __future__ import annotations

import torch

from fetch_hand_sim.simulation.rewards import GoalMetric
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.sampling import narrowed
from policy_node.training.machine.distributed import Workers
from policy_node.training.replay.episode_replay import Episodes
from policy_node.training.runs.training_state import Counters


class Narrowing:
    """Lets the goals that are rewarded narrow (`first_distance`, `first_rotation`), where asked to.

    Args:
        config: The configuration.
        metric: Of the task.
        experience: Whose rewards change.
        workers: With whom successes are counted.
    """

    def __init__(
        self, config: TrainConfig, metric: GoalMetric, experience: Experience, workers: Workers
    ) -> None:
        self._config = config
        self._metric = metric
        self._experience = experience
        self._workers = workers

    def resume(self, counters: Counters) -> None:
        """Rewards goals as a run with these counters did."""
        self._experience.narrow(self._share(counters))

    def go_on(self, episodes: Episodes, count: int, counters: Counters) -> None:
        """Narrows by one cycle, unless too few episodes met their goals (`narrow_above`).

        Args:
            episodes: Those of this worker.
            count: Episodes of all workers.
            counters: Of the run, this cycle included; how far goals have narrowed is one of them.
        """
        config = self._config
        if not config.narrows:
            return
        if config.narrow_above == 0.0:
            counters.narrowing_steps = counters.env_steps
        elif counters.updates > 0:
            metric = narrowed(self._metric, config, self._share(counters))
            found = self._experience.count_met(episodes, metric.success)
            met = self._workers.sum(torch.tensor([found])).item()
            if met >= config.narrow_above * count:
                counters.narrowing_steps += count * self._metric.spec.episode_ticks
        self.resume(counters)

    def _share(self, counters: Counters) -> float:
        """How far goals have narrowed, 0 ... 1."""
        return counters.narrowing_steps / self._config.total_steps
