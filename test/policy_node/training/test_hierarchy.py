"""A high level whose actions are goals, on a line with known answers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from policy_node import load_policy
from policy_node.policies.files import read_tensors
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers
from policy_node.training.research.hierarchy import (
    LOW_SOURCES,
    GuidedCollector,
    GuidedPolicy,
    HierarchicalDDPG,
    HierarchicalExperience,
    SubgoalSampler,
)
from policy_node.training.runs.run_log import RunLog, read_progress
from policy_node.training.runs.trainer import Trainer

torch.set_num_threads(1)

CPU = torch.device('cpu')
SHAPE = NetworkShape(1, 1, 1, (64, 64))


def configured(**changes: object) -> TrainConfig:
    """Updates that move fast, targets that follow at once."""
    quick = {'precision': 'float32', 'target_update_interval': 1, 'polyak': 0.9, 'action_l2': 0.0}
    return recipe_config('FetchReach', 'best', **{**quick, 'subgoal_every': 10, **changes})


def reached(achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return -1.0 * (np.abs(achieved - goal)[..., 0] > 0.1)


def make_generator() -> np.random.Generator:
    return np.random.default_rng(0)


REACH = 0.3


def walks(count: int, tested: float, generator: np.random.Generator) -> Episodes:
    """A line on which the actor goes straight for any subgoal, at most `REACH` in ten ticks."""
    place, subgoal = generator.uniform(-1, 1, count), np.zeros(count)
    places, actions = [place], []
    for tick in range(30):
        if tick % 10 == 0:
            subgoal = generator.uniform(-1, 1, count)
            step = np.clip(subgoal - place, -REACH, REACH) / 10
        place = place + step
        places.append(place)
        actions.append(np.stack([step, subgoal, np.full(count, tested)], axis=-1))
    path = np.stack(places, axis=1)[..., None].astype(np.float32)
    action = np.stack(actions, axis=1).astype(np.float32)
    return Episodes(path, path, generator.uniform(-1, 1, (count, 1)).astype(np.float32), action)


def proposals(tested: float, updates: int) -> np.ndarray:
    """What is proposed at -.7 for -.5, and at -.7 for .7, after learning from such walks."""
    torch.manual_seed(0)
    config, generator = configured(gamma=0.95), make_generator()
    learner = HierarchicalDDPG(SHAPE, config, CPU, Workers())
    learner.actor.goal_normalizer.std.fill_(1.0 / NORMALIZED_CLIP)
    sampler = SubgoalSampler(
        compute_reward=reached, gamma=0.95, most_steps=10, missed_value=config.lowest_value
    )
    episodes = walks(2_000, tested, generator)
    mixture = {'future': 0.8, 'actual': 0.2}
    for _ in range(updates):
        row = generator.integers(len(episodes), size=256)
        learner.high.update(sampler.sample(episodes, row, mixture, generator))
    proposer = learner.high.proposer()
    state = {'observation': [[-0.7], [-0.7]], 'desired_goal': [[-0.5], [0.7]]}
    return proposer.goals(proposer.normalized(state))[:, 0]


@pytest.mark.release
def test_a_high_level_proposes_what_can_be_reached_on_the_way() -> None:
    near, far = proposals(tested=1.0, updates=1_000)
    assert near == pytest.approx(-0.5, abs=0.1), 'a goal within reach is proposed itself'
    assert far == pytest.approx(-0.7 + REACH, abs=0.15), 'one out of reach as far as one gets'
    untested = proposals(tested=0.0, updates=300)[1]
    assert untested > 0.5, 'without tests nothing says what cannot be reached'


class Line:
    """Simulations of a point on a line, by a tenth a tick, with goals up to 1.5 away."""

    def __init__(self, num_envs: int) -> None:
        goal = SimpleNamespace(size=1)
        robot = SimpleNamespace(action_size=1)
        sizes = {'observation_size': 1, 'episode_ticks': 30, 'has_object': False}
        self.spec = SimpleNamespace(goal=goal, robot=robot, **sizes)
        self.num_envs = num_envs
        self.generator = make_generator()

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
    """Collected through subgoals; reached with and without them at the end."""
    torch.manual_seed(0)
    changes = {'num_envs': 32, 'batch_size': 256, 'gamma': 0.95, 'goal_features': 'plain'}
    changes |= {'noise_std': 0.2, 'random_epsilon': 0.3}
    config, line, generator = configured(**changes), Line(32), make_generator()
    learner = HierarchicalDDPG(SHAPE, config, CPU, Workers())
    sampler = TransitionSampler(reached, config.tick_gamma, sources=LOW_SOURCES)
    parts = Workers(), sampler, generator, 2
    experience = HierarchicalExperience(config, line.spec, *parts)
    collector = GuidedCollector(line, [0] * 32, config)
    for cycle in range(20):
        policy = learner.acting_policy()
        assert isinstance(policy, GuidedPolicy) == (cycle > 0), 'no proposals before learning'
        episodes, _ = collector.collect(policy)
        experience.replay.add(episodes)
        experience.normalize(episodes, learner.actor)
        for _ in range(40):
            batch = experience.batch(0)
            learner.update(batch)
        learner.average()
    assert batch.action.shape == batch.high.action.shape == (256, 1)
    alone, proposer = learner.evaluation_actor(), learner.high.proposer(averaged=True)
    for policy in (alone, GuidedPolicy(alone, proposer, 10, 30)):
        observation = line.reset()
        for _ in range(30):
            result = line.step(policy.predict(observation)[0])
            observation = result.observation
        assert result.success.mean() > 0.9


SMALL = {'num_envs': 8, 'updates_per_cycle': 4, 'batch_size': 64, 'evaluation_episodes': 8}
SMALL |= {'simulation_threads': 1, 'torch_threads': 1, 'evaluate_every': 400}


@pytest.mark.release
def test_a_run_goes_on_where_it_stopped_and_saves_an_actor_like_any_other(tmp_path: Path) -> None:
    config = recipe_config('FetchReach', 'best', subgoal_every=10, total_steps=1_200, **SMALL)
    trainer = Trainer(config, tmp_path, Workers())
    log = RunLog(tmp_path, config.total_steps, 0.0)
    trainer.train(log)
    log.close()
    rows = read_progress(tmp_path / 'progress.csv')
    assert [row['eval_guided'] for row in rows if 'eval_success' in row]
    assert all(('eval_guided' in row) == ('eval_success' in row) for row in rows)
    state = tmp_path / 'training_state.safetensors'
    assert any(name.startswith('high_actor_optimizer.') for name in read_tensors(state)[0])
    config = recipe_config('FetchReach', 'best', subgoal_every=10, total_steps=1_600, **SMALL)
    again = Trainer(config, tmp_path, Workers())
    again.resume(state)
    for name, value in trainer.learner.modules()['high_critic'].state_dict().items():
        assert torch.equal(value, again.learner.modules()['high_critic'].state_dict()[name])
    assert again.train() == '1,600 environment steps done'
    assert again.learner.high.updates == again.learner.updates == 16
    loaded = load_policy(tmp_path / 'best.safetensors', 'FetchReach')
    state = {'observation': np.zeros(10), 'achieved_goal': np.zeros(3), 'desired_goal': np.ones(3)}
    assert loaded.policy.predict(state)[0].shape == (4,)
