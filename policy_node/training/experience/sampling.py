"""Transitions made from whole episodes: drawn, their goals exchanged, their rewards recomputed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array32
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import (
    Chosen,
    Drop,
    Held,
    Returns,
    Sparse,
    Threshold,
)
from policy_node.training.experience.conditions import Condition, make_condition
from policy_node.training.experience.frame_skip import HeldSteps
from policy_node.training.experience.goal_choice import CANDIDATES, GOAL_CHOICES, Judge
from policy_node.training.experience.graded import GradedReward
from policy_node.training.experience.hindsight import RewardFunction, draw_sources, flat, goals_of
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.returns import StepCounter, discounted_rewards
from policy_node.training.experience.transitions import Starts, Transitions

# Goals that choosing among several can improve.
_LATER = ('future', 'near')


@dataclass(frozen=True, slots=True)
class TransitionSampler:
    """How transitions are made from episodes.

    Attributes:
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        gamma: Discount of one step.
        steps: How many steps returns have; None is one.
        condition: What values are conditioned on; None is nothing.
        goal_choice: Which future goal is taken, `uniform` or a key of `GOAL_CHOICES`.
        reward_scale: What rewards are multiplied by.
        lost_value: What follows the last valid tick of an episode that is longer; None if that is
            still to be learnt.
        reward_at: How far goals have narrowed, 0 ... 1 -> `compute_reward` of then; None if they
            do not.
        metric: Of the task, whatever rewards are.
    """

    compute_reward: RewardFunction
    gamma: float
    steps: StepCounter | HeldSteps | None = None
    condition: Condition | None = None
    goal_choice: str = 'uniform'
    reward_scale: float = 1.0
    lost_value: float | None = None
    reward_at: Callable[[float], RewardFunction] | None = None
    metric: GoalMetric | None = None

    def at(self, progress: float) -> TransitionSampler:
        """Return the sampler of a run in which goals have narrowed this far, 0 ... 1."""
        if self.reward_at is None:
            return self
        return replace(self, compute_reward=self.reward_at(progress))

    def sample(
        self,
        episodes: Episodes,
        row: NDArray[np.int64],
        mixture: dict[str, float],
        generator: np.random.Generator,
        valid_ticks: NDArray[np.int64] | None = None,
        judge: Judge | None = None,
    ) -> Transitions:
        """Draws a transition of each chosen episode and relabels its goal.

        Args:
            episodes: Episodes to draw from.
            row: Episode of each transition, (batch,).
            mixture: Probability of each goal source; adds up to 1.
            generator: Source of all randomness.
            valid_ticks: Ticks of each episode, from its first, that transitions and achieved goals
                are drawn from; None is all.
            judge: Who chooses goals and cuts returns; without one any goal is taken and no return
                is cut.
        """
        if valid_ticks is None:
            tick = generator.integers(episodes.ticks, size=len(row))
        else:
            tick = generator.integers(valid_ticks.take(row))
        starts = Starts(episodes, row, tick, valid_ticks)
        source = draw_sources(mixture, len(row), generator)
        goal = goals_of(starts, source, list(mixture), generator)
        if judge is not None and self.goal_choice != 'uniform':
            names = np.array(list(mixture))[source]
            rows = np.flatnonzero(np.isin(names, _LATER))
            if len(rows):
                goal[rows] = self._choose(
                    starts.select(rows), names[rows], goal[rows], generator, judge
                )
        steps = np.ones_like(row)
        if self.steps is None and self.condition is None:
            batch = self._single(starts, goal)
        else:
            if self.steps is not None:
                act = None if judge is None else judge.act
                steps = self.steps.count(starts, goal, generator, act)
            batch = self.several(starts, steps, goal, generator)
        if self.lost_value is None:
            return batch
        return _with_losses(starts, steps, batch, self.lost_value)

    def _single(self, starts: Starts, goal: Array32) -> Transitions:
        """Transitions of one step, unconditioned: what nearly every run draws, and fast."""
        episodes, row, tick = starts.episodes, starts.row, starts.tick
        state = row * (episodes.ticks + 1) + tick
        observation = flat(episodes.observation)
        achieved = flat(episodes.achieved_goal).take(state + 1, axis=0)
        reward = self.compute_reward(achieved.astype(np.float64), goal.astype(np.float64))
        return Transitions(
            observation=observation.take(state, axis=0),
            next_observation=observation.take(state + 1, axis=0),
            goal=goal,
            action=flat(episodes.action).take(row * episodes.ticks + tick, axis=0),
            reward=np.asarray(reward * self.reward_scale, dtype=np.float32),
            discount=np.full(len(row), self.gamma, np.float32),
        )

    def several(
        self,
        starts: Starts,
        steps: NDArray[np.int64],
        goal: Array32,
        generator: np.random.Generator,
    ) -> Transitions:
        """Transitions of several steps, or under a condition.

        Args:
            starts: Where they begin.
            steps: How many steps each has, (batch,).
            goal: (batch, goal_size).
            generator: Source of randomness for conditions.
        """
        episodes, row, tick = starts.episodes, starts.row, starts.tick
        condition = self.condition
        drawn = None if condition is None else condition.draw(len(row), generator)

        def reward_after(achieved: Array32, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
            goals = achieved.astype(np.float64), goal[chosen].astype(np.float64)
            if condition is None or drawn is None:
                return np.asarray(self.compute_reward(*goals))
            return condition.reward(*goals, drawn[chosen])

        reward = discounted_rewards(starts, steps, reward_after, self.gamma) * self.reward_scale
        batch = Transitions(
            observation=episodes.observation[row, tick],
            next_observation=episodes.observation[row, tick + steps],
            goal=goal,
            action=episodes.action[row, tick],
            reward=reward.astype(np.float32),
            discount=(self.gamma**steps).astype(np.float32),
        )
        if condition is None or drawn is None:
            return batch
        return replace(
            batch,
            discount=batch.discount * condition.goes_on(drawn),
            condition=condition.inputs(drawn),
            next_condition=condition.inputs(condition.after(drawn)),
        )

    def _choose(
        self,
        starts: Starts,
        names: NDArray[np.str_],
        first: Array32,
        generator: np.random.Generator,
        judge: Judge,
    ) -> Array32:
        """The best of several future goals of each transition, (batch, goal_size)."""
        source = (names == _LATER[1]).astype(np.intp)
        candidates = [first]
        for _ in range(CANDIDATES - 1):
            candidates.append(goals_of(starts, source, _LATER, generator))
        repeated = starts.select(np.tile(np.arange(len(names)), CANDIDATES))
        batch = self._single(repeated, np.concatenate(candidates))
        score = GOAL_CHOICES[self.goal_choice](judge, batch)
        # The first of equals.
        best: NDArray[np.intp] = score.reshape(CANDIDATES, -1).argmax(axis=0)
        return np.stack(candidates)[best, np.arange(len(names))]


def make_sampler(config: TrainConfig, metric: GoalMetric) -> TransitionSampler:
    """Returns what makes transitions as a configuration asks for.

    Args:
        config: The configuration.
        metric: Distances and thresholds of the task, and its reward.

    Raises:
        ValueError: If the configuration would put another reward in the place of the task's own.
    """
    _require_reward_kept(config, metric)

    sparse = config.find(Sparse) or Sparse()

    def reward_at(progress: float) -> RewardFunction:
        then = narrowed(metric, sparse, progress)
        return GradedReward(then, sparse.reward_grades) if sparse.reward_grades else then.reward

    counter: StepCounter | HeldSteps | None = None
    if held := config.find(Held):
        counter = HeldSteps(held.longest_hold)
    if returns := config.find(Returns):
        limits = returns.correction, returns.trace, returns.cut_distance
        counter = StepCounter(returns.n_step, *limits)
    chosen, drop = config.find(Chosen), config.find(Drop)
    return TransitionSampler(
        reward_at(1.0),
        config.tick_gamma,
        counter,
        make_condition(config, narrowed(metric, sparse, 1.0)),
        chosen.goal_choice if chosen else 'uniform',
        config.tick_share,
        config.lowest_value if drop and drop.drop_is_lost else None,
        reward_at if sparse.narrows else None,
        metric,
    )


def _require_reward_kept(config: TrainConfig, metric: GoalMetric) -> None:
    if not metric.has_own_reward:
        return
    owner = f'that of {metric.spec.name} itself ({type(metric).__name__})'
    sparse = config.find(Sparse)
    if sparse and sparse.reward_grades:
        raise ValueError(
            f'reward_grades {sparse.reward_grades} is a reward in the place of {owner}; allowed: '
            'none (--set reward_grades=)'
        )
    if config.find(Threshold):
        raise ValueError(
            f'condition threshold has a reward in the place of {owner}; allowed: none, horizon'
        )


def narrowed(metric: GoalMetric, reward: Sparse, progress: float) -> GoalMetric:
    """Return the metric that rewards goals which have narrowed this far, 0 ... 1."""
    left = max(1.0 - 1.5 * progress, 0.0)
    return scale_thresholds(
        metric,
        reward.reward_distance * reward.first_distance**left,
        reward.reward_rotation * reward.first_rotation**left,
    )


def _with_losses(
    starts: Starts, steps: NDArray[np.int64], batch: Transitions, value: float
) -> Transitions:
    """Transitions into the last valid state: what follows is known and bootstraps nothing."""
    lost = (starts.tick + steps == starts.last) & (starts.last < starts.episodes.ticks)
    reward = batch.reward + lost * batch.discount * np.float32(value)
    return replace(batch, reward=reward.astype(np.float32), discount=batch.discount * ~lost)


def scale_thresholds(metric: GoalMetric, distance: float, rotation: float) -> GoalMetric:
    """A metric with these shares of the success distance and rotation of `metric`."""
    spec = replace(metric.spec, distance_threshold=metric.spec.distance_threshold * distance)
    if spec.rotation_threshold is not None:
        spec = replace(spec, rotation_threshold=spec.rotation_threshold * rotation)
    return metric.with_changes(spec=spec)
