"""Experience of PPO: rollouts of the current actor, also for goals in hindsight.

An on-policy gradient needs the actions that the actor would take for the goal in question. An
episode collected for a goal g and replayed for g' contains the actions for g. `importance=none`
ignores this (as PPO-HER, arXiv 2410.22524). `decision` weights each transition of a replayed
episode with

    w_t = prod_{k <= t} pi(a_k | s_k, g') / pi(a_k | s_k, g),

the per-decision weight of hindsight policy gradients (Rauber et al. 2019, arXiv 1711.06006),
normalized tick by tick over the replayed episodes, as in that paper. Later rewards depend on later
actions, which were for g as well. So in an advantage each later error is weighted by the ratios of
the actions between, cut as in V-trace (Espeholt et al. 2018, arXiv 1802.01561).

An episode that is replayed for a goal it achieved itself always succeeds. So the gradient does not
teach the actor to act: leaving the block alone succeeds too, and touching it delays success
(`bench/hindsight_pull.py`). Hindsight policy gradients sum over goals that do not depend on the
episode. The source `outcome` also uses such goals. It moves achieved goals of other episodes to the
start of this one; goals that were met from the start are left out. From eight candidates it takes
the one nearest to the desired goal (as HGG, Ren et al. 2019, arXiv 1906.04279).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array, Array32
from msgs_spec.tasks import TaskSpec
from policy_node.policies.actor import Actor
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import (
    SOURCES,
    RewardFunction,
    displace,
    draw_sources,
    goals_of,
)
from policy_node.training.experience.replay import (
    Episodes,
    Starts,
    Transitions,
    Weigh,
    draw_by,
)
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers
from policy_node.training.research.ppo import PPO, RolloutTransitions

_OUTCOME = 'outcome'
# Number of episodes whose outcomes are used, states of each, and outcomes to choose from.
_EPISODES = 2000
_STATES = 4
_CANDIDATES = 8
_SMALLEST_DEVIATION = 1e-6
# Largest weight of an error by the ratio of its action, and by the ratios of the actions before it.
# The second one only shortens traces.
_LARGEST_RATIO, _LARGEST_TRACE = 10.0, 1.0


@dataclass(frozen=True, slots=True)
class RolloutMaker:
    """Makes transitions with advantages from episodes, for their own and for relabelled goals.

    Attributes:
        critique: Learner that returns values of states and log probabilities of actions.
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        trace: The lambda of the advantages.
        corrects: Whether replayed episodes get per-decision weights.
    """

    critique: PPO
    compute_reward: RewardFunction
    gamma: float
    trace: float
    corrects: bool

    def make(self, episodes: Episodes, goals: Sequence[Array32]) -> RolloutTransitions:
        """Return all transitions of episodes with their own goals, and with each of `goals`.

        Args:
            goals: Arrays (episodes, goal_size) of goals for which all episodes are replayed.

        Returns:
            The transitions of all episodes with their own goals, then with each of `goals`.
            Weighted by `weight`, all advantages have mean 0 and standard deviation 1.
        """
        own = self._under(episodes)
        meant = own['log_probability'] if self.corrects else None
        replayed = [self._under(replace(episodes, desired_goal=goal), meant) for goal in goals]
        all_of = {name: np.concatenate([own[name], *(r[name] for r in replayed)]) for name in own}
        advantage, weight, logs = (
            all_of[name] for name in ('advantage', 'weight', 'log_probability')
        )
        if meant is not None and goals:
            of_replayed = slice(len(episodes), None)
            log_ratio = logs[of_replayed] - np.tile(meant, (len(goals), 1))
            weight[of_replayed] = decision_weights(log_ratio)
        mean = np.average(advantage, weights=weight)
        deviation = np.sqrt(np.average(np.square(advantage - mean), weights=weight))
        advantage = ((advantage - mean) / max(deviation, _SMALLEST_DEVIATION)).astype(np.float32)
        all_of['advantage'] = advantage
        flat = {name: values.reshape(-1, *values.shape[2:]) for name, values in all_of.items()}
        return RolloutTransitions(**flat)

    def _under(self, episodes: Episodes, meant: Array32 | None = None) -> dict[str, Array32]:
        """Compute the transitions of episodes, with advantages, for their `desired_goal`.

        Args:
            meant: Log probabilities (episodes, T) of the actions for the goals before relabelling,
                for importance weights; None computes advantages without such weights.

        Returns:
            Fields of `RolloutTransitions`, (episodes, T, ...).
        """
        observation, action = episodes.observation, episodes.action
        goal = np.repeat(episodes.desired_goal[:, None], episodes.ticks + 1, axis=1)
        achieved = episodes.achieved_goal[:, 1:].astype(np.float64)
        reward = np.asarray(self.compute_reward(achieved, goal[:, 1:].astype(np.float64)))
        value = self.critique.values(observation, goal).astype(np.float64)
        logs = self.critique.log_probabilities(observation[:, :-1], goal[:, :-1], action)
        log_ratio = None if meant is None else logs - meant
        advantage = advantages(reward, value, self.gamma, self.trace, log_ratio)
        return {
            'observation': observation[:, :-1],
            'next_observation': observation[:, 1:],
            'goal': goal[:, :-1],
            'action': action,
            'reward': reward.astype(np.float32),
            'discount': np.full(reward.shape, self.gamma, np.float32),
            'log_probability': logs,
            'advantage': advantage.astype(np.float32),
            'value_target': (advantage + value[:, :-1]).astype(np.float32),
            'weight': np.ones(reward.shape, np.float32),
        }


def advantages(
    reward: Array,
    value: Array,
    gamma: float,
    trace: float,
    log_ratio: NDArray[np.floating] | None = None,
) -> Array:
    """Return generalized advantages (Schulman et al. 2016, arXiv 1506.02438), (episodes, T).

    Args:
        reward: (episodes, T).
        value: (episodes, T + 1); episodes are cut, not terminated, so the last value counts.
        trace: The lambda of generalized advantages.
        log_ratio: log pi(a | s, g') - log pi(a | s, g), (episodes, T), for the goal g' of `reward`
            and the goal g of the actions; None if these goals are the same.
    """
    error = reward + gamma * value[:, 1:] - value[:, :-1]
    ratio = np.ones_like(error)
    if log_ratio is not None:
        ratio = np.exp(np.minimum(log_ratio, np.log(_LARGEST_RATIO), dtype=np.float64))
    found = np.zeros_like(error)
    # Contribution of the ticks from here on to the value of their first state.
    following = np.zeros(len(error))
    for tick in reversed(range(error.shape[1])):
        found[:, tick] = error[:, tick] + gamma * trace * following
        cut = np.minimum(ratio[:, tick], _LARGEST_TRACE)
        following = ratio[:, tick] * error[:, tick] + gamma * trace * cut * following
    return found


def decision_weights(log_ratio: NDArray[np.floating]) -> Array:
    """Return per-decision importance weights (episodes, T), whose mean is 1 at each tick.

    Args:
        log_ratio: log pi(a | s, g') - log pi(a | s, g), (episodes, T), for the replayed goal g' and
            the goal g of the actions.
    """
    logs = np.cumsum(log_ratio, axis=1, dtype=np.float64)
    weight = np.exp(logs - logs.max(axis=0))
    return np.asarray(weight / weight.mean(axis=0))


@dataclass(frozen=True, slots=True)
class Outcomes:
    """Pairs of goals that an episode achieved at its start and later.

    Attributes:
        before: Goals achieved in the first states of episodes, (count, goal_size).
        after: Goals achieved later in these episodes, (count, goal_size), not met by `before`.
    """

    before: Array32
    after: Array32
    metric: GoalMetric

    @classmethod
    def of(cls, episodes: Episodes, metric: GoalMetric, generator: np.random.Generator) -> Outcomes:
        """Draw 4 achieved goals of each episode; keep those that its first state did not meet."""
        row = np.repeat(np.arange(len(episodes)), _STATES)
        tick = generator.integers(1, episodes.ticks + 1, size=len(row))
        before, after = episodes.achieved_goal[row, 0], episodes.achieved_goal[row, tick]
        changed = np.flatnonzero(~metric.success(before, after))
        return cls(before[changed], after[changed], metric)

    def __len__(self) -> int:
        return len(self.after)

    def goals(self, starts: Starts, generator: np.random.Generator) -> Array32:
        """Return for each start the candidate nearest to its desired goal, (batch, goal_size).

        A candidate is the first achieved goal of the episode, moved as from `before` to `after` of
        an outcome. Each start has eight. Without outcomes, the desired goals are returned.
        """
        desired = starts.episodes.desired_goal[starts.row]
        if not len(self):
            return desired
        count = len(desired)
        drawn = generator.integers(len(self), size=_CANDIDATES * count)
        start = np.tile(starts.episodes.achieved_goal[starts.row, 0], (_CANDIDATES, 1))
        candidates = displace(start, self.before[drawn], self.after[drawn])
        wanted = np.tile(desired, (_CANDIDATES, 1))
        near = self.metric.with_changes(reward_type='dense').reward(candidates, wanted)
        best = near.reshape(_CANDIDATES, count).argmax(axis=0)
        goals: Array32 = candidates[best * count + np.arange(count)]
        return goals


def goals_in_hindsight(
    episodes: Episodes,
    mixture: dict[str, float],
    generator: np.random.Generator,
    outcomes: Outcomes | None = None,
) -> Array32:
    """Draw a goal for each whole episode, (episodes, goal_size).

    Args:
        mixture: Probability of each goal source: `future`, `final`, `actual`, ..., `outcome`.
        outcomes: Goals that other episodes have achieved; needed for the source `outcome`.
    """
    count = len(episodes)
    starts = Starts(episodes, np.arange(count), np.zeros(count, np.int64))
    source = draw_sources(mixture, count, generator)
    sources = SOURCES if outcomes is None else {**SOURCES, _OUTCOME: outcomes.goals}
    return goals_of(starts, source, list(mixture), generator, sources)


class OnPolicyExperience(Experience):
    """Draws transitions of the newest cycle, for the goals of episodes and `hindsight_k` others.

    Args:
        config: The configuration; `trace` is the lambda of the advantages.
        weigh: Returns the weight of each episode. The share `moved_share` of a batch is drawn in
            proportion to these weights, the rest with equal probability.
    """

    def __init__(
        self,
        config: TrainConfig,
        spec: TaskSpec,
        workers: Workers,
        sampler: TransitionSampler,
        generator: np.random.Generator,
        critique: PPO,
        metric: GoalMetric,
        weigh: Weigh,
    ) -> None:
        super().__init__(config, spec, workers, sampler, generator, weigh=weigh)
        limits = config.gamma, config.trace, config.importance == 'decision'
        self._maker = RolloutMaker(critique, sampler.compute_reward, *limits)
        self._metric = metric
        self._newest = self.replay.episodes
        self._rollouts: RolloutTransitions | None = None
        self._weight_up_to = np.zeros(0)

    def normalize(self, episodes: Episodes, actor: Actor) -> None:
        """Normalize as `Experience` does; draw later batches from `episodes`, unless it is empty.

        Episodes of earlier cycles are of another actor.
        """
        super().normalize(episodes, actor)
        if len(episodes):
            self._newest, self._rollouts = episodes, None

    def batch(self) -> Transitions:
        """Draw transitions of the newest cycle."""
        # Made before the first update of a cycle, which changes the actor that collected it.
        rollouts = self._rollouts = self._rollouts or self._roll_out()
        row, ticks = self._draw_rows(), self.replay.ticks
        drawn = row * ticks + self.generator.integers(ticks, size=len(row))
        return RolloutTransitions(
            **{each.name: getattr(rollouts, each.name)[drawn] for each in fields(rollouts)}
        )

    def _draw_rows(self) -> NDArray[np.int64]:
        generator, count, share = self.generator, self.batch_size, self.config.moved_share
        row = generator.integers(len(self._weight_up_to), size=count)
        if share > 0.0 and self._weight_up_to[-1] > 0.0:
            chosen = np.flatnonzero(generator.random(count) < share)
            row[chosen] = draw_by(self._weight_up_to, len(chosen), generator)
        return row

    def mixture(self) -> dict[str, float]:
        """Return the probability of each goal source, for the statistics of goals.

        These statistics use single transitions, for which the source `outcome` is not defined.
        The source `episode`, whose goals are similar, takes the share of `outcome`.
        """
        found = dict(super().mixture())
        if _OUTCOME in found:
            found['episode'] = found.get('episode', 0.0) + found.pop(_OUTCOME)
        return found

    def _roll_out(self) -> RolloutTransitions:
        episodes, mixture = self._newest, super().mixture()
        mixture.pop('real', None)
        copies, outcomes = self.config.hindsight_k if mixture else 0, None
        if _OUTCOME in mixture:
            past = self.replay.newest(_EPISODES)
            outcomes = Outcomes.of(past, self._metric, self.generator)
        goals = [
            goals_in_hindsight(episodes, mixture, self.generator, outcomes) for _ in range(copies)
        ]
        self._weight_up_to = np.cumsum(np.tile(self._weigh(episodes), copies + 1))
        return self._maker.make(episodes, goals)
