"""The benchmark: its jobs, how they go on, statistics over seeds, report and bad usage."""

from __future__ import annotations

import dataclasses
import fcntl
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from policy_node.policies.checkpoint import read_info
from policy_node.training.configuration.flat import to_flat
from policy_node.training.runs.run_folder import LOCK_FILE
from policy_node.training.runs.training_state import (
    read_state,
    state_bytes,
)
from policy_node.training.studies.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.studies.measures import Curve
from policy_node.training.studies.report import aggregate, draw
from policy_node.training.studies.workers import is_finished
from support import wait_until

# Jobs of a second or two: 8 simulations, 3 cycles, 2 of them evaluated.
SMALL = [
    *['--seeds', '0', '--steps', '1200', '--episodes', '4'],
    *['--set', 'num_envs=8', '--set', 'updates_per_cycle=4', '--set', 'batch_size=64'],
    *['--set', 'evaluate_every=400', '--set', 'evaluation_episodes=8'],
]


def small(output: Path, *more: str) -> list[str]:
    return [*SMALL, '--output', str(output), '--report', str(output), *more]


def curve(*success: float) -> Curve:
    return Curve(100.0 * np.arange(1, len(success) + 1), np.array(success))


def test_jobs_come_seed_by_seed_with_all_variants(tmp_path: Path) -> None:
    options = ['--tasks', 'FetchReach', 'FetchPush', '--seeds', '3', '4', '--output', str(tmp_path)]
    jobs = jobs_from_arguments(parse_arguments(options))
    assert [job.name for job in jobs[:5]] == [
        'FetchReach/her_sparse/seed3',
        'FetchReach/her_dense/seed3',
        'FetchReach/ddpg_sparse/seed3',
        'FetchReach/ddpg_dense/seed3',
        'FetchReach/her_sparse/seed4',
    ]
    assert len({job.folder for job in jobs}) == len(jobs) == 16
    assert jobs[-1].folder == tmp_path / 'FetchPush' / 'ddpg_dense' / 'seed4'
    arms = {(job.arm.name, to_flat(job.config)['reward_type'], job.config.strategy) for job in jobs}
    assert arms == {
        ('her_sparse', 'sparse', 'future'),
        ('her_dense', 'dense', 'future'),
        ('ddpg_sparse', 'sparse', 'none'),
        ('ddpg_dense', 'dense', 'none'),
    }


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
    logs = [
        tmp_path / 'FetchReach' / arm / 'seed0' / 'progress.csv'
        for arm in ('her_sparse', 'her_dense')
    ]
    wait_until(lambda: all(log.is_file() for log in logs), 'log', 120.0)
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
    error = capsys.readouterr().err
    assert 'contains a run with batch_size 64, now 32. Choose another --output.' in error
    assert error.count('\n') == 1


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--set', 'gama=1'], "'gama=1' is not name=value; did you mean 'gamma'?; names: "),
        (['--set', 'seed=1'], '--set seed is not possible: jobs differ in it'),
        (['--arms', 'td3'], "--arms 'td3'; allowed in paper: her_sparse, "),
        (['--steps', '0'], 'total_steps 0; allowed: 1 or more'),
        (['--steps', '9', '--set', 'total_steps=8'], '--steps 9 excludes --set total_steps=8'),
        (['--study', 'goals', '--actors', 'x'], '--actors belongs to --study best'),
        (['--set', 'init_from=FetchReach'], '--set init_from is not possible'),
        (['--study', 'unbiased', '--tasks', 'FetchSlide'], 'FetchSlide; allowed in unbiased: F'),
        (['--set', 'time_limit=2'], '--set time_limit is not possible: a job ends when its steps'),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([*arguments, '--output', str(tmp_path / 'runs')]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1
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
