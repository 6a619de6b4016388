"""Training runs from the command line, end to end on the real simulation."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node import load_policy
from policy_node.policies import checkpoint
from policy_node.policies.policy import RandomPolicy
from policy_node.training.experience.episode_files import read_experience
from policy_node.training.experience.rewards import GradedReward
from policy_node.training.generate_episodes import main as generate_episodes
from policy_node.training.runs.run import train_run
from policy_node.training.runs.run_log import RunLog, read_progress
from policy_node.training.runs.training_state import TrainingError, part_of, read_state
from policy_node.training.ship_actor import main as ship_actor
from policy_node.training.train_her import main
from support.fresh_actor import observations
from support.runs import (
    SMALL,
    STATE,
    one_line,
    options_of,
    outcomes_of,
    resumed,
    same,
    small,
    trained,
    trainer_of,
    weights,
)

THREADS = ['--threads', '1', '--torch-threads', '1']
ON_POLICY = {'algorithm': 'ppo', 'overlap': False, 'random_epsilon': 0.0, 'noise_std': 0.3}
PPO = ' '.join(options_of(**ON_POLICY))
REACH = task_spec('FetchReach')
# A run of seconds: 8 simulations, 3 cycles.
RUN = ['--task', 'FetchReach', '--steps', '1200', *options_of(**SMALL)]


def run_two_workers(*words):
    """Run a program in two workers of one thread each; return its output."""
    command = [sys.executable, '-m', 'torch.distributed.run', '--nproc-per-node', '2']
    command += ['--rdzv-backend', 'c10d', '--rdzv-endpoint', 'localhost:0', *words]
    environment = {**os.environ, 'OMP_NUM_THREADS': '1'}
    result = subprocess.run(command, capture_output=True, text=True, timeout=1200, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.release
@pytest.mark.parametrize('workers', [1, 2])
def test_fetch_reach_is_learnt_from_nothing(tmp_path, workers, capsys):
    arguments = ['--task', 'FetchReach', '--success-target', '1', '--steps', '60000', *THREADS]
    arguments += ['--output', str(tmp_path / 'run')]
    if workers == 1:
        assert main(arguments) == 0
        output = capsys.readouterr().out
    else:
        output = run_two_workers('-m', 'policy_node.training.train_her', *arguments)
    assert output.count('success target 1 reached') == 1
    _, info = checkpoint.load(tmp_path / 'run' / 'best.safetensors', task='FetchReach')
    assert info.success.items() >= {'last_step': 1.0, 'episodes': 200, 'rule': 'gymnasium'}.items()
    assert info.success['stay'] > 0.9 and info.success['distance'] < 0.05
    assert info.command.startswith('fetch_hand_sim train --task FetchReach --success-target 1')
    assert info.source_revision and 0 < info.env_steps <= 60_000
    rows = read_progress(tmp_path / 'run' / 'progress.csv')
    # 64 simulations in all, with two workers 32 each: 64 episodes of 50 steps in a cycle.
    assert [row['env_steps'] for row in rows[:2]] == [3200, 6400]
    assert rows[-1]['eval_success'] == 1.0 and rows[-1]['eval_stay'] > 0.9
    assert rows[0]['train_success'] < 0.5 < rows[-1]['train_success']
    assert (tmp_path / 'run' / 'curve.png').read_bytes()[:4] == b'\x89PNG'
    options = ['--episodes', '50', '--threads', '1', '--actors', str(tmp_path / 'actors')]
    assert ship_actor([str(tmp_path / 'run'), *options]) == 0
    assert sorted(path.name for path in (tmp_path / 'actors').iterdir()) == [
        'FetchReach.json',
        'FetchReach.png',
        'FetchReach.safetensors',
        'FetchReach.training.safetensors',
    ]


@pytest.mark.release
@pytest.mark.parametrize('overlap', ['true', 'false'])
def test_the_same_seed_gives_the_same_weights_bit_for_bit(tmp_path, overlap):
    for name, seed in (('a', '5'), ('b', '5'), ('c', '6')):
        extra = ['--seed', seed, '--set', f'overlap={overlap}', '--output', str(tmp_path / name)]
        assert main([*RUN, *extra]) == 0
    latest = 'latest.safetensors'
    for name in (latest, STATE):
        assert same(weights(tmp_path / 'a' / name), weights(tmp_path / 'b' / name))
    assert not same(weights(tmp_path / 'a' / latest), weights(tmp_path / 'c' / latest))


@pytest.mark.parametrize(
    ('changes', 'kept'),
    [
        ({}, 'critic_optimizer.0.exp_avg'),
        (ON_POLICY, 'critic_optimizer.0.exp_avg'),
        pytest.param(
            ON_POLICY | {'importance': 'decision'}, 'actor_optimizer.', marks=pytest.mark.release
        ),
        pytest.param(
            ON_POLICY | {'goals': 'outcome=.8', 'first_value': -50.0},
            'actor_optimizer.',
            marks=pytest.mark.release,
        ),
        pytest.param({'subgoal_prior': 0.3}, 'imagination', marks=pytest.mark.release),
        pytest.param({'subgoal_every': 10}, 'high_actor_optimizer.', marks=pytest.mark.release),
    ],
)
def test_a_run_of_every_learner_goes_on_where_it_stopped(tmp_path, changes, kept):
    changes = {'actor_average': 0.9, **changes}
    first = trained(tmp_path, total_steps=1200, **changes)
    saved = weights(tmp_path / STATE)
    assert any(name.startswith(kept) for name in saved)
    averaged = part_of(saved, 'average_actor')
    assert same(averaged, checkpoint.load(tmp_path / 'latest.safetensors')[0].network.state_dict())
    assert not same(averaged, part_of(saved, 'actor.network'))
    second = trainer_of(tmp_path, total_steps=1600, seed=9, **changes)
    fresh = second.collector.collect(second.learner.actor)[0]
    second.resume(tmp_path / STATE)
    assert second.counters == first.counters
    second.save()
    assert same(saved, weights(tmp_path / STATE))
    resumed = second.collector.collect(second.learner.actor)[0]
    assert (resumed.desired_goal != fresh.desired_goal).all(), 'episodes would come twice'
    log = RunLog(tmp_path, 1600, 0.0)
    assert second.train(log) == '1,600 environment steps done'
    log.close()
    assert getattr(second.learner, 'high', second.learner).updates == second.counters.updates == 16
    (row,) = read_progress(tmp_path / 'progress.csv')
    assert 'eval_success' in row and ('eval_guided' in row) == ('subgoal_every' in changes)
    assert load_policy(tmp_path / 'best.safetensors').predict(observations(REACH))[0].shape == (4,)


@pytest.fixture(scope='module')
def logged(tmp_path_factory):
    """Twelve logged FetchReach episodes of random actions and one of another task."""
    folder = tmp_path_factory.mktemp('logged')
    for task, count in (('FetchReach', 12), ('FetchPush', 1)):
        arguments = ['--policy', 'random', '--task', task, '--threads', '1']
        arguments += ['--episodes', str(count), '--output', str(folder)]
        assert generate_episodes(arguments) == 0
    return folder


def test_logged_episodes_are_learnt_from_before_any_step(tmp_path, logged, capsys):
    run, waits = tmp_path / 'run', ['--set', 'learning_starts=1400']
    assert main([*RUN, *waits, '--output', str(run), '--from-episodes', str(logged)]) == 0
    said = capsys.readouterr().err
    assert f'12 episodes from {logged}; 1 left out, first: ' in said
    assert 'FetchPush, not FetchReach' in said
    # 600 transitions of the logs and 800 of the first two cycles make the 1,400.
    rows = read_progress(run / 'progress.csv')
    assert [(row['env_steps'], row['updates']) for row in rows] == [(400, 0), (800, 4), (1200, 8)]
    assert weights(run / STATE)['observation_statistics.count'] == 1200 + 600


def test_workers_share_logged_episodes_and_a_resumed_run_counts_them_once(tmp_path, logged):
    episodes, _ = read_experience(logged, REACH)
    statistics = 'observation_statistics'
    before = trained(tmp_path, total_steps=400).experience.statistics[statistics].state_dict()
    again = resumed(tmp_path)
    again.workers = dataclasses.replace(again.workers, rank=1, world_size=3)
    again.add_experience(episodes)
    # The eight of the run, which are kept beside its state, and a third of the twelve.
    assert len(again.experience.replay) == 8 + 4
    added = again.experience.replay.newest(4)
    np.testing.assert_array_equal(added.action, episodes.action[1::3])
    assert same(before, again.experience.statistics[statistics].state_dict())


def test_logs_that_cannot_be_learnt_from_are_refused(tmp_path, logged, capsys):
    output = ['--output', str(tmp_path / 'run')]
    small = ['--from-episodes', str(logged), '--set', 'replay_transitions=500', *output]
    assert main([*RUN, *small]) == 2
    assert '600 transitions, the replay 500' in capsys.readouterr().err
    assert main([*RUN, '--from-episodes', str(tmp_path), *output]) == 2
    assert f'{tmp_path} holds no episode' in capsys.readouterr().err
    above = tmp_path / 'above'
    above.mkdir()
    (above / 'inner').symlink_to(logged)
    assert main([*RUN, '--from-episodes', str(above), *output]) == 2
    assert f'holds no episode; there are some in {above / "inner"}' in capsys.readouterr().err
    assert main([*RUN, '--from-episodes', str(logged), '--set', 'control_hz=50', *output]) == 2
    assert 'holds no usable episode of FetchReach' in capsys.readouterr().err
    assert not (tmp_path / 'run').exists(), 'refused before anything was written'


def test_graded_rewards_are_shares_of_thresholds_met():
    """BlockFull: 0.01 m and 0.1 rad, at multiples of 0.5, 1, 2 and 4 of them."""
    metric = Simulation('HandManipulateBlockFull', num_envs=1, num_threads=1).metric
    goal = np.zeros((5, 7))
    goal[:, 3] = 1.0
    achieved = goal.copy()
    achieved[:, 0] = [0.0, 0.006, 0.015, 0.03, 0.05]
    angle = np.array([0.0, 0.04, 0.3, 0.3, 0.0])
    achieved[:, 3], achieved[:, 4] = np.cos(angle / 2), np.sin(angle / 2)
    reward = GradedReward(metric, (0.5, 1.0, 2.0, 4.0))
    met = np.array([1.0, 0.75 * 1.0, 0.5 * 0.25, 0.25 * 0.25, 0.0 * 1.0])
    np.testing.assert_array_equal(reward(achieved, goal), met - 1.0)
    sparse = GradedReward(metric, (1.0,))
    np.testing.assert_array_equal(sparse(achieved, goal), metric.reward(achieved, goal))


@pytest.mark.parametrize(
    ('changes', 'thresholds'),
    [
        # FetchReach's 0.05 m are 0.2 m at the start, 0.1 m after a third of the run, then 0.05 m.
        ({'first_distance': 4.0}, ([0.2], [0.1], [0.05], [0.05])),
        # One of the two grades is reached within 0.1 m.
        ({'reward_grades': '1,2'}, ([0.1, 0.05],)),
    ],
)
def test_thresholds_of_training_narrow_and_may_be_several(tmp_path, changes, thresholds):
    fields = {'total_steps': 3_000, 'goals': 'random=1', 'batch_size': 512, **changes}
    trainer = trainer_of(tmp_path, **fields)
    trainer.experience.replay.add(trainer.collector.collect(RandomPolicy(4))[0])
    for env_steps, limits in zip(range(0, 4_000, 1_000), thresholds, strict=False):
        trainer.experience.narrow(env_steps / 3_000)
        batch = trainer.experience.batch()
        position = batch.next_observation[:, :3].astype(np.float64)
        distance = np.linalg.norm(position - batch.goal, axis=-1)
        met = np.mean([distance < limit for limit in limits], axis=0)
        clear = np.min([np.abs(distance - limit) for limit in limits], axis=0) > 1e-4
        np.testing.assert_array_equal(batch.reward[clear], met[clear] - 1.0)
        assert ((distance > 0.5 * limits[0]) & (distance < limits[0])).any()
    assert trainer.simulation.metric.reward_type == 'sparse'


def test_settings_of_training_do_not_change_evaluation(tmp_path):
    """The same actor gets the same evaluation with other rewards and goals of training."""
    two = {'task': 'HandManipulatePenFull', 'num_envs': 2, 'evaluation_episodes': 2}
    changes = {'gamma': 0.5, 'first_distance': 9.0, 'first_rotation': 9.0}
    changes |= {'ticks_after_drop': 2, 'goals': 'final=1', 'moved_share': 0.5}
    results = []
    for extra in ({}, changes):
        trainer = trainer_of(tmp_path, **two, **extra)
        trainer.counters.updates = 1
        outcomes = trainer._collect(*trainer._prepare_collection()).evaluation
        results.append([getattr(outcomes, name) for name in outcomes.__slots__])
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)


def poison_critic(learner):
    learner.critic.network.output.bias.fill_(float('nan'))


def poison_actor(learner):
    learner.actor.network.output.weight.fill_(float('inf'))


@pytest.mark.parametrize(
    ('poison', 'due', 'overlap', 'message'),
    [
        (poison_critic, 9, True, 'critic loss is not finite after 1200'),
        # Every loss is finite, as those before the last step of a cycle are.
        (poison_actor, 12, True, r'network\.output\.weight'),
        (poison_actor, 12, False, r'network\.output\.weight'),
    ],
)
def test_what_is_not_finite_stops_the_run_before_it_acts_or_is_saved(
    tmp_path, poison, due, overlap, message
):
    fields = {'total_steps': 10_000, 'checkpoint_seconds': 0, 'overlap': overlap}
    trainer = trainer_of(tmp_path, **fields)
    update, updates = trainer.learner.update, []

    def poisoned(batch):
        updates.append(batch)
        losses = update(batch)
        if len(updates) == due:
            with torch.no_grad():
                poison(trainer.learner)
        return losses

    trainer.learner.update = poisoned
    with pytest.raises(TrainingError, match=message):
        trainer.train()
    kept = weights(tmp_path / STATE)
    assert all(torch.isfinite(value.float()).all() for value in kept.values())
    assert read_state(tmp_path / STATE).extra['config']['num_envs'] == 8


def test_networks_whose_files_could_not_be_read_are_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match='67,'):
        trainer_of(tmp_path, hidden_sizes=(4096, 4096))


def test_a_new_run_sets_the_files_of_an_earlier_one_aside(tmp_path, capsys):
    """Otherwise the best actor of the earlier run would stay, even of another task."""
    (tmp_path / 'tensorboard').mkdir()
    names = 'best.safetensors', '1.replay.safetensors', 'tensorboard/events', 'command.txt'
    for part in ('former1', 'former2'):
        for name in (*names, 'mine'):
            (tmp_path / name).write_text(f'{part} {name}')
        train_run(small(total_steps=400, learning_starts=1000), tmp_path)
        assert f'an earlier run in {tmp_path}' in capsys.readouterr().err
        for name in names:
            assert (tmp_path / part / name).read_text() == f'{part} {name}'
        assert (tmp_path / 'mine').exists() and not (tmp_path / '1.replay.safetensors').exists()
        (tmp_path / STATE).unlink()


def test_an_observation_that_is_not_finite_stops_the_run(tmp_path):
    trainer = trainer_of(tmp_path)
    collect = trainer.collector.collect

    def broken(*arguments):
        episodes, success = collect(*arguments)
        episodes.observation[3, 20, 1] = np.inf
        return episodes, success

    trainer.collector.collect = broken
    with pytest.raises(TrainingError, match='observation is not finite after 0'):
        trainer.train()


def test_a_first_cycle_in_which_all_simulations_diverge_does_not_end_a_run(tmp_path, monkeypatch):
    """Also not for a third-party task, whose first rewards are checked."""
    monkeypatch.setattr(GoalMetric, 'has_own_reward', True)
    trainer = trainer_of(tmp_path, total_steps=400)
    collect, kept = trainer.collector.collect, iter([slice(0)])

    def diverging(policy):
        episodes, success = collect(policy)
        return episodes.select(next(kept, slice(None))), success

    trainer.collector.collect = diverging
    assert trainer.train() == '400 environment steps done'


def test_the_best_actor_is_kept_and_ties_go_to_the_better_return(tmp_path):
    trainer = trainer_of(tmp_path, evaluation_episodes=4)

    def evaluated(steps, successes, mean_return, count=4):
        returns = np.full(count, mean_return)
        outcomes = outcomes_of(np.arange(count) < successes, episode_return=returns)
        trainer.counters.env_steps = steps
        actor = trainer.learner.evaluation_actor()
        trainer.folder.keep_best(outcomes, actor, trainer.counters)
        return checkpoint.read_info(tmp_path / 'best.safetensors').env_steps

    assert evaluated(1, 2, -9.0) == 1
    assert evaluated(2, 1, -1.0) == 1
    assert evaluated(3, 2, -8.0) == 3
    assert evaluated(4, 2, -8.5) == 3
    assert evaluated(5, 2, -1.0, count=2) == 3, 'an evaluation cut short decides nothing'
    assert evaluated(6, 3, -20.0) == 6


PROGRAM = """
import pytest
import torch
from policy_node.training.machine import join_workers, leave_workers
from policy_node.training.experience.experience import RunningStatistics
from policy_node.policies.actor import Normalizer

