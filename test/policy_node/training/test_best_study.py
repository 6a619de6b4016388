"""The study of the best recipes: chained, several at once, stopped, resumed and shipped."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from msgs_spec.tasks import TASKS
from policy_node.policies import checkpoint
from policy_node.training.configuration.flat import to_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.runs.initial_networks import steps_behind
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import Counters, TrainingState, state_bytes
from policy_node.training.studies.best import BEST
from policy_node.training.studies.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.studies.store import add_run
from policy_node.training.studies.study import Job, to_settings
from policy_node.training.studies.workers import LOG_FILE, run_jobs
from support import wait_until

TINY = [
    *['--study', 'best', '--set', 'num_envs=2', '--set', 'updates_per_cycle=2'],
    *['--set', 'batch_size=32', '--set', 'evaluation_episodes=2', '--set', 'evaluate_every=1000'],
    *['--set', 'hidden_sizes=32,32', '--set', 'replay_transitions=4000'],
    *['--set', 'learning_starts=0'],
]
EGGS = ['HandManipulateEggRotate', 'HandManipulateEggFull']


def jobs_of(*arguments: str) -> list[Job]:
    return jobs_from_arguments(parse_arguments(['--study', 'best', *arguments]))


def test_every_task_is_trained_with_its_best_recipe_after_what_it_starts_from(
    tmp_path: Path,
) -> None:
    jobs = jobs_of('--output', str(tmp_path))
    assert {job.config.task for job in jobs} == set(TASKS) and len(jobs) == len(TASKS)
    for number, job in enumerate(jobs):
        start = BEST.starts.get(job.config.task)
        folder = str(tmp_path / start.task / 'best' / 'seed0') if start else ''
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
    assert alone.after is None and alone.config.init_from == ''


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
    assert run_jobs(jobs_of('--output', str(tmp_path)), place, tmp_path, full) == 0
    assert place.most == 3 and sorted(place.order) == sorted(TASKS)
    for task, start in BEST.starts.items():
        assert place.order.index(start.task) < place.order.index(task)
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
    assert report['init_from']['task'] == EGGS[0] and steps_behind(report) > 2000
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
