"""Hindsight relabelling on episodes whose goals contain the episode and tick they come from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from msgs_spec.rotations import quaternion_from_axis_angle
from policy_node.training.configuration import config
from policy_node.training.configuration.flat import parse_value
from policy_node.training.experience.hindsight import (
    SOURCES,
    draw_sources,
    goal_mixture,
    goals_of,
)
from policy_node.training.experience.replay import Episodes, Starts
from policy_node.training.experience.sampling import TransitionSampler

COUNT, TICKS = 6, 14
# Longest displacement, ticks.
LONGEST = 10


@pytest.fixture
def episodes():
    """Achieved goals are (episode, state), desired goals (100 + episode, 0)."""
    row, state = np.meshgrid(np.arange(COUNT), np.arange(TICKS + 1), indexing='ij')
    achieved = np.stack([row, state], axis=-1).astype(np.float32)
    desired = np.stack([100 + np.arange(COUNT), np.zeros(COUNT)], axis=-1).astype(np.float32)
    action = achieved[:, :TICKS] + 0.5
    return Episodes(np.concatenate([achieved, achieved], axis=-1), achieved, desired, action)


def relabelled(episodes, row, tick, mixture, generator):
    """Goals of transitions `tick` of episodes `row`, from sources drawn from a mixture."""
    source = draw_sources(mixture, len(row), generator)
    return goals_of(Starts(episodes, row, tick), source, list(mixture), generator)


def draw(episodes, strategy):
    generator = np.random.default_rng(1)
    row, tick = (generator.integers(limit, size=20_000) for limit in (COUNT, TICKS))
    return row, tick, relabelled(episodes, row, tick, goal_mixture(strategy, 4), generator)


def test_the_configuration_allows_the_sources_that_exist():
    assert set(config.SOURCES) - {'real', 'outcome'} == set(SOURCES)


def test_none_keeps_every_goal(episodes):
    row, _, goal = draw(episodes, 'none')
    assert (goal == episodes.desired_goal[row]).all()


@pytest.mark.parametrize(
    ('strategy', 'kept', 'own_desired', 'own_achieved'),
    [
        ('future', 0.2, 1.0, 1.0),
        ('final', 0.2, 1.0, 1.0),
        ('episode', 0.2, 1.0, 1.0),
        ('random', 0.2, 1.0, 1 / COUNT),
        ('futureactual', 0.6, 1 / 3 + 2 / 3 / COUNT, 1.0),
    ],
)
def test_goals_are_from_the_episode_and_the_ticks_of_their_strategy(
    episodes, strategy, kept, own_desired, own_achieved
):
    """`kept` is the share of desired goals; `own_...` are the shares from the same episode."""
    row, tick, goal = draw(episodes, strategy)
    desired, achieved = goal[:, 0] >= 100, goal[:, 0] < 100
    assert desired.mean() == pytest.approx(kept, abs=0.015)
    assert (goal[desired, 0] == 100 + row[desired]).mean() == pytest.approx(own_desired, abs=0.02)
    assert (goal[achieved, 0] == row[achieved]).mean() == pytest.approx(own_achieved, abs=0.02)
    for start in range(TICKS):
        first = {'final': TICKS, 'episode': 1, 'random': 1}.get(strategy, start + 1)
        state = goal[achieved & (tick == start), 1]
        assert set(state.tolist()) == set(range(first, TICKS + 1))
        assert state.mean() == pytest.approx((first + TICKS) / 2, abs=0.35)


def test_displaced_goals_are_near_the_state_and_do_not_depend_on_the_step(episodes):
    generator = np.random.default_rng(2)
    row, tick = (generator.integers(limit, size=5_000) for limit in (COUNT, TICKS))
    goal = relabelled(episodes, row, tick, {'displaced': 1.0}, generator)
    # Each episode here moves by one a tick.
    moved = goal - np.stack([row, tick], axis=1)
    assert set(map(tuple, moved.tolist())) == {(0.0, float(span)) for span in range(1, LONGEST + 1)}
    # The same draws where all these steps lead elsewhere: only what is drawn there differs.
    changed = episodes.achieved_goal.copy()
    changed[0, 5:] += 50.0
    row, tick, drawn = np.zeros(2_000, np.int64), np.full(2_000, 4), []
    for part in (episodes, dataclasses.replace(episodes, achieved_goal=changed)):
        seeded = np.random.default_rng(4)
        drawn.append(relabelled(part, row, tick, {'displaced': 1.0}, seeded))
    assert (drawn[0] == drawn[1]).all(axis=1).mean() > 1 - 1 / COUNT


def test_no_displacement_is_taken_from_after_an_end(episodes):
    valid = np.array([1, 2, 3, 4, 5, TICKS])
    achieved = episodes.achieved_goal.copy()
    for row, last in enumerate(valid):
        achieved[row, last + 1 :] += 1_000.0
    cut = dataclasses.replace(episodes, achieved_goal=achieved)
    row, tick = np.full(5_000, COUNT - 1), np.zeros(5_000, np.int64)
    starts = Starts(cut, row, tick, valid)
    source = np.zeros(len(row), np.int64)
    goal = goals_of(starts, source, ['displaced'], np.random.default_rng(5))
    assert set(goal[:, 1].tolist()) == {float(span) for span in range(1, LONGEST + 1)}


def test_displaced_poses_are_turned_as_another_episode_turned():
    angle = np.linspace(0.0, 1.0, TICKS + 1)
    axes = np.eye(3)[:COUNT]
    poses = np.zeros((3, TICKS + 1, 7))
    poses[:, :, 3:] = quaternion_from_axis_angle(
        np.broadcast_to(axes[:, None], (3, TICKS + 1, 3)), np.broadcast_to(angle, (3, TICKS + 1))
    )
    still = np.zeros((3, TICKS, 20))
    episodes = Episodes(poses, poses, poses[:, -1], still)
    generator = np.random.default_rng(3)
    row, tick = (generator.integers(limit, size=500) for limit in (3, TICKS))
    goal = relabelled(episodes, row, tick, {'displaced': 1.0}, generator)
    np.testing.assert_allclose(np.linalg.norm(goal[:, 3:], axis=1), 1.0, rtol=1e-6)
    turned = 2.0 * np.arccos((goal[:, 3:] * poses[row, tick, 3:]).sum(axis=1).clip(-1.0, 1.0))
    steps = turned / (angle[1] - angle[0])
    np.testing.assert_allclose(steps, steps.round(), atol=1e-4)
    assert set(steps.round().astype(int).tolist()) == set(range(1, LONGEST + 1))


@pytest.mark.parametrize(
    ('text', 'mixture'),
    [
        ('future=.4,actual=.4', {'future': 0.4, 'actual': 0.4, 'real': 0.2}),
        ('final=1', {'final': 1.0}),
        ('real=.5, random=.25', {'real': 0.75, 'random': 0.25}),
    ],
)
def test_goal_sources_can_be_mixed(text, mixture):
    assert goal_mixture('none', goals=parse_value('goals', text)) == pytest.approx(mixture)


@pytest.mark.parametrize('source', ['future', 'final', 'episode', 'random'])
def test_nothing_is_drawn_from_after_the_last_valid_tick(episodes, source):
    valid = np.array([1, 2, 5, 7, TICKS, TICKS])
    generator = np.random.default_rng(2)
    row = generator.integers(COUNT, size=20_000)
    reward = lambda achieved, desired: np.zeros(len(achieved))  # noqa: E731
    batch = TransitionSampler(reward, 0.9).sample(episodes, row, {source: 1.0}, generator, valid)
    tick = batch.observation[:, 1]
    assert all(set(tick[row == each]) == set(range(valid[each])) for each in range(COUNT))
    assert (batch.goal[:, 1] <= valid[batch.goal[:, 0].astype(int)]).all()
    if source == 'final':
        assert (batch.goal[:, 1] == valid[row]).all()
