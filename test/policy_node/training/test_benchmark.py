"""The benchmark and the study of the best recipes: jobs, statistics, reports and bad usage."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from msgs_spec.tasks import TASKS
from policy_node.policies import checkpoint
from policy_node.policies.checkpoint import read_info
from policy_node.training.configuration.flat import to_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.runs.initial_networks import steps_behind
from policy_node.training.runs.run_folder import LOCK_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import (
    Counters,
    TrainingState,
    read_state,
    state_bytes,
)
from policy_node.training.studies.best import BEST
from policy_node.training.studies.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.studies.measures import Curve
from policy_node.training.studies.report import aggregate, draw
from policy_node.training.studies.store import add_run
from policy_node.training.studies.study import Job, to_settings
from policy_node.training.studies.workers import LOG_FILE, is_finished, run_jobs
from support import wait_until
from support.runs import one_line, options_of

# Jobs of a second or two: 8 simulations, 3 cycles, 2 of them evaluated.
SMALL = ['--seeds', '0', '--steps', '1200', '--episodes', '4']
SMALL += options_of(num_envs=8, updates_per_cycle=4, batch_size=64)
SMALL += options_of(evaluate_every=400, evaluation_episodes=8)


def small(output: Path, *more: str) -> list[str]:
    return [*SMALL, '--output', str(output), '--report', str(output), *more]


def curve(*success: float) -> Curve:
    return Curve(100.0 * np.arange(1, len(success) + 1), np.array(success))


def test_jobs_come_seed_by_seed_with_all_variants(tmp_path: Path) -> None:
    options = ['--tasks', 'FetchReach', 'FetchPush', '--seeds', '3', '4', '--output', str(tmp_path)]
    jobs = jobs_from_arguments(parse_arguments(options))
    arms = 'her_sparse', 'her_dense', 'ddpg_sparse', 'ddpg_dense'
    names = [
        f'{task}/{arm}/seed{seed}'
        for task in ('FetchReach', 'FetchPush')
        for seed in (3, 4)
        for arm in arms
    ]
    assert [job.name for job in jobs] == names
    assert [job.folder for job in jobs] == [tmp_path / name for name in names]
    for job in jobs:
        strategy = 'future' if 'her' in job.arm.name else 'none'
        reward = job.arm.name.partition('_')[2]
        assert (job.config.strategy, to_flat(job.config)['reward_type']) == (strategy, reward)


def test_median_and_quartiles_over_seeds() -> None:
    band = aggregate(
        [curve(0.0, 0.1), curve(0.2, 0.5), curve(0.4, 0.6), curve(0.6, 0.7), curve(1, 1)]
    )
    assert band.env_steps.tolist() == [100, 200]
    np.testing.assert_allclose(band.lower, [0.2, 0.5])
    np.testing.assert_allclose(band.median, [0.4, 0.6])
    np.testing.assert_allclose(band.upper, [0.6, 0.7])


def test_curves_evaluated_at_other_steps_meet_on_common_ones() -> None:
    late = Curve(np.array([150.0, 250.0]), np.array([0.0, 1.0]))
    band = aggregate([curve(0.0, 0.2, 0.4), late])
    assert band.env_steps.tolist() == [150, 200, 250]
    np.testing.assert_allclose(band.median, [(0.1 + 0) / 2, (0.2 + 0.5) / 2, (0.3 + 1) / 2])
    band = aggregate([curve(0.0), late])
    assert band.env_steps.size == 0, 'no common step'
    picture = draw({'FetchReach': {'her_sparse': band}}, {'her_sparse': 'DDPG+HER, sparse'})
    assert picture.startswith(b'\x89PNG')


@pytest.mark.release
def test_a_second_ctrl_c_ends_jobs_at_once(tmp_path: Path) -> None:
    """Amid an evaluation that would take minutes."""
    arguments = small(tmp_path, '--arms', 'her_sparse', 'her_dense', '--jobs', '2')
    arguments += ['--set', 'evaluation_episodes=1000000', '--set', 'evaluate_every=400']
    command = [sys.executable, '-m', 'fetch_hand_sim', 'benchmark', *arguments]
    benchmark = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: len([*tmp_path.glob('FetchReach/*/seed0/progress.csv')]) == 2, 'log', 120.0)
    time.sleep(5.0)
    benchmark.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        benchmark.wait(3.0)
    benchmark.send_signal(signal.SIGINT)
    assert benchmark.wait(30.0) == 130
    assert benchmark.stderr is not None
    assert 'once more stops at once' in benchmark.stderr.read()


@pytest.mark.release
def test_a_taken_job_and_one_whose_end_was_not_saved_are_finished_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log is ahead where the last checkpoint failed, or where a kill came before it."""
    arguments = small(tmp_path, '--arms', 'ddpg_dense', 'her_sparse')
    taken, job = jobs_from_arguments(parse_arguments(arguments))
    taken.folder.mkdir(parents=True)
    with (taken.folder / LOCK_FILE).open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(arguments) == 1
    printed = capsys.readouterr().out
    assert 'FetchReach/ddpg_dense/seed0 is being trained by another process' in printed
    assert '1 of 2 jobs are finished; the same command continues' in printed
    assert not (taken.folder / 'progress.csv').exists()
    state = job.folder / 'training_state.safetensors'
    finished = read_state(state)
    assert is_finished(job, tmp_path)
    before = dataclasses.replace(finished.counters, env_steps=800, updates=8, episodes=16)
    state.write_bytes(state_bytes(dataclasses.replace(finished, counters=before)))
    assert not is_finished(job, tmp_path)
    (tmp_path / 'runs.jsonl').unlink()
    assert main(arguments) == 0
    assert is_finished(taken, tmp_path) and is_finished(job, tmp_path)
    assert 'continues' not in capsys.readouterr().out
    assert read_info(job.folder / 'latest.safetensors').env_steps == 1200
    command = shlex.join(['fetch_hand_sim', 'benchmark', *arguments])
    assert (job.folder / 'command.txt').read_text().splitlines() == [command] * 2
    assert main([*arguments, '--set', 'batch_size=32']) == 2
    line = 'contains a run with batch_size 64, now 32. Choose another --output.'
    assert line in one_line(capsys)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--set', 'gama=1'], "'gama' is no field of TrainConfig; did you mean 'gamma'?"),
        (['--set', 'seed=1'], '--set seed is not possible: jobs differ in it'),
        (['--arms', 'td3'], "--arms 'td3'; allowed in paper: her_sparse, "),
        (['--steps', '0'], 'total_steps 0; allowed: 1 or more'),
        (['--steps', '9', '--set', 'total_steps=8'], '--steps 9 excludes --set total_steps=8'),
        (['--study', 'goals', '--actors', 'x'], '--actors belongs to --study best'),
        (['--set', 'init_from=FetchReach'], '--set init_from is not possible'),
        (['--study', 'unbiased', '--tasks', 'FetchSlide'], 'FetchSlide; allowed in unbiased: F'),
        (['--set', 'time_limit=2'], 'FetchReach/her_sparse has time_limit; jobs end when'),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([*arguments, '--output', str(tmp_path / 'runs')]) == 2
    assert message in one_line(capsys)
    assert not (tmp_path / 'runs').exists()


