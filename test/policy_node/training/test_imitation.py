"""Recipe `robust`: imitation of the shipped policy on a disturbed robot."""

from __future__ import annotations

import numpy as np
import torch

from msgs_spec.tasks import TASKS
from policy_node.policies import checkpoint
from policy_node.policies.loading import load_actor
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.machine import Workers
from policy_node.training.runs.imitation import Answers, ImitationTrainer
from policy_node.training.runs.initial_networks import read_initial_networks
from policy_node.training.runs.run_log import read_progress
from policy_node.training.train_her import main
from support.runs import one_line, options_of

LATE = '{"action": {"latency": 1}}'


def trainer_of(config, folder):
    networks = read_initial_networks(config.task).fitted(config)
    return ImitationTrainer(config, folder, Workers(), '', '', networks)


def test_each_input_is_answered_in_the_state_in_which_the_action_arrives(tmp_path):
    task = 'FetchPush'
    config = recipe_config(task, 'robust', num_envs=2, disturbances=LATE)
    trainer = trainer_of(config, tmp_path)
    trainer._collect()
    pairs = 2 * (TASKS[task].episode_ticks - 1)
    inputs, answers = (part[:pairs] for part in trainer._answers._parts)
    # Without other disturbances, the next input contains the state in which the action arrives.
    imitated, size = load_actor(task, task), config.past_actions * 4
    start = trainer.actor.shape.past_start
    seen = torch.cat([inputs[:, :start], inputs[:, start + size :]], dim=1)
    expected = imitated(seen).detach()
    torch.testing.assert_close(answers[:-2], expected[2:], rtol=1e-3, atol=1e-3)
    assert not torch.allclose(answers[:-2], expected[:-2], rtol=1e-3, atol=1e-3)


def test_successive_cycles_scale_the_disturbances(tmp_path):
    config = recipe_config(
        'FetchPush', 'robust', num_envs=2, disturbances=LATE, disturbance_scales=(0.0, 1.0)
    )
    trainer = trainer_of(config, tmp_path)
    for stored in (2 * 50, 2 * 50 + 2 * 49):
        trainer._collect()
        assert trainer._answers._count == stored


def test_the_critic_of_the_imitated_policy_judges_the_actions(tmp_path):
    task = 'FetchSlide'
    config = recipe_config(task, 'robust', num_envs=2, value_weight=1.0, updates_per_cycle=5)
    trainer = trainer_of(config, tmp_path)
    trainer._collect()
    _, answers, states = trainer._answers.draw(64)
    # The imitated policy was trained to maximise the values of this critic.
    assert trainer._critic is not None
    assert trainer._critic(states, answers).mean() > trainer._critic(states, -answers).mean()
    before = trainer.actor(states).detach()
    trainer._learn()
    assert not torch.equal(before, trainer.actor(states))


def test_the_newest_answers_are_kept():
    answers = Answers(3, (1, 1, 1))
    for value in range(5):
        answers.add(*(torch.full((1, 1), factor * value) for factor in (1.0, 10.0, -1.0)))
    inputs, states, outputs = answers.draw(200)
    assert set(inputs.flatten().tolist()) == {2.0, 3.0, 4.0}
    assert torch.equal(states, 10.0 * inputs) and torch.equal(outputs, -inputs)


def test_a_run_writes_a_policy_with_past_actions(tmp_path):
    run = tmp_path / 'run'
    arguments = ['--task', 'FetchReach', '--recipe', 'robust', '--steps', '800']
    small = options_of(updates_per_cycle=10, evaluation_episodes=8, num_envs=8, batch_size=64)
    assert main([*arguments, *small, '--threads', '1', '--output', str(run)]) == 0
    actor, info = checkpoint.load(run / 'best.safetensors')
    assert (info.past_actions, info.init_from['name']) == (4, 'FetchReach')
    assert actor.shape.past_actions == 4
    assert read_progress(run / 'progress.csv')[-1]['eval_success'] > 0.7
    state = actor.predict({'observation': np.zeros(10), 'desired_goal': np.zeros(3)})[1]
    assert state is not None


def test_a_policy_without_one_critic_to_weigh_its_values_is_one_line(tmp_path, capsys):
    arguments = ['--task', 'FetchPush', '--recipe', 'robust', '--set', 'value_weight=1']
    assert main([*arguments, '--output', str(tmp_path / 'run')]) == 2
    assert 'no single critic' in one_line(capsys)
