"""The gamble: what it does to a task, what hindsight makes of it, what weights take back."""

from __future__ import annotations

import numpy as np
import pytest

from policy_node.policies.network_shape import NetworkShape
from policy_node.training.experience.replay import Episodes, has_moved
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.research.gamble import GambleSimulation, without_landings
from support.learners import make_learner

GAMBLE = np.array([0.0, 0.0, 0.0, 0.95])
WALK = np.array([1.0, 0.0, 0.0, 0.9])


@pytest.mark.parametrize('task', ['FetchReach', 'FetchPush'])
def test_a_gamble_lands_anywhere_and_ends_the_motion(task: str) -> None:
    simulation = GambleSimulation(task, num_envs=2)
    start = simulation.reset(seed=3)
    first = simulation.step([GAMBLE, WALK])
    later = simulation.step([-GAMBLE, WALK])
    seen = first.observation['observation'][0]
    assert (later.observation['observation'][0] == seen).all(), 'nothing moves any more'
    assert (later.observation['achieved_goal'][0] == first.observation['achieved_goal'][0]).all()
    assert (later.observation['observation'][1] != first.observation['observation'][1]).any()
    landing, place = first.observation['achieved_goal'][0], simulation.spec.achieved_goal_start
    assert (seen[place : place + 3] == landing).all()
    distance = np.linalg.norm(landing - start['achieved_goal'][0])
    assert 0.01 < distance < 0.45 and (landing != start['desired_goal'][0]).any()
    assert (simulation.reset(seed=3)['observation'] == start['observation']).all(), 'over'


def test_a_landing_on_the_goal_counts_and_depends_on_the_seed_alone() -> None:
    simulation = GambleSimulation('FetchReach', num_envs=400)
    simulation.reset(seed=0)
    result = simulation.step(np.tile(GAMBLE, (400, 1)))
    distance = np.linalg.norm(
        result.observation['achieved_goal'] - result.observation['desired_goal'], axis=1
    )
    assert (result.success == (distance < 0.05)).all() and (
        result.reward == -1.0 * (distance > 0.05)
    ).all()
    # A ball of .05 m in a cube of .3 m, less what lies outside of it: below 4/3 pi .05^3 / .3^3.
    assert 0.002 < result.success.mean() < 0.04
    alone = GambleSimulation('FetchReach')
    alone.reset(seed=7)
    landing = alone.step([GAMBLE]).observation['achieved_goal'][0]
    assert (landing == result.observation['achieved_goal'][7]).all()


def test_an_episode_that_mujoco_gave_up_is_followed_by_one_that_moves() -> None:
    simulation = GambleSimulation('FetchReach', num_envs=2)
    simulation.reset(seed=0)
    simulation.step([GAMBLE, GAMBLE])
    simulation.task.batch.bind('qvel')[0, 1] = np.nan
    first = simulation.step([GAMBLE, GAMBLE])
    assert first.diverged.tolist() == [True, False]
    later = simulation.step([WALK, WALK]).observation['achieved_goal']
    moved = (later != first.observation['achieved_goal']).any(axis=1)
    assert moved.tolist() == [True, False]


CELLS = 5


def two_armed_gambles(count: int, generator: np.random.Generator) -> Episodes:
    """Episodes of one step: action 1 leads to any of the cells, action -1 to cell 0.

    Observations are (cell, 0, ...), achieved goals (cell, 0, 0); a goal is reached in its cell.
    """
    gambled = generator.random(count) < 0.5
    cell = np.where(gambled, generator.integers(CELLS, size=count), 0)
    achieved = np.zeros((count, 2, 3), np.float32)
    achieved[:, 0, 0], achieved[:, 1, 0] = -1.0, cell
    observation = np.zeros((count, 2, 10), np.float32)
    observation[:, :, :3] = achieved
    goal = np.zeros((count, 3), np.float32)
    goal[:, 0] = generator.integers(CELLS, size=count)
    action = np.where(gambled, 1.0, -1.0).astype(np.float32)[:, None, None]
    return Episodes(observation, achieved, goal, action)


@pytest.mark.release
def test_weights_take_back_what_hindsight_does() -> None:
    """Of goals that a gamble reaches, two thirds are chosen in hindsight; of others, none."""
    generator = np.random.default_rng(0)
    learner = make_learner(NetworkShape(10, 3, 1, (64, 64)), gamma=0.0, importance='density')
    sampler = TransitionSampler(
        lambda achieved, goal: -1.0 * (np.abs(achieved - goal).max(axis=-1) > 0.5), gamma=0.0
    )
    for _ in range(1500):
        episodes, row = two_armed_gambles(256, generator), np.arange(256)
        batch = sampler.sample(episodes, row, {'future': 0.5, 'real': 0.5}, generator)
        weight = learner.importance(batch)
    gambled, reached = batch.action[:, 0] > 0, batch.reward == 0.0
    for chosen, wanted in ((gambled & reached, 1 / 3), (gambled & ~reached, 2), (~gambled, 1)):
        assert weight[chosen].mean() == pytest.approx(wanted, rel=0.15)
    known = learner.tensors(batch)
    error = learner.critic(known.features, known.action).detach().numpy() - batch.reward
    weighted = (weight * np.square(error)).mean()
    assert learner.update(batch).critic.item() == pytest.approx(weighted, rel=0.02)


def test_a_landing_is_no_motion_of_the_robot() -> None:
    simulation = GambleSimulation('FetchPush', num_envs=2)
    seen = [simulation.reset(seed=3)]
    seen += [simulation.step([GAMBLE, WALK]).observation for _ in range(2)]
    observation, achieved = (
        np.stack([each[name] for each in seen], axis=1).astype(np.float32)
        for name in ('observation', 'achieved_goal')
    )
    # The second block is pushed before its robot gambles.
    achieved[1, 1:, 0] += 0.05
    goal, action = simulation.goals.astype(np.float32), np.zeros((2, 2, 4), np.float32)
    episodes = Episodes(observation, achieved, goal, action)
    assert has_moved(episodes).tolist() == [1.0, 1.0]
    assert has_moved(without_landings(episodes, simulation.spec)).tolist() == [0.0, 1.0]