def test_a_missing_ray_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'ray', None)
    assert main(['--ray']) == 2
    assert "pip install 'fetch_hand_sim[cluster]'" in capsys.readouterr().err


# A cluster of its own: by far the longest of what trains.
@pytest.mark.release
def test_ray_runs_the_jobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ray = pytest.importorskip('ray')
    try:
        assert main(small(tmp_path, '--ray', '--arms', 'her_sparse', 'ddpg_dense')) == 0
        # One that starts from a shipped actor, whose name is no path.
        study = ['--study', 'unbiased', '--tasks', 'FetchPush', '--arms', 'future', '--seeds', '0']
        small_study = ['--steps', '400', '--episodes', '4', '--set', 'num_envs=4']
        folders = ['--output', str(tmp_path / 'runs'), '--report', str(tmp_path / 'page')]
        assert main([*study, *small_study, *folders, '--ray']) == 0
    finally:
        ray.shutdown()
    assert 'is finished; 0 to go' in capsys.readouterr().out
    assert len(list(tmp_path.rglob('latest.safetensors'))) == 3


TINY = ['--study', 'best', *options_of(num_envs=2, updates_per_cycle=2, batch_size=32)]
TINY += options_of(evaluation_episodes=2, evaluate_every=1000, hidden_sizes=(32, 32))
TINY += options_of(replay_transitions=4000, learning_starts=0)
EGGS = ['HandManipulateEggRotate', 'HandManipulateEggFull']


def jobs_of(*arguments: str, arms: tuple[str, ...] = ('best',)) -> list[Job]:
    return jobs_from_arguments(parse_arguments(['--study', 'best', *arguments, '--arms', *arms]))