workers = join_workers(torch.device('cpu'))
rank = workers.rank
assert workers.world_size == 2 and workers.is_first == (rank == 0)

gradients = [torch.full((2, 3), float(rank)), torch.arange(4.0) * (rank + 1)]
workers.average_gradients(gradients)
assert gradients[0].eq(0.5).all() and gradients[1].tolist() == [0.0, 1.5, 3.0, 4.5]

weights = [torch.full((3,), float(rank + 7)), torch.full((1, 2), float(rank))]
workers.broadcast(weights)
assert weights[0].eq(7).all() and weights[1].eq(0).all()

assert workers.any(rank == 1) and not workers.any(False)
assert workers.share(9) == 5

statistics, normalizer = RunningStatistics(1), Normalizer(1)
statistics.update([[[1.0], [3.0]], [[5.0]]][rank], workers)
statistics.write(normalizer)
assert normalizer.mean.item() == 3.0 and abs(normalizer.std.item() - (8 / 3) ** 0.5) < 1e-6
leave_workers(workers)
"""


@pytest.mark.release
def test_two_workers_agree():
    run_two_workers('--no-python', sys.executable, '-c', PROGRAM)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ('', '--task is missing'),
        ('--task FetchReach --set gama=1', "did you mean 'gamma'?"),
        ('--task FetchReach --no-her --strategy final', '--no-her excludes'),
        ('--task FetchReach --her --set strategy=none', '--her excludes strategy none'),
        ('--task FetchReach --set gamma=.9 --gamma .95', '--gamma 0.95 excludes --set gamma=0.9'),
        ('--task FetchReach --replay-transitions 1000 --learning-starts 1001', '1001 or more'),
        (f'{PPO} --task FetchReach --from-episodes .', 'ppo excludes --from-episodes'),
        ('--task FetchReach --past-actions 2 --from-episodes .', 'past_actions excludes --'),
        ('--recipe robust --task FetchReach --from-episodes .', 'imitation excludes --from-epis'),
        ('--resume nowhere', 'nowhere/training_state.safetensors does not exist: the folder '),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(arguments, message, capsys, tmp_path):
    output = [] if '--resume' in arguments else ['--output', str(tmp_path)]
    assert main([*arguments.split(), *output]) == 2
    assert message in one_line(capsys)


@pytest.fixture(scope='module')
def saved_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('saved')
    trainer_of(folder, strategy='none').save()
    return folder


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--task', 'FetchSlide'], 'is a run of FetchReach, not of FetchSlide'),
        (['--recipe', 'paper'], 'is a run of best, not of paper'),
        (['--her'], '--her excludes strategy none: give another --strategy'),
        (['--output', 'elsewhere'], '--output excludes --resume'),
        (['--set', 'init_from=FetchReach'], "init_from '', which cannot change to 'FetchReach'"),
        (['--quantiles', '5'], 'quantiles 1, which cannot change to 5'),
        (['--past-actions', '2'], 'past_actions 0, which cannot change to 2'),
        (['--hidden-sizes', '9,9'], 'hidden_sizes (16, 16), which cannot change to (9, 9)'),
        (['--reward-type', 'dense'], "reward_type 'sparse', which cannot change to 'dense'"),
    ],
)
def test_a_resumed_run_rejects_changed_networks_and_experience(
    saved_run, arguments, message, capsys
):
    assert main(['--resume', str(saved_run), *arguments]) == 2
    assert message in one_line(capsys)
