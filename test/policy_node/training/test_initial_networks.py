"""Runs that start from the networks of another run or actor, or imitate an actor."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import TASKS
from policy_node.policies import checkpoint
from policy_node.policies.files import read_tensors, write_tensors
from policy_node.policies.loading import load_actor, shipped_actors
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.learners.actor_critic import network_shape
from policy_node.training.runs.imitation import Answers, ImitationTrainer
from policy_node.training.runs.initial_networks import (
    CRITIC_FIRST,
    read_initial_networks,
    steps_behind,
)
from policy_node.training.runs.run_folder import STATE_FILE, RunFolder
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.trainer import Trainer
from policy_node.training.runs.training_state import part_of
from policy_node.training.ship_actor import main as ship_actor
from policy_node.training.train_her import main
from support.runs import SMALL, one_line, options_of, same, small

# One cycle of two simulations.
TINY = SMALL | {'num_envs': 2, 'updates_per_cycle': 3, 'batch_size': 32, 'evaluation_episodes': 2}
TINY |= {'hidden_sizes': (32, 32), 'evaluate_every': 50_000}
SHIPPED = {'hidden_sizes': (256, 256, 256)}
SET = options_of(**TINY)
BLOCK = 'HandManipulateBlockRotateXYZ'


def tiny(task, **changes):
    return recipe_config(task, 'best', **{**TINY, 'total_steps': 200, **changes})


@pytest.fixture(scope='module')
def block_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('xyz')
    arguments = ['--task', BLOCK, '--steps', '400', *SET]
    assert main([*arguments, '--set', 'evaluate_every=200', '--output', str(folder)]) == 0
    return folder


def start(folder, config, networks):
    return Trainer(RunFolder(folder, config), networks)


def test_a_run_starts_with_all_networks_of_another(tmp_path, block_run):
    networks = read_initial_networks(str(block_run))
    config = tiny('HandManipulateBlockFull')
    networks.require_fit(config)
    source = Trainer(RunFolder(tmp_path, tiny(BLOCK)))
    source.resume(block_run / 'training_state.safetensors')
    started = start(tmp_path, config, networks)
    for name in ('actor', 'critic', 'target_actor', 'target_critic', 'average_actor'):
        ours, theirs = (getattr(trainer.learner, name) for trainer in (started, source))
        assert same(ours.state_dict(), theirs.state_dict()), name
    for name, statistics in started.experience.statistics.items():
        assert same(statistics.state_dict(), source.experience.statistics[name].state_dict())
    assert started.counters.env_steps == started.counters.updates == started.learner.updates == 0
    assert started.learner.critic_optimizer.state_dict()['state'] == {}
    assert source.learner.critic_optimizer.state_dict()['state'] != {}


def test_the_evaluated_actor_keeps_a_share_of_its_start(tmp_path, block_run):
    config = tiny(BLOCK, init_from=str(block_run), start_share=0.25, learning_rate=0.01)
    trainer = start(tmp_path, config, read_initial_networks(str(block_run)))
    first = {k: v.clone() for k, v in trainer.learner.average_actor.state_dict().items()}
    trainer.train()
    trainer.save()
    last = trainer.learner.average_actor.state_dict()
    assert not same(first, last)
    evaluated = trainer.learner.evaluation_actor().network.state_dict()
    for name, value in evaluated.items():
        torch.testing.assert_close(value, 0.25 * first[name] + 0.75 * last[name])
    resumed = Trainer(RunFolder(tmp_path, config))
    resumed.resume(tmp_path / 'training_state.safetensors')
    assert same(resumed.learner.evaluation_actor().network.state_dict(), evaluated)


@pytest.mark.parametrize('features', ['relative', 'symmetric'])
def test_a_position_that_now_counts_has_no_effect_at_first(tmp_path, block_run, features):
    """EggFull from EggRotate: actor and critic return the same for every goal position."""
    before = Trainer(RunFolder(tmp_path, tiny('HandManipulateEggRotate', goal_features=features)))
    before.save()
    config = tiny('HandManipulateEggFull', goal_features=features)
    networks = read_initial_networks(str(tmp_path))
    after = start(tmp_path, config, networks.fitted(config))
    episodes = before.collector.collect(before.learner.actor)[0]
    observation = torch.tensor(episodes.observation[0])
    here = torch.tensor(episodes.desired_goal[0]).repeat(len(observation), 1)
    there = here + torch.tensor([0.03, -0.02, 0.05, 0.0, 0.0, 0.0, 0.0])
    action = torch.rand(len(here), 20)
    learner, found = after.learner, []
    for goal in (here, there):
        inputs = learner.actor.features(observation, goal)
        found.append((learner.actor(inputs), learner.critic(inputs, action), inputs))
    assert not torch.equal(found[0][2], found[1][2]), 'the position is among the inputs'
    torch.testing.assert_close(found[0][:2], found[1][:2])
    first = 'actor.network.hidden.0.weight'
    fitted = networks.fitted(config).tensors
    assert (fitted[first] != networks.tensors[first]).any(dim=0).sum() in (3, 6)
    assert all(
        torch.equal(fitted[k], v) for k, v in networks.tensors.items() if 'hidden.0.w' not in k
    )
    block = read_initial_networks(str(block_run))
    parallel = block.fitted(tiny('HandManipulateBlockRotateParallel'))
    assert same(parallel.tensors, block.tensors) and parallel.origin == block.origin


@pytest.mark.parametrize('condition', ['threshold', 'horizon'])
def test_a_condition_starts_without_effect_and_is_fixed_for_other_runs(
    tmp_path, block_run, condition
):
    """First the values are equal for all conditions; others start with those for acting."""
    config = tiny('HandManipulateBlockFull', condition=condition, init_from=str(block_run))
    plain = read_initial_networks(str(block_run)).fitted(tiny('HandManipulateBlockFull'))
    run = start(tmp_path, config, read_initial_networks(str(block_run)).fitted(config))
    acting = {'threshold': 0.0, 'horizon': 1.0}[condition]
    size = plain.shape.feature_size
    features, action = torch.randn(8, size), torch.rand(8, 20)

    def said(trainer, *inputs):
        seen = torch.cat([features, *(torch.full((8, 1), value) for value in inputs)], dim=1)
        return trainer.learner.actor.network(seen), trainer.learner.critic(seen, action)

    plainly = start(tmp_path, tiny('HandManipulateBlockFull'), plain)
    for value in (acting, 0.3, -2.0):
        torch.testing.assert_close(said(run, value), said(plainly))
    run.train()
    assert run.counters.updates > 0
    assert not torch.equal(said(run, acting)[1], said(run, -2.0)[1])
    after = read_initial_networks(str(tmp_path))
    follower = start(tmp_path, tiny('HandManipulateBlockFull'), after)
    torch.testing.assert_close(said(follower), said(run, acting))


def test_a_second_critic_starts_from_random_weights(tmp_path, block_run):
    one = read_initial_networks(str(block_run))
    config = tiny(BLOCK, critics=2, aggregate='min')
    networks = one.fitted(config)
    assert (one.critics, networks.critics) == (1, 1)
    started = start(tmp_path, config, networks)
    assert started.learner.critic_first == CRITIC_FIRST
    first, second = started.learner.critic.members
    assert same(first.state_dict(), part_of(one.tensors, 'critic'))
    for part in (first, started.learner.target_critic.members[0]):
        assert not same(part.state_dict(), second.state_dict())
    assert same(started.learner.target_critic.members[1].state_dict(), second.state_dict())
    started.save()
    two = read_initial_networks(str(tmp_path))
    assert two.critics == 2
    again = start(tmp_path, config, two.fitted(config)).learner
    assert again.critic_first == 0
    assert same(again.critic.state_dict(), part_of(two.tensors, 'critic'))
    alone = start(tmp_path, tiny(BLOCK), two.fitted(tiny(BLOCK))).learner
    assert same(alone.critic.state_dict(), part_of(two.tensors, 'critic.members.0'))


def test_without_targets_a_run_starts_from_the_networks_themselves(tmp_path, block_run):
    """Not from their slow copies, which the file also contains."""
    networks = read_initial_networks(str(block_run))
    before = {part: part_of(networks.tensors, part) for part in ('actor', 'critic')}
    slow = part_of(networks.tensors, 'target_critic')
    assert not same(before['critic'], slow)
    started = start(tmp_path, tiny(BLOCK, target='none'), networks).learner
    again = Trainer(RunFolder(tmp_path, tiny(BLOCK, target='none')))
    again.resume(block_run / STATE_FILE)
    for learner in (started, again.learner):
        assert same(learner.actor.state_dict(), before['actor'])
        assert same(learner.critic.state_dict(), before['critic'])


@pytest.mark.parametrize('task', ['FetchPush', 'HandManipulateBlockRotateZ'])
def test_past_actions_that_become_inputs_change_no_action_at_first(tmp_path, task):
    config = tiny(task, past_actions=2, **SHIPPED)
    networks = read_initial_networks(task).fitted(config)
    learner = start(tmp_path, config, networks).learner
    rng, before, spec = np.random.default_rng(0), load_actor(task, task), TASKS[task]
    observation = torch.tensor(rng.normal(size=(5, spec.observation_size)), dtype=torch.float32)
    goal = torch.tensor(rng.normal(size=(5, spec.goal.size)), dtype=torch.float32)
    past = torch.tensor(rng.uniform(-1, 1, (5, 2 * spec.robot.action_size)), dtype=torch.float32)
    features = learner.actor.features(torch.cat([observation, past], dim=-1), goal)
    torch.testing.assert_close(
        learner.actor(features), before(before.features(observation, goal)), rtol=1e-4, atol=1e-4
    )
    first = network_shape(config).past_start
    normalized = features[:, first : first + past.shape[1]]
    torch.testing.assert_close(normalized, past, rtol=1e-3, atol=1e-3)


def test_the_origin_is_kept_in_resumed_and_shipped_actors(tmp_path, block_run):
    run, actors = tmp_path / 'full', tmp_path / 'actors'
    arguments = ['--task', 'HandManipulateBlockFull', '--steps', '200', *SET]
    assert main([*arguments, '--init-from', str(block_run), '--output', str(run)]) == 0
    resume = ['--resume', str(run), '--steps', '400', '--set', 'evaluate_every=1']
    assert main(resume) == 0
    origin = checkpoint.read_info(run / 'latest.safetensors').init_from
    assert origin['task'] == BLOCK
    assert origin['env_steps'] == 400 and 'RotateXYZ' in origin['command']
    shipping = [str(run), '--episodes', '2', '--threads', '1', '--actors', str(actors)]
    assert ship_actor(shipping) == 0
    report = json.loads((actors / 'HandManipulateBlockFull.json').read_text())
    assert report['init_from'] == origin
    shipped = read_initial_networks(str(actors / 'HandManipulateBlockFull.safetensors'))
    assert shipped.critics
    latest = read_initial_networks(str(run))
    critics = (part_of(networks.tensors, 'critic') for networks in (shipped, latest))
    assert same(*critics)
    best, _ = checkpoint.load(run / 'best.safetensors')
    assert same(part_of(shipped.tensors, 'actor'), best.state_dict())
    shutil.copy(run / 'latest.safetensors', actors / 'HandManipulateBlockFull.safetensors')
    with pytest.raises(ValueError, match='another actor'):
        read_initial_networks(str(actors / 'HandManipulateBlockFull.safetensors'))


def test_a_run_in_the_home_directory_is_found_there(block_run, monkeypatch):
    monkeypatch.setenv('HOME', str(block_run.parent))
    assert read_initial_networks(f'~/{block_run.name}').origin['name'] == str(block_run)


@pytest.mark.parametrize(
    ('source', 'message'),
    [
        ({'task': 'FetchPush'}, 'task FetchPush, not HandManipulateBlockRotateXYZ'),
        ({'hidden_sizes': [16, 16]}, r'hidden_sizes \(16, 16\), not \(32, 32\)'),
        ({'layer_norm': True}, 'layer_norm True, not False'),
        ({'goal_features': 'plain'}, 'goal_features plain, not relative'),
    ],
)
def test_the_critic_of_another_actor_is_rejected(tmp_path, block_run, source, message):
    run = shutil.copytree(block_run, tmp_path / 'run')
    tensors, metadata = read_tensors(run / STATE_FILE)
    extra = json.loads(metadata['extra'])
    extra['config'] |= source
    write_tensors(run / STATE_FILE, tensors, metadata | {'extra': json.dumps(extra)})
    with pytest.raises(ValueError, match=message):
        read_initial_networks(str(run / 'best.safetensors'))


def test_networks_whose_tensors_do_not_fit_are_one_line(tmp_path, block_run, capsys):
    run = shutil.copytree(block_run, tmp_path / 'run')
    tensors, metadata = read_tensors(run / STATE_FILE)
    name = 'critic.network.output.bias'
    tensors = tensors | {name: np.zeros(2, np.float32)}
    write_tensors(run / STATE_FILE, tensors, metadata)
    arguments = ['--task', BLOCK, *SET, '--init-from', str(run)]
    assert main([*arguments, '--output', str(tmp_path / 'on')]) == 2
    error = one_line(capsys)
    assert f'{run} does not fit this configuration: ' in error and 'output.bias' in error


def test_normalisers_of_an_actor_continue_with_its_statistics(tmp_path):
    networks = read_initial_networks('FetchReach')
    trainer = start(tmp_path, small(**SHIPPED), networks)
    before = {name: value.clone() for name, value in trainer.learner.actor.state_dict().items()}
    actor = trainer.learner.actor
    trainer.experience.normalize(trainer.collector.collect(actor)[0], actor)
    steps = checkpoint.read_info(shipped_actors()['FetchReach']).env_steps
    count = trainer.experience.statistics['observation_statistics'].count.item()
    assert count == steps + trainer.simulation.num_envs * 50
    for name, value in trainer.learner.actor.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0.25, atol=0.05)


def test_an_actor_alone_acts_from_the_first_cycle_while_its_critic_learns(tmp_path, capsys):
    actor = tmp_path / 'alone.safetensors'
    shutil.copy(shipped_actors()['FetchReach'], actor)
    arguments = ['--task', 'FetchReach', '--init-from', str(actor), '--steps', '800']
    arguments += options_of(**SMALL | SHIPPED)
    assert main([*arguments, '--output', str(tmp_path / 'run')]) == 0
    assert 'has no critic for this run' in capsys.readouterr().err
    rows = read_progress(tmp_path / 'run/progress.csv')
    evaluated = [row['eval_success'] for row in rows if 'eval_success' in row]
    assert evaluated[0] >= 0.95, 'from nothing it would be about 0'
    learnt = checkpoint.load(tmp_path / 'run' / 'latest.safetensors')[0]
    assert same(learnt.network.state_dict(), load_actor('FetchReach').network.state_dict())


@pytest.mark.parametrize(
    ('start', 'arguments', 'message'),
    [
        ('FetchReach', ['--task', 'HandReach'], 'observation 10, now 63; goal 3, now 15'),
        ('FetchReach', ['--set', 'hidden_sizes=9'], 'hidden_sizes (256, 256, 256), now (9,)'),
        ('FetchReach', ['--set', 'goal_features=relative'], 'goal_features plain, now relative'),
        ('Nobody', [], "'Nobody'"),
        ('.', [], 'training_state.safetensors is no file'),
    ],
)
def test_networks_that_do_not_fit_are_rejected_before_anything_is_written(
    start, arguments, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(['--task', 'FetchReach', '--init-from', start, *arguments]) == 2
    assert message in one_line(capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('task', [n for n in TASKS if n.startswith(('Hand', 'FetchSlide'))])
def test_finetune_starts_from_the_shipped_networks(task):
    config = recipe_config(task, 'finetune')
    networks = read_initial_networks(config.init_from)
    networks.require_fit(config)
    assert networks.origin['task'] == task and networks.critics
    assert networks.fitted(config).shape == network_shape(config)


@pytest.mark.parametrize(
    'changes', [{'reward_type': 'dense'}, {'control_hz': 250.0}, {'norm': 'layer'}]
)
def test_a_critic_of_other_rewards_or_norm_starts_from_random_weights(changes, tmp_path, block_run):
    networks = read_initial_networks(str(block_run))
    assert networks.fitted(tiny(BLOCK)).critics
    config = tiny(BLOCK, **changes)
    fitted = networks.fitted(config)
    assert not fitted.critics
    started = start(tmp_path, config, fitted)
    assert started.learner.critic_first == CRITIC_FIRST
    assert same(started.learner.actor.state_dict(), part_of(networks.tensors, 'actor'))
    started.save()
    own = read_initial_networks(str(tmp_path))
    assert own.fitted(config).critics and not own.fitted(tiny(BLOCK)).critics


def test_each_run_behind_an_actor_counts_once_with_its_latest_actor():
    parts = [
        {'name': 'runs/a/best.safetensors', 'env_steps': 250},
        {'name': 'runs/a/latest.safetensors', 'env_steps': 300},
    ]
    assert steps_behind({'env_steps': 5, 'init_from': {'env_steps': 0, 'mean_of': parts}}) == 305
    parts.append({'name': './runs/a', 'env_steps': 320})
    assert steps_behind({'env_steps': 5, 'init_from': {'env_steps': 0, 'mean_of': parts}}) == 325


LATE = '{"action": {"latency": 1}}'


def trainer_of(config, folder):
    networks = read_initial_networks(config.task).fitted(config)
    return ImitationTrainer(RunFolder(folder, config), networks)


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


def test_a_cycle_in_which_all_simulations_diverge_is_not_learnt_from(tmp_path, monkeypatch):
    step = Simulation.step

    def diverge(simulation, actions):
        return dataclasses.replace(step(simulation, actions), diverged=np.ones(2, np.bool_))

    monkeypatch.setattr(Simulation, 'step', diverge)
    trainer = trainer_of(recipe_config('FetchReach', 'robust', num_envs=2), tmp_path)
    assert trainer._collect() == 0.0, 'the episodes that follow a divergence do not count'
    assert trainer._learn() is None and trainer.counters.updates == 0


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
    assert read_initial_networks(str(run)).shape == actor.shape, 'it has no training state'


@pytest.mark.parametrize(
    ('option', 'line'),
    [
        (['--set', 'value_weight=1'], 'HandReach has no single critic'),
        (['--control-hz', '50'], 'HandReach was trained at 25 Hz, this run has 50 Hz'),
    ],
)
def test_a_policy_that_cannot_be_imitated_is_one_line(option, line, tmp_path, capsys):
    arguments = ['--task', 'HandReach', '--recipe', 'robust', *option]
    assert main([*arguments, '--output', str(tmp_path / 'run')]) == 2
    assert line in one_line(capsys)