def test_every_task_is_trained_with_its_best_recipe_after_what_it_starts_from(
    tmp_path: Path,
) -> None:
    jobs = jobs_of('--output', str(tmp_path))
    first_stages = {job.config.task: job for job in jobs if job.arm.name == 'best'}
    assert set(first_stages) == set(TASKS)
    # Second stages only of tasks that another starts from.
    others = [job.config.task for job in jobs if job.arm.name != 'best']
    assert others == ['HandManipulateBlockRotateXYZ', EGGS[0]]
    assert len(jobs) == len(TASKS) + len(others)
    for job in first_stages.values():
        number = jobs.index(job)
        start = BEST.starts.get(job.config.task)
        folder = str(tmp_path / start.task / start.arm / 'seed0') if start else ''
        chained = {**start.fields, 'init_from': folder} if start else {}
        threads = {'simulation_threads': 1, 'torch_threads': 1}
        assert job.config == recipe_config(job.config.task, 'best', **threads, **chained)
        assert job.is_ready == (start is None)
        gains_position = job.config.task.endswith('Full') and start is not None
        assert (to_flat(job.config)['first_distance'] > 1.0) == gains_position
        if start:
            assert job.config.init_from == folder and job.config.learning_starts > 0
            assert job.after in jobs[:number] and job.after.config.task == start.task
    (alone,) = jobs_of('--tasks', EGGS[1], '--output', str(tmp_path))
    # Without the task that trains its first networks, those of the shipped policy.
    assert alone.after is None and alone.config.init_from == EGGS[0]


def test_a_variant_that_continues_another_follows_it(tmp_path: Path) -> None:
    tasks = ['--tasks', 'FetchReach', 'FetchSlide', '--output', str(tmp_path)]
    slide, finetuned, reach = jobs_of(*tasks, arms=('best', 'finetuned'))
    assert reach.config.task == 'FetchReach' and finetuned.after is slide
    assert finetuned.config.recipe == 'finetune'
    assert finetuned.config.init_from == str(slide.folder)
    # Another order of `--arms` gives the same jobs, and the first stage is never left out.
    assert jobs_of(*tasks, arms=('finetuned', 'best'))[:2] == [slide, finetuned]
    assert jobs_of(*tasks, arms=('finetuned',)) == [slide, finetuned]
    with pytest.raises(ValueError, match='FetchReach; allowed with --arms finetuned: FetchSlide'):
        jobs_of('--tasks', 'FetchReach', arms=('finetuned',))


def test_only_the_last_stage_is_shipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [*TINY, '--tasks', 'FetchSlide', '--steps', '200', '--episodes', '4']
    assert main([*arguments, '--jobs', '1', '--output', str(tmp_path)]) == 0
    assert capsys.readouterr().out.count('best.safetensors succeeds in') == 1
    report = json.loads((tmp_path / 'actors' / 'FetchSlide.json').read_text())
    assert steps_behind(report) > 200, 'the steps of the first stage count too'


def test_the_status_of_a_job_says_how_far_it_is_and_how_long_it_will_take(tmp_path: Path) -> None:
    (job,) = jobs_of('--tasks', 'FetchPush', '--output', str(tmp_path), '--steps', '1000000')
    name = 'FetchPush/best/seed0'
    assert job.status == f'{name}: 0 of 1,000,000 steps, eval -, ETA -'
    job.folder.mkdir(parents=True)
    lines = ['env_steps,eval_success,steps_per_second', '200000,0.25,90', '280000,,100']
    (job.folder / 'progress.csv').write_text('\n'.join(lines))
    assert job.status == f'{name}: 280,000 of 1,000,000 steps, eval 0.250, ETA 2.0 h'


class Recorder:
    """A place where jobs take no time; one may end with another status than 0."""

    def __init__(self, report: Path, limit: int, task: str = '', status: int = 0) -> None:
        self.report, self.limit, self.failing, self.status = report, limit, task, status
        self.running: list[Job] = []
        self.order: list[str] = []
        self.most = 0

    def start(self, job: Job) -> None:
        self.order.append(job.config.task)
        self.running.append(job)
        self.most = max(self.most, len(self.running))

    def wait(self) -> tuple[Job, int]:
        job = self.running.pop(0)
        if job.config.task == self.failing:
            return job, self.status
        job.folder.mkdir(parents=True)
        counters = Counters(env_steps=job.config.total_steps)
        state = TrainingState({}, counters, {'config': {}})
        (job.folder / 'training_state.safetensors').write_bytes(state_bytes(state))
        task, arm, seed = job.key
        run = {'task': task, 'arm': arm, 'seed': seed, 'final_episodes': 0}
        add_run(self.report, {**run, 'config': to_settings(job.config)})
        return job, 0


