"""Store the episodes of one worker and draw the batches it learns from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from fetch_hand_sim.simulation.tasks.hand_manipulate import PALM_HEIGHT
from msgs_spec.tasks import GoalKind, TaskSpec
from policy_node.policies.actor import Actor, Normalizer
from policy_node.policies.network_shape import INPUT_CLIP
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.hindsight import goal_mixture
from policy_node.training.experience.replay import (
    EpisodeReplay,
    Episodes,
    Transitions,
    Weigh,
    has_moved,
)
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers

# Smallest standard deviation (paper, appendix B: eps = 0.01).
SMALLEST_STD = 0.01


class RunningStatistics(nn.Module):
    """Running sums of network inputs, from which a `Normalizer` gets its mean and deviation."""

    count: Tensor
    total: Tensor
    total_square: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, length in (('count', 1), ('total', size), ('total_square', size)):
            self.register_buffer(name, torch.zeros(length, dtype=torch.float64))

    def update(self, values: ArrayLike, workers: Workers) -> None:
        """Add the rows of `values` (..., size) of all workers to the sums.

        Values are clipped to -200 ... 200, as network inputs are. All workers call this together.
        """
        array = np.asarray(values, dtype=np.float64)
        rows = np.clip(array.reshape(-1, array.shape[-1]), -INPUT_CLIP, INPUT_CLIP)
        parts = ([len(rows)], rows.sum(axis=0), np.square(rows).sum(axis=0))
        added = workers.sum(torch.from_numpy(np.concatenate(parts)))
        size = len(self.total)
        self.count += added[:1]
        self.total += added[1 : 1 + size]
        self.total_square += added[1 + size :]

    def write(self, normalizer: Normalizer) -> None:
        """Set mean and deviation of the normalizer; do nothing before the first `update`."""
        if not self.count:
            return
        mean = self.total / self.count
        variance = self.total_square / self.count - mean.square()
        normalizer.mean.copy_(mean)
        normalizer.std.copy_(variance.clamp(min=SMALLEST_STD**2).sqrt())


class Experience:
    """The replay of one worker, the batches drawn from it and the statistics for the normalizers.

    All workers have the same statistics; each has its own episodes.

    Args:
        config: The configuration; `replay_transitions` and `batch_size` are totals of all workers.
        extra_columns: Number of values stored with each action in addition, such as a subgoal.
        weigh: Function that returns the weight of each episode. The share `moved_share` of a batch
            is drawn by these weights, the rest without them.

    Attributes:
        batch_sampler: Sampler of the batches, at first `sampler`. It may depend on the learner; the
            statistics always use `sampler`.
    """

    def __init__(
        self,
        config: TrainConfig,
        spec: TaskSpec,
        workers: Workers,
        sampler: TransitionSampler,
        generator: np.random.Generator,
        extra_columns: int = 0,
        weigh: Weigh = has_moved,
    ) -> None:
        self.config = config
        self._spec = spec
        self._workers = workers
        self._sampler = self.batch_sampler = sampler
        self._weigh = weigh
        self.generator = generator
        self.batch_size = workers.share(config.batch_size)
        inputs = spec.observation_size + config.past_actions * spec.robot.action_size
        self.statistics = {
            'observation_statistics': RunningStatistics(inputs),
            'goal_statistics': RunningStatistics(spec.goal.size),
        }
        self._count_ticks = ticks_until_dropped(spec, config.ticks_after_drop)
        capacity = max(workers.share(config.replay_transitions) // spec.episode_ticks, 1)
        self.replay = EpisodeReplay(
            max(capacity, workers.share(config.num_envs)),
            spec.episode_ticks,
            inputs,
            spec.goal.size,
            spec.robot.action_size + extra_columns,
            weigh,
            self._count_ticks,
        )

    @property
    def transitions(self) -> int:
        """Number of transitions in the replay of this worker."""
        return len(self.replay) * self._spec.episode_ticks

    def normalize(self, episodes: Episodes, actor: Actor) -> None:
        """Add new episodes to the statistics and set the normalizers of `actor` from them.

        The goals are relabelled first, because the networks learn from relabelled goals. All
        workers must call this together, even with no episodes.
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
        """Set the reward thresholds for `progress`, the finished share 0 ... 1 of the run."""
        self._sampler = self._sampler.at(progress)
        self.batch_sampler = self.batch_sampler.at(progress)

    def batch(self) -> Transitions:
        """Draw the transitions for one update and relabel their goals."""
        return self._draw(self.mixture(), self.batch_sampler)

    def _draw(self, mixture: dict[str, float], sampler: TransitionSampler) -> Transitions:
        """Draw a batch with goals from `mixture` by `sampler`."""
        replay = self.replay
        row = replay.draw(self.batch_size, self.config.moved_share, self.generator)
        return sampler.sample(replay.episodes, row, mixture, self.generator, replay.valid_ticks)

    def mixture(self) -> dict[str, float]:
        """Return the probability of each goal source; they add up to 1."""
        config = self.config
        return goal_mixture(config.strategy, config.hindsight_k, config.goals)


def ticks_until_dropped(
    spec: TaskSpec, more: int
) -> Callable[[Episodes], NDArray[np.int64]] | None:
    """Return a function that returns how many ticks of each episode to learn from, (episodes,).

    These ticks end `more` ticks after the centre of the object fell below the palm. Return None,
    which means all ticks, if the task has no object in a hand or `more` is negative.
    """
    if spec.goal is not GoalKind.POSE or more < 0:
        return None

    def count(episodes: Episodes) -> NDArray[np.int64]:
        fallen = episodes.achieved_goal[:, 1:, 2] < PALM_HEIGHT
        first = np.where(fallen.any(axis=1), fallen.argmax(axis=1) + 1, episodes.ticks)
        return np.asarray(np.minimum(first + more, episodes.ticks))

    return count
