"""Runs that are interrupted, shared or killed, and invalid folders."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies import checkpoint
from policy_node.policies.files import read_tensors
from policy_node.training import evaluation
from policy_node.training.experience.episode_files import load_replay, save_replay
from policy_node.training.experience.replay import EpisodeReplay
from policy_node.training.runs.run import lock_run
from policy_node.training.runs.run_log import read_progress
from policy_node.training.train_her import main
from support.full_disk import files_at_most
from support.runs import (
    SMALL,
    STATE,
    one_line,
    options_of,
    resumed,
    same,
    trained,
    trainer_of,
    weights,
)

REACH = ['--task', 'FetchReach', *options_of(**SMALL | {'evaluate_every': 1_000})]


class StopAfter:
    """A log that stops the run after some cycles."""

    def __init__(self, trainer, cycles=1000):
        self.trainer, self.left, self.rows = trainer, cycles, []

    def write(self, row):
        self.rows.append(row)
        self.left -= 1
        if self.left == 0:
            self.trainer.stop('interrupted')


def counters_of(run):
    return json.loads(read_tensors(run / STATE)[1]['counters'])


def test_a_run_without_its_replay_fills_it_up_before_it_goes_on(tmp_path, capsys):
    """As runs from before replays were kept."""
    trained(tmp_path, total_steps=800)
    (tmp_path / 'replay.safetensors').write_bytes(b'damaged')
    trainer = resumed(tmp_path, total_steps=1_200)
    log = StopAfter(trainer)
    trainer.train(log)
    assert [(row['env_steps'], row['updates']) for row in log.rows] == [(1_200, 12)]
    assert trainer.experience.transitions == 800 + 400
    count = trainer.experience.statistics['observation_statistics'].count.item()
    assert count == 1_200, 'what fills the replay up is no training'
    said = capsys.readouterr().err
    assert 'is no replay of this run' in said
    assert '800 steps fill the replay' in said


@pytest.mark.release
@pytest.mark.parametrize('damaged', [True, False])
def test_a_replay_that_is_no_multiple_of_an_episode_is_full_with_whole_ones(tmp_path, damaged):
    """20 episodes of 50 steps go into 1,030 transitions."""
    held = {'replay_transitions': 1_030, 'learning_starts': 1_030}
    trained(tmp_path, total_steps=2_000, **held)
    if damaged:
        (tmp_path / 'replay.safetensors').write_bytes(b'damaged')
    trainer = resumed(tmp_path, total_steps=2_400, **held)
    log = StopAfter(trainer)
    trainer.train(log)
    # Learning began with the third cycle, when 1,000 transitions were there.
    assert [(row['env_steps'], row['updates']) for row in log.rows] == [(2_400, 16)]


def test_a_best_actor_that_is_newer_than_the_checkpoint_stays(tmp_path):
    """As after a kill between an evaluation and the next checkpoint."""
    trainer = trained(tmp_path, total_steps=800)
    best = tmp_path / 'best.safetensors'
    actor, info = checkpoint.load(best)
    assert info.success['mean_return'] == pytest.approx(trainer.counters.best_return)
    great = {**info.success, 'last_step': 1.0, 'mean_return': -1.0}
    checkpoint.save(best, actor, replace(info, success=great))
    saved = best.read_bytes()
    trainer = resumed(tmp_path, total_steps=1_200)
    assert trainer.counters.best_success == 1.0
    trainer.train()
    assert best.read_bytes() == saved


def test_a_finished_run_is_not_trained_any_further_but_with_more_steps(tmp_path, capsys):
    run = tmp_path / 'run'
    assert main([*REACH, '--steps', '800', '--output', str(run)]) == 0
    before = (run / STATE).read_bytes()
    assert main(['--resume', str(run)]) == 0
    said = capsys.readouterr().out
    assert '800 environment steps done before; give another total_steps' in said
    assert (run / STATE).read_bytes() == before
    assert main(['--resume', str(run), '--steps', '1200']) == 0
    rows = [(row['env_steps'], row['updates']) for row in read_progress(run / 'progress.csv')]
    assert rows == [(400, 4), (800, 8), (1200, 12)]
    assert weights(run / STATE)['observation_statistics.count'] == 1200
    assert checkpoint.read_info(run / 'latest.safetensors').env_steps == 1200


@pytest.mark.parametrize(
    ('limit', 'message'),
    [
        ({'time_limit': 5.0}, 'time limit of 5 s reached before; give another time_limit to go on'),
        ({'success_target': 0.5}, 'success target 0.5 reached before; give another success_target'),
    ],
)
def test_a_run_that_its_limits_ended_is_not_trained_any_further(tmp_path, limit, message):
    trainer = trainer_of(tmp_path, **limit)
    trainer.counters.seconds, trainer.counters.best_success = 5.0, 0.5
    trainer.save()
    shutil.copy(tmp_path / 'latest.safetensors', tmp_path / 'best.safetensors')
    again = resumed(tmp_path, **limit)
    assert again.train().startswith(message)
    assert again.counters.env_steps == 0


@pytest.mark.parametrize(
    ('overlap', 'evaluate_every', 'at'),
    [
        (True, 400, [800, 1_200]),
        # After the first updates, and at the end.
        (True, 100_000, [800, 1_200]),
        pytest.param(False, 400, [400, 800, 1_200], marks=pytest.mark.release),
    ],
)
def test_the_last_evaluation_is_of_the_last_actor(
    tmp_path, monkeypatch, overlap, evaluate_every, at
):
    """With `overlap`, an evaluation due in the last cycle would run beside the learner."""
    fields = {'overlap': overlap, 'evaluate_every': evaluate_every}
    trainer = trainer_of(tmp_path, total_steps=1_200, **fields)
    evaluated = []

    def evaluate(simulation, actor, *options):
        evaluated.append(actor)
        return evaluation.evaluate(simulation, actor, *options)

    monkeypatch.setattr('policy_node.training.runs.trainer.evaluate', evaluate)
    log = StopAfter(trainer)
    trainer.train(log)
    assert same(evaluated[-1].state_dict(), trainer.learner.evaluation_actor().state_dict())
    rows = [row for row in log.rows if row.get('eval_success') is not None]
    assert [row['env_steps'] for row in rows] == at and len(evaluated) == len(at)
    assert trainer.counters.best_success == max(row['eval_success'] for row in rows)


def test_a_run_that_goes_on_is_evaluated_as_often_as_it_now_should(tmp_path):
    trainer = trainer_of(tmp_path)
    trainer.counters.env_steps, trainer.counters.next_evaluation = 4_000, 4_800
    trainer.save()
    for evaluate_every, due in ((400, 4_400), (1_000, 4_800), (100_000, 4_800)):
        trainer = resumed(tmp_path, evaluate_every=evaluate_every)
        assert trainer.counters.next_evaluation == due


def test_a_run_that_is_stopped_does_not_wait_for_an_evaluation(tmp_path):
    trainer = trainer_of(tmp_path, total_steps=2_000, evaluate_every=100_000)
    log = StopAfter(trainer, 3)
    assert trainer.train(log) == 'interrupted'
    assert log.rows[-1].get('eval_success') is None


def test_the_newest_episodes_are_kept_in_order(tmp_path):
    def replay():
        return EpisodeReplay(8, ticks=5, observation_size=3, goal_size=2, action_size=1)

    first, file = replay(), tmp_path / 'replay.safetensors'
    for number in range(13):
        episodes = first.newest(0)
        shapes = {name: getattr(episodes, name).shape[1:] for name in type(episodes).__slots__}
        full = {name: np.full((1, *shape), number, np.float32) for name, shape in shapes.items()}
        first.add(type(episodes)(**full))
    for transitions, kept in ((0, []), (1, [12]), (15, [10, 11, 12]), (1000, list(range(5, 13)))):
        save_replay(file, first, transitions)
        second = replay()
        load_replay(file, second)
        assert second.newest(8).action[:, 0, 0].tolist() == kept
    with pytest.raises(ValueError, match=r'replay\.safetensors'):
        load_replay(file, EpisodeReplay(8, 5, 3, 2, action_size=4))


def test_a_folder_that_is_being_trained_is_refused(tmp_path, capsys):
    run = tmp_path / 'run'
    with lock_run(run):
        assert main([*REACH, '--steps', '400', '--output', str(run)]) == 1
    assert f'{run} is being trained by another process' in one_line(capsys)
    assert sorted(path.name for path in run.iterdir()) == ['.lock']
    with lock_run(run):
        pass


def test_a_file_system_without_locks_takes_runs(tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, 'flock', refuse)
    with lock_run(tmp_path / 'run'), alone_in(tmp_path / 'report'):
        pass
    assert 'has no lock against other processes' in one_line(capsys)


@pytest.fixture
def start_run(tmp_path):
    """Starts a long run in `run` and waits until it has logged a cycle."""
    run = tmp_path / 'run'
    arguments = [*REACH, '--steps', '100000000', '--output', str(run)]
    command = [sys.executable, '-m', 'policy_node.training.train_her', *arguments]
    started = []

    def start(output=subprocess.PIPE):
        streams = {'stdout': output, 'stderr': output, 'text': True}
        # Without a live line.
        environment = {**os.environ, 'TERM': 'dumb'}
        started.append(process := subprocess.Popen(command, env=environment, **streams))
        deadline = time.monotonic() + 90
        log = run / 'progress.csv'
        while not log.is_file() or log.read_text().count('\n') < 2:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def assert_is_saved(run):
    """The state is as new as the log, and all files are there."""
    steps, counters = read_progress(run / 'progress.csv')[-1]['env_steps'], counters_of(run)
    assert counters['env_steps'] == steps >= 400 and counters['updates'] == steps / 100
    assert (run / 'replay.safetensors').is_file() and (run / 'curve.png').is_file()


@pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.release)]
)
def test_a_signal_is_answered_at_once_and_keeps_the_run(tmp_path, start_run, number):
    process = start_run()
    process.send_signal(number)
    lines = iter(process.stderr.readline, '')
    assert any('fetch_hand_sim train: stopping after this cycle' in line for line in lines)
    assert process.poll() is None, 'said before the cycle was over'
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert f'stopped by {number.name}' in output
    assert_is_saved(tmp_path / 'run')


def test_a_closed_terminal_keeps_the_run(tmp_path, start_run):
    terminal, its_other_end = pty.openpty()
    process = start_run(its_other_end)
    os.close(its_other_end)
    os.close(terminal)
    log, deadline = tmp_path / 'run' / 'progress.csv', time.monotonic() + 90
    wanted = len(read_progress(log)) + 2
    while len(read_progress(log)) < wanted:
        assert process.poll() is None and time.monotonic() < deadline, 'it ended with its terminal'
        time.sleep(0.05)
    # The terminal sends it, then the shell does.
    while process.poll() is None:
        assert time.monotonic() < deadline
        process.send_signal(signal.SIGHUP)
        time.sleep(0.01)
    assert process.returncode == 128 + signal.SIGHUP
    assert_is_saved(tmp_path / 'run')


@pytest.mark.parametrize('output', ['file', '/proc/run', 'file/run'])
def test_an_output_that_cannot_be_a_folder_is_one_line(output, tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main([*REACH, '--output', str(tmp_path / output)]) == 2
    error = one_line(capsys)
    assert 'cannot hold a run: ' in error and error[:-1].isprintable()


def test_a_full_disk_leaves_no_partial_file_and_the_checkpoint_before(tmp_path, capsys):
    trainer = trainer_of(tmp_path, total_steps=2_000, checkpoint_seconds=0, evaluate_every=1_000)
    trainer.save()
    before = (tmp_path / STATE).read_bytes()
    for size in (1_000, 30_000):
        with files_at_most(size), pytest.raises(OSError):
            trainer.train()
        assert 'no checkpoint, the one before is kept: ' in capsys.readouterr().err
        assert not [path for path in os.listdir(tmp_path) if path.endswith('.partial')]
        assert (tmp_path / STATE).read_bytes() == before
    trainer.save()
    assert counters_of(tmp_path)['updates'] == 20