def test_jobs_run_as_many_at_once_as_allowed_and_after_what_they_need(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also if the report cannot be written."""

    def full() -> None:
        raise OSError(28, 'No space left on device', 'runs.csv')

    place = Recorder(tmp_path, limit=3)
    jobs = jobs_of('--output', str(tmp_path))
    assert run_jobs(jobs, place, tmp_path, full) == 0
    assert place.most == 3
    assert sorted(place.order) == sorted(job.config.task for job in jobs)
    for task, start in BEST.starts.items():
        assert start.task not in place.order[place.order.index(task) :]
    said = capsys.readouterr().err
    assert "benchmark: no report yet: [Errno 28] No space left on device: 'runs.csv'" in said


def test_a_job_that_fails_stops_only_what_starts_from_it_and_a_signal_stops_all(
    tmp_path: Path,
) -> None:
    failing, jobs = 'HandManipulateBlockRotateXYZ', jobs_of('--output', str(tmp_path))
    stopped = Recorder(tmp_path, 1, jobs[0].config.task, 143)
    assert run_jobs(jobs, stopped, tmp_path, lambda: None) == 143
    assert stopped.order == [jobs[0].config.task]
    place = Recorder(tmp_path, 2, failing, 1)
    assert run_jobs(jobs, place, tmp_path, lambda: None) == 1
    lost = {failing}
    for task in BEST.tasks:
        if task in BEST.starts and BEST.starts[task].task in lost:
            lost.add(task)
    assert set(place.order) == set(TASKS) - lost | {failing}
    again = Recorder(tmp_path, limit=2)
    assert run_jobs(jobs, again, tmp_path, lambda: None) == 0
    assert set(again.order) == lost


# Nine processes that load torch: on a busy machine that takes its time.
@pytest.mark.release
@pytest.mark.timeout(900)
def test_two_at_once_are_stopped_resumed_and_shipped(tmp_path: Path) -> None:
    arguments = [*TINY, '--tasks', *EGGS, 'FetchReach', '--jobs', '2', '--steps', '2000']
    arguments += ['--episodes', '4', '--output', str(tmp_path)]
    module = [sys.executable, '-m', 'fetch_hand_sim', 'benchmark', *arguments]
    first, second, other = (tmp_path / task / 'best' / 'seed0' for task in (*EGGS, 'FetchReach'))
    process = subprocess.Popen(module, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        logs = [folder / 'progress.csv' for folder in (first, other)]
        wait_until(
            lambda: all(log.is_file() and log.read_text().count('\n') >= 2 for log in logs),
            'cycle of both jobs',
            300.0,
        )
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
        sessions = {os.getsid(int(child)) for child in children}
        assert sessions == {os.getsid(process.pid)}, 'where Linux groups by session, `nice` holds'
        process.send_signal(signal.SIGINT)
        printed, said = process.communicate(timeout=200)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 130, said
    assert said.count('stopping; jobs finish their cycle') == 1
    assert not second.exists(), 'its predecessor was not finished'
    stopped = [checkpoint.read_info(f / 'latest.safetensors').env_steps for f in (first, other)]
    assert stopped[0] < 2000 and 'jobs are finished; the same command continues' in printed
    assert 'stopped by SIGTERM' not in said and (first / LOG_FILE).is_file()

    assert main(arguments) == 0
    for folder in (first, second, other):
        assert read_progress(folder / 'progress.csv')[-1]['env_steps'] == 2000
    report = json.loads((tmp_path / 'actors' / 'HandManipulateEggFull.json').read_text())
    first_stage = report['init_from']
    assert first_stage['task'] == EGGS[1] and first_stage['init_from']['task'] == EGGS[0]
    assert steps_behind(report) > 4000
    assert report['command'].startswith('fetch_hand_sim benchmark --study best')
    names = {f'{task}{end}' for task in (*EGGS, 'FetchReach') for end in ('.json', '.png')}
    assert names <= {path.name for path in (tmp_path / 'actors').iterdir()}
    table = (tmp_path / 'actors.md').read_text()
    assert all(f'| {task} | **' in table for task in (*EGGS, 'FetchReach'))
    assert (tmp_path / 'figure.png').is_file()

    shutil.rmtree(tmp_path / 'actors')
    before = {path: path.read_bytes() for path in tmp_path.rglob('progress.csv')}
    assert main(arguments) == 0
    assert before == {path: path.read_bytes() for path in tmp_path.rglob('progress.csv')}
    assert (tmp_path / 'actors' / 'FetchReach.training.safetensors').is_file()
