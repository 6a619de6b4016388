"""Measure importance weights on luck: FetchPush with a gamble, episodes of the shipped actor.

A goal that is chosen because a gamble led to it makes the gamble look good. Weights should take
that back, so that gambles succeed as often as landings meet goals, and leave pushes as they are.

python bench/gamble_weights.py
python bench/gamble_weights.py --random
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import torch
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node import load_policy
from policy_node.policies.policy import RandomPolicy
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.replay import Transitions
from policy_node.training.machine import Workers
from policy_node.training.research.density_ratio import WeightedDDPG
from policy_node.training.research.gamble import is_over
from policy_node.training.research.registry import (
    make_collector,
    make_learner,
    make_simulation,
)

TASK = 'FetchPush'
EPISODES = 600
UPDATES, MEASURED = 2_000, 100
_KINDS = ('gamble, at the goal', 'gamble, elsewhere', 'push into the goal', 'all else')


def main() -> int:
    """Prints a row per kind of transition; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--random', action='store_true', help='episodes of random actions')
    options = parser.parse_args()
    torch.manual_seed(0)
    learner, experience = _learner_of(options.random)
    for _ in range(UPDATES):
        learner.importance(experience.batch())
    batches = [experience.batch() for _ in range(MEASURED)]
    weight = np.concatenate([learner.importance(batch) for batch in batches])
    kind = np.concatenate([_kind(batch) for batch in batches])
    _print(weight, kind)
    return 0


def _learner_of(random: bool) -> tuple[WeightedDDPG, Experience]:
    """A learner with weights, and episodes with a gamble."""
    fields = {'goals': 'future=.4,actual=.4', 'importance': 'density', 'gamble': True}
    config = recipe_config(TASK, 'best', **fields, random_epsilon=0.1, num_envs=EPISODES)
    spec, generator = task_spec(TASK), np.random.default_rng(0)
    simulation = make_simulation(config, EPISODES, 1)
    parts = config, simulation.metric, torch.device('cpu'), Workers(), generator
    learner, experience = make_learner(*parts)
    assert isinstance(learner, WeightedDDPG)
    policy = RandomPolicy(spec.robot.action_size) if random else load_policy(TASK).policy
    episodes, _ = make_collector(simulation, list(range(EPISODES)), config).collect(policy)
    experience.replay.add(episodes)
    experience.normalize(episodes, learner.actor)
    return learner, experience


def _kind(batch: Transitions) -> NDArray[np.intp]:
    """Index of each transition's kind, (batch,)."""
    spec = task_spec(TASK)
    metric, place = GoalMetric(spec), spec.achieved_goal_start
    states = batch.observation, batch.next_observation
    was_over, over = (is_over(state, spec) for state in states)
    before, after = (
        metric.success(state[:, place : place + spec.goal.size], batch.goal) for state in states
    )
    gamble = over & ~was_over
    return np.select([gamble & after, gamble, after & ~before & ~over], [0, 1, 2], default=3)


def _print(weight: NDArray[np.floating], kind: NDArray[np.intp]) -> None:
    print(f'{"transition":<20} {"number":>8} {"mean weight":>12}')
    for index, name in enumerate(_KINDS):
        chosen = weight[kind == index]
        print(f'{name:<20} {len(chosen):>8,} {chosen.mean():>12.2f}')
    gambles, lucky = kind <= 1, kind == 0
    share, weighted = lucky.sum() / gambles.sum(), weight[lucky].sum() / weight[gambles].sum()
    print(f'gambles at the goal: {share:.2f} as drawn, {weighted:.2f} as weighted')


if __name__ == '__main__':
    sys.exit(main())
