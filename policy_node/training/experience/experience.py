"""What a worker has seen, and the batches it learns from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import TaskSpec
from policy_node.policies.actor import Actor
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Drop, Held, Hierarchical
from policy_node.training.experience.episode_weights import episode_weights, ticks_until_dropped
from policy_node.training.experience.goal_choice import Judge
from policy_node.training.experience.hindsight import complete_mixture, goal_mixture
from policy_node.training.experience.replay import EpisodeReplay, Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.experience.statistics import RunningStatistics
from policy_node.training.experience.subgoals import subgoal_columns
from policy_node.training.experience.transitions import Transitions
from policy_node.training.machine.distributed import Workers


class Experience:
    """Replay and normaliser statistics of one worker; statistics are shared by all workers.

    Args:
        config: The configuration; `replay_transitions` and `batch_size` are totals.
        spec: The task.
        workers: This worker among all.
        sampler: Makes transitions.
        generator: Source of all randomness.

    Attributes:
        config: The configuration.
        judge: Who chooses goals and cuts returns, where the configuration asks for it.
        replay: The episodes held.
        statistics: Running statistics of observations and goals, by name.
        generator: Source of relabelling and drawing.
        batch_size: This worker's part of a batch.
    """

    def __init__(
        self,
        config: TrainConfig,
        spec: TaskSpec,
        workers: Workers,
        sampler: TransitionSampler,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self._spec = spec
        self._workers = workers
        self._sampler = sampler
        self.judge: Judge | None = None
        self.generator = generator
        self.batch_size = workers.share(config.learner.batch_size)
        inputs = spec.observation_size + config.network.past_actions * spec.robot.action_size
        self.statistics = {
            'observation_statistics': RunningStatistics(inputs),
            'goal_statistics': RunningStatistics(spec.goal.size),
        }
        drop, guided = config.find(Drop), config.find(Hierarchical)
        self._count_ticks = ticks_until_dropped(spec, drop.ticks_after_drop if drop else -1)
        self._weigh = episode_weights(
            config.replay.episode_weights, spec, config.collect.control_hz, config.collect.gamble
        )
        capacity = max(workers.share(config.replay.replay_transitions) // spec.episode_ticks, 1)
        self.replay = EpisodeReplay(
            max(capacity, workers.share(config.collect.num_envs)),
            spec.episode_ticks,
            inputs,
            spec.goal.size,
            spec.robot.action_size
            + (config.find(Held) is not None)
            + subgoal_columns(guided.subgoal_every if guided else 0, spec.goal.size),
            self._weigh,
            self._count_ticks,
        )

    @property
    def transitions(self) -> int:
        """Transitions held."""
        return len(self.replay) * self._spec.episode_ticks

    def normalize(self, episodes: Episodes, actor: Actor) -> None:
        """Adds episodes to the statistics and gives these to the actor; all workers together.

        Goals count as the networks will see them: relabelled.
        """
        observation, goal = episodes.observation[:, :-1], episodes.desired_goal
        if len(episodes):
            row = np.repeat(np.arange(len(episodes)), episodes.ticks)
            valid = None if self._count_ticks is None else self._count_ticks(episodes)
            mixture = self.mixture()
            goal = self._sampler.sample(episodes, row, mixture, self.generator, valid).goal
        for name, values, normalizer in (
            ('observation_statistics', observation, actor.observation_normalizer),
            ('goal_statistics', goal, actor.goal_normalizer),
        ):
            self.statistics[name].update(values, self._workers)
            self.statistics[name].write(normalizer)

    def narrow(self, progress: float) -> None:
        """Rewards goals as a run does in which they have narrowed this far, 0 ... 1."""
        self._sampler = self._sampler.at(progress)

    def batch(self, env_steps: int) -> Transitions:
        """Draws the transitions of one update, after `env_steps` environment steps."""
        del env_steps
        return self._draw(self.mixture())

    def _draw(self, mixture: dict[str, float]) -> Transitions:
        """Draws transitions with goals from the sources of a mixture, and rewards of now."""
        replay, generator = self.replay, self.generator
        row = self._draw_rows()
        return self._sampler.sample(
            replay.episodes, row, mixture, generator, replay.valid_ticks, self.judge
        )

    def _draw_rows(self) -> NDArray[np.int64]:
        """Draws the episode of each transition of a batch."""
        return self.replay.draw(self.batch_size, self.config.replay.moved_share, self.generator)

    def mixture(self) -> dict[str, float]:
        """Return the probability of each goal source."""
        goals = self.config.goals
        return complete_mixture(goals.goals) or goal_mixture(goals.strategy, goals.hindsight_k)
