"""A high level whose actions are goals, and subgoals while episodes are collected."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from policy_node import load_policy
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import from_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers
from policy_node.training.research.hierarchy import (
    LOW_SOURCES,
    TESTED,
    GuidedCollector,
    GuidedPolicy,
    HierarchicalDDPG,
    HierarchicalExperience,
    Proposer,
    SubgoalSampler,
    with_subgoals,
)
from policy_node.training.research.registry import make_collector
from policy_node.training.runs.run_log import RunLog, read_progress
from support.runs import STATE, resumed, same, trainer_of, weights

CPU = torch.device('cpu')


def configured(**changes: object) -> TrainConfig:
    """Updates that move fast, targets that follow at once."""
    quick = {'precision': 'float32', 'target_update_interval': 1, 'polyak': 0.9, 'action_l2': 0.0}
    return recipe_config('FetchReach', 'best', **{**quick, 'subgoal_every': 10, **changes})


def reached(achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return -1.0 * (np.abs(achieved - goal)[..., 0] > 0.1)


def make_generator() -> np.random.Generator:
    return np.random.default_rng(0)


class Line:
    """Simulations of a point on a line, by a tenth a tick, with goals up to 1.5 away."""

    def __init__(self, num_envs: int) -> None:
        sizes = {'observation_size': 1, 'episode_ticks': 30, 'has_object': False}
        goal, robot = SimpleNamespace(size=1), SimpleNamespace(action_size=1)
        self.spec = SimpleNamespace(goal=goal, robot=robot, **sizes)
        self.num_envs, self.generator = num_envs, make_generator()

    def _seen(self) -> dict[str, np.ndarray]:
        return {
            'observation': self.place,
            'achieved_goal': self.place,
            'desired_goal': self.goal,
        }

    def reset(self, seed: object = None) -> dict[str, np.ndarray]:
        self.place = np.zeros((self.num_envs, 1))
        self.goal = self.generator.uniform(-1.5, 1.5, (self.num_envs, 1))
        return self._seen()

    def step(self, action: np.ndarray) -> SimpleNamespace:
        self.place = self.place + 0.1 * np.clip(action, -1, 1)
        success = reached(self.place, self.goal) == 0.0
        never = np.zeros(self.num_envs, np.bool_)
        return SimpleNamespace(observation=self._seen(), success=success, diverged=never)


@pytest.mark.release
def test_both_levels_learn_a_line_together() -> None:
    """Episodes are collected through subgoals; goals are reached with and without them."""
    torch.manual_seed(0)
    changes = {'num_envs': 32, 'batch_size': 256, 'gamma': 0.95, 'goal_features': 'plain'}
    changes |= {'noise_std': 0.2, 'random_epsilon': 0.3}
    config, line, generator = configured(**changes), Line(32), make_generator()
    learner = HierarchicalDDPG(NetworkShape(1, 1, 1, (64, 64)), config, CPU, Workers())
    sampler = TransitionSampler(reached, config.tick_gamma, sources=LOW_SOURCES)
    experience = HierarchicalExperience(config, line.spec, Workers(), sampler, generator, 2)
    collector = GuidedCollector(line, [0] * 32, config)
    for cycle in range(20):
        policy = learner.acting_policy()
        assert isinstance(policy, GuidedPolicy) == (cycle > 0), 'no proposals before learning'
        episodes, _ = collector.collect(policy)
        experience.replay.add(episodes)
        experience.normalize(episodes, learner.actor)
        for _ in range(40):
            learner.update(experience.batch(0))
        learner.average()
    alone, proposer = learner.evaluation_actor(), learner.high.proposer(averaged=True)
    for policy in (alone, GuidedPolicy(alone, proposer, 10, 30)):
        observation = line.reset()
        for _ in range(30):
            result = line.step(policy.predict(observation)[0])
            observation = result.observation
        assert result.success.mean() > 0.9


@pytest.mark.release
def test_a_run_goes_on_where_it_stopped_and_saves_an_actor_like_any_other(tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path, subgoal_every=10, total_steps=1_200)
    log = RunLog(tmp_path, 1_200, 0.0)
    trainer.train(log)
    log.close()
    rows = read_progress(tmp_path / 'progress.csv')
    assert [row['eval_guided'] for row in rows if 'eval_success' in row]
    assert all(('eval_guided' in row) == ('eval_success' in row) for row in rows)
    assert any(name.startswith('high_actor_optimizer.') for name in weights(tmp_path / STATE))
    again = resumed(tmp_path, subgoal_every=10, total_steps=1_600)
    assert same(*(each.learner.modules()['high_critic'].state_dict() for each in (trainer, again)))
    assert again.train() == '1,600 environment steps done'
    assert again.learner.high.updates == again.learner.updates == 16
    loaded = load_policy(tmp_path / 'best.safetensors', 'FetchReach')
    state = {'observation': np.zeros(10), 'achieved_goal': np.zeros(3), 'desired_goal': np.ones(3)}
    assert loaded.policy.predict(state)[0].shape == (4,)


class Constant:
    """A policy whose every action is the same number."""

    def __init__(self, value, size):
        self.value, self.size = value, size

    def predict(self, observation, state=None, *, deterministic=True):
        count = len(np.asarray(observation['observation']))
        return np.full((count, self.size), self.value, np.float32), None


def collected(proposer, noise, actor):
    simulation = Simulation('FetchReach', num_envs=80, num_threads=1)
    std, epsilon = noise
    config = from_flat(
        {'task': 'FetchReach'}, noise_std=std, random_epsilon=epsilon, subgoal_every=20
    )
    collector = make_collector(simulation, list(range(80)), config)
    policy = GuidedPolicy(actor, proposer, 20, 50) if proposer else actor
    return collector.collect(policy)[0]


def test_subgoals_hold_follow_the_action_and_are_tested_without_noise():
    torch.manual_seed(0)
    actor = Actor(NetworkShape(10, 3, 4, (8,))).eval()
    mean, std = np.full(3, 0.5, np.float32), np.full(3, 0.1, np.float32)
    proposer = Proposer(Constant(0.2, 3), mean, std, is_pose=False)
    episodes = collected(proposer, (0.2, 0.2), actor)
    assert episodes.action.shape == (80, 50, 4 + 3 + 1)
    subgoal, test = episodes.action[..., 4:7], episodes.action[..., 7]
    for start, end in ((0, 20), (20, 40), (40, 50)):
        for values in (subgoal, test):
            assert (values[:, start:end] == values[:, start : start + 1]).all()
    assert set(np.unique(test)) == {0.0, 1.0}
    assert test.mean() == pytest.approx(TESTED, abs=0.1)
    # Four fifths around .5 + 5 * .2 * .1 with .2 * .1; the others as goals are.
    noise = (subgoal[:, ::20] - 0.6) / 0.1
    assert np.median(noise) == pytest.approx(0.0, abs=0.1)
    assert (np.abs(noise) < 0.6).all(axis=-1).mean() == pytest.approx(0.83, abs=0.1)
    own, _ = actor.predict(
        {'observation': episodes.observation[:, 30], 'desired_goal': subgoal[:, 30]}
    )
    moved = np.abs(episodes.action[:, 30, :4] - own).max(axis=-1)
    assert (moved[test[:, 30] == 1.0] < 1e-5).all() and (moved[test[:, 30] == 0.0] > 1e-4).all()


def test_without_a_high_level_the_goal_itself_is_pursued():
    episodes = collected(None, (0.0, 0.0), Constant(0.0, 4))
    goal = np.repeat(episodes.desired_goal[:, None], 50, axis=1)
    np.testing.assert_array_equal(episodes.action[..., 4:7], goal)
    assert (episodes.action[..., 7] == 0.0).all()


def test_proposals_of_poses_end_with_unit_quaternions():
    mean, std = np.zeros(7, np.float32), np.arange(1.0, 8.0, dtype=np.float32)
    goals = Proposer(Constant(0.1, 7), mean, std, is_pose=True).goals(np.ones((2, 7), np.float32))
    np.testing.assert_allclose(goals[:, :3], [[1, 2, 3]] * 2)
    np.testing.assert_allclose(np.linalg.norm(goals[:, 3:], axis=1), 1.0, rtol=1e-6)


def test_both_levels_act_as_one_for_whole_episodes():
    asked = []

    class Counting(Constant):
        def predict(self, observation, *, deterministic=True):
            asked.append(float(observation['observation'][0, 0]))
            return super().predict(observation)

    one = np.ones(1, np.float32)
    high = Proposer(Counting(0.5, 1), one, one, is_pose=False)
    both = GuidedPolicy(Constant(0.7, 2), high, every=3, ticks=5)
    for tick in range(10):
        observation = {'observation': np.full((4, 1), tick), 'desired_goal': np.zeros((4, 1))}
        assert (both.predict(observation)[0] == np.float32(0.7)).all()
    assert asked == [0, 3, 5, 8]


def walk(subgoal, tested):
    """To the right by one a tick, the subgoal the same throughout."""
    place = np.arange(7, dtype=np.float32)[None, :, None]
    action = np.tile(np.array([1.0, subgoal, tested], np.float32), (1, 6, 1))
    return Episodes(place, place, np.full((1, 1), 5.0, np.float32), action)


@pytest.mark.parametrize(
    ('subgoal', 'tested', 'missed'), [(9.0, 1.0, True), (9.0, 0.0, False), (3.0, 1.0, False)]
)
def test_what_was_achieved_was_proposed_unless_a_test_was_missed(subgoal, tested, missed):
    """Three ticks lead three places on; rewards are known, and so is what a test costs.

    The second proposal of 3 is missed, at 6.
    """
    sampler = SubgoalSampler(
        compute_reward=lambda a, g: -1.0 * (a != g)[..., 0],
        gamma=0.5,
        most_steps=3,
        missed_value=-2.0,
    )
    row = np.zeros(300, np.int64)
    episodes = walk(subgoal, tested)
    batch = sampler.sample(episodes, row, {'real': 1.0}, np.random.default_rng(0))
    tick = batch.observation[:, 0].astype(int)
    assert set(tick) == {0, 1, 2, 3}
    penalty = (tick % 3 == 0) & missed
    if subgoal == 3.0:
        penalty = tick == 3
    np.testing.assert_array_equal(batch.next_observation[:, 0], tick + 3)
    np.testing.assert_array_equal(batch.action[:, 0], np.where(penalty, subgoal, tick + 3))
    np.testing.assert_allclose(batch.discount, np.where(penalty, 0.0, 0.125))
    summed = [-sum(0.5**i * (t + i + 1 != 5) for i in range(3)) for t in tick]
    np.testing.assert_allclose(batch.reward, np.where(penalty, -2.0, summed))


def test_half_of_the_goals_that_are_kept_are_subgoals():
    assert with_subgoals({'future': 0.8, 'real': 0.2}) == {
        'future': 0.8,
        'real': 0.1,
        'subgoal': 0.1,
    }
    assert with_subgoals({'future': 1.0}) == {'future': 1.0}
