"""Runs that are interrupted, shared or killed, invalid folders, and the log of a run."""

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
from dataclasses import replace

import pytest

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies import checkpoint
from policy_node.policies.files import read_tensors
from policy_node.training import evaluation
from policy_node.training.runs.run import lock_run
from policy_node.training.runs.run_log import COLUMNS, RunLog, draw_curve, read_progress
from policy_node.training.train_her import main
from support import wait_until
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


def test_a_run_that_kept_a_part_of_its_replay_reports_the_steps_that_fill_it(tmp_path, capsys):
    trained(tmp_path, total_steps=800, kept_transitions=300)
    resumed(tmp_path, total_steps=1_200).train()
    assert capsys.readouterr().err.count('500 steps fill the replay') == 1


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
    for fewer in ([], ['--steps', '400']):
        assert main(['--resume', str(run), *fewer]) == 0
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
        log = run / 'progress.csv'
        wait_until(lambda: log.is_file() and log.read_text().count('\n') >= 2, 'cycle', 90.0)
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
    log = tmp_path / 'run' / 'progress.csv'
    wanted = len(read_progress(log)) + 2
    wait_until(lambda: len(read_progress(log)) >= wanted, 'cycle without a terminal', 90.0)
    # The terminal sends it, then the shell does.
    wait_until(lambda: process.send_signal(signal.SIGHUP) or process.poll(), 'end', 90.0)
    assert process.returncode == 128 + signal.SIGHUP
    assert_is_saved(tmp_path / 'run')


@pytest.mark.parametrize('output', ['file', '/proc/run', 'file/run'])
def test_an_output_that_cannot_be_a_folder_is_one_line(output, tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main([*REACH, '--output', str(tmp_path / output)]) == 2
    error = one_line(capsys)
    assert 'cannot hold a run: ' in error and error[:-1].isprintable()


@pytest.mark.parametrize('size', [500, 30_000])
def test_a_full_disk_leaves_no_partial_file_and_does_not_end_a_run(tmp_path, capsys, size):
    trainer = trainer_of(tmp_path, total_steps=2_000, checkpoint_seconds=0, evaluate_every=1_000)
    trainer.save()
    before, log = (tmp_path / STATE).read_bytes(), RunLog(tmp_path, 2_000, 0)
    with files_at_most(size), pytest.raises(OSError):
        trainer.train(log)
    said = capsys.readouterr().err
    assert 'no checkpoint, the one before is kept: ' in said
    assert not [path for path in os.listdir(tmp_path) if path.endswith('.partial')]
    assert (tmp_path / STATE).read_bytes() == before
    log.close()
    trainer.save()
    assert counters_of(tmp_path)['updates'] == 20
    if size == 500:
        assert 'progress.csv lacks a row: ' in said and 'the best actor is not written, ' in said
        assert not (tmp_path / 'best.safetensors').exists()
        assert counters_of(tmp_path)['best_success'] == -1


def test_a_disk_that_is_too_full_for_the_replay_keeps_the_training_state(
    tmp_path, monkeypatch, capsys
):
    """A replay of 2,000 steps needs 139 kB, a training state 35 kB."""
    monkeypatch.setattr('policy_node.training.runs.run_folder.REPLAY_SECONDS', 0.0)
    trainer = trainer_of(tmp_path, total_steps=2_000, checkpoint_seconds=0)
    with files_at_most(80_000), pytest.raises(OSError, match='replay'):
        trainer.train()
    said = capsys.readouterr().err
    assert 'no newer replay for --resume: ' in said and 'no checkpoint' not in said
    assert counters_of(tmp_path)['updates'] == trainer.counters.updates == 20
    assert checkpoint.read_info(tmp_path / 'latest.safetensors').env_steps == 2_000


def row(steps, success):
    values = dict.fromkeys(COLUMNS, 1.0)
    return {**values, 'env_steps': steps, 'eval_success': success, 'train_success': 0.25}


def test_a_resumed_run_goes_on_after_its_checkpoint(tmp_path):
    for resumed_steps, steps in ((0, (100, 200, 300)), (200, (250,))):
        log = RunLog(tmp_path, 1000, 0, resumed_steps)
        for step in steps:
            log.write(row(step, None if step == 100 else step / 1000))
        log.close()
    rows = read_progress(tmp_path / 'progress.csv')
    assert [values['env_steps'] for values in rows] == [100, 200, 250]
    assert 'eval_success' not in rows[0] and rows[2]['eval_success'] == 0.25
    assert set(rows[1]) == set(COLUMNS)


@pytest.mark.parametrize('cut', ['1,200,1', '1,200,1,,0.5,-', '1,inf,1,,0.5', '1,200,1,,nan'])
def test_a_line_that_a_killed_run_cut_short_is_dropped(tmp_path, cut):
    log = RunLog(tmp_path, 1000, 0)
    log.write(row(100, 0.5))
    log.close()
    with (tmp_path / 'progress.csv').open('a') as file:
        file.write(cut)
    assert [values['env_steps'] for values in read_progress(tmp_path / 'progress.csv')] == [100]
    RunLog(tmp_path, 1000, 0, resumed_steps=200).close()
    assert [values['env_steps'] for values in read_progress(tmp_path / 'progress.csv')] == [100]


def test_the_live_line_shows_the_progress(tmp_path, capsys):
    log = RunLog(tmp_path, total_steps=7_300_000, time_limit=0)
    log.write({**row(100_000, 0.5), 'steps_per_second': 2000.0, 'seconds': 61.0})
    log.close()
    line = capsys.readouterr().err
    for part in ('100,000 steps', '2,000 steps/s', 'train 0.25', 'eval 0.500', '0:01:01'):
        assert part in line
    assert 'ETA 1:00:00' in line


def test_tensorboard_holds_the_scalars(tmp_path):
    pytest.importorskip('tensorboard')
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = RunLog(tmp_path, total_steps=1000, time_limit=0)
    log.write(row(100, 0.5))
    log.write(row(200, None))
    log.close()
    events = EventAccumulator(str(tmp_path / 'tensorboard'))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars('eval_success')] == [(100, 0.5)]
    assert [e.step for e in events.Scalars('train_success')] == [100, 200]


def test_a_removed_folder_prints_no_traceback(tmp_path, capfd):
    (tmp_path / 'run').mkdir()
    log = RunLog(tmp_path / 'run', total_steps=1000, time_limit=0, quiet=True)
    shutil.rmtree(tmp_path / 'run')
    for step in range(100, 400, 100):
        log.write(row(step, 0.5))
    log.close()
    assert capfd.readouterr().err == ''


def test_the_curve_is_a_png_that_shows_the_numbers(tmp_path):
    low = [{'env_steps': 100.0 * i, 'train_success': 0.1, 'eval_success': 0.1} for i in range(5)]
    high = [{**row, 'eval_success': 0.9} for row in low]
    pictures = []
    for rows in (low, high):
        draw_curve(rows, 'FetchReach', tmp_path / 'curve.png')
        pictures.append((tmp_path / 'curve.png').read_bytes())
    assert pictures[0][:8] == b'\x89PNG\r\n\x1a\n'
    assert pictures[0] != pictures[1]
