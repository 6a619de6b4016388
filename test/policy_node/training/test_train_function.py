"""`policy_node.training.train`: training as a function."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation.rewards import GoalMetric
from policy_node import load_policy
from policy_node.training.runs.trainer import _collecting_thread
from support import runs, script_environment

for _library in ('matplotlib', 'tensorboard'):
    pytest.importorskip(_library)
from policy_node.training import Run, train  # noqa: E402

SMALL = runs.SMALL | {'quiet': True}


def test_a_run_leaves_an_actor_its_curve_and_the_state_of_torch(tmp_path, capfd):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    run = train('FetchReach', tmp_path / 'run', total_steps=1_200, **SMALL)
    found = torch.rand(1), torch.get_num_threads()
    torch.set_num_threads(before)
    assert found == (expected, 2)
    assert isinstance(run, Run)
    assert (run.env_steps, run.reason) == (1_200, '1,200 environment steps done')
    assert load_policy(run.actor).task == 'FetchReach'
    assert [row['env_steps'] for row in run.progress()] == [400.0, 800.0, 1_200.0]
    assert (tmp_path / 'run/curve.png').is_file()
    assert capfd.readouterr() == ('', '')
    before = (tmp_path / 'run' / runs.STATE).read_bytes()
    with pytest.raises(ValueError, match='resume=True'):
        train('FetchReach', tmp_path / 'run', total_steps=400, **SMALL)
    assert (tmp_path / 'run' / runs.STATE).read_bytes() == before


def test_a_warning_names_rewards_above_0(tmp_path, capfd, monkeypatch):
    reward = GoalMetric.reward
    monkeypatch.setattr(GoalMetric, 'reward', lambda *goals, **info: reward(*goals, **info) + 100.0)
    monkeypatch.setattr(GoalMetric, 'has_own_reward', True)
    train('FetchReach', tmp_path / 'run', total_steps=800, reward_type='dense', **SMALL)
    lines = capfd.readouterr().err.splitlines()
    (line,) = (each for each in lines if 'rewards of FetchReach' in each)
    assert line.startswith('fetch_hand_sim train: rewards of FetchReach are up to 99.')
    assert 'within -1 ... 0' in line


def test_the_record_contains_all_arguments_of_each_part(tmp_path):
    """A part without a checkpoint or without a step is not recorded."""
    (tmp_path / 'command.txt').write_text('fetch_hand_sim train of before\n')
    train('FetchReach', tmp_path, recipe='best', total_steps=400, goals='future=.8', **SMALL)
    more = {'gamma': np.float64(0.9), 'total_steps': 800}
    train('FetchReach', tmp_path, resume=True, **more, quiet=True)
    train('FetchReach', tmp_path, resume=True, total_steps=800, quiet=True)
    named = {'recipe': 'best', 'total_steps': 400, 'goals': {'future': 0.8}, **runs.SMALL}
    first = ''.join(f', {name}={value!r}' for name, value in named.items())
    assert (tmp_path / 'command.txt').read_text().splitlines() == [
        f"policy_node.training.train('FetchReach', {str(tmp_path)!r}{rest})"
        for rest in (first, ', resume=True, gamma=0.9, total_steps=800')
    ]


def test_a_callback_sees_every_cycle_and_may_end_the_run(tmp_path):
    rows = []

    def on_cycle(row):
        rows.append(row)
        return np.bool_(len(rows) < 2)

    run = train('FetchReach', tmp_path / 'run', total_steps=4_000, on_cycle=on_cycle, **SMALL)
    assert (run.env_steps, run.reason) == (800, 'stopped by on_cycle')
    assert [row['env_steps'] for row in rows] == [400, 800]
    resumed = train('FetchReach', run.folder, resume=True, total_steps=1_200, quiet=True)
    assert resumed.env_steps == 1_200
    assert resumed.config.num_envs == 8


def test_an_exception_of_a_callback_is_raised_and_the_run_is_saved(tmp_path):
    """An OSError of the callback is no disk error of the run."""

    def plot(row):
        Path('/nowhere/plot.png').write_bytes(b'')

    with pytest.raises(FileNotFoundError, match=r'/nowhere/plot\.png') as caught:
        train('FetchReach', tmp_path / 'run', total_steps=4_000, on_cycle=plot, **SMALL)
    assert 'plot' in [entry.name for entry in caught.traceback]
    run = train('FetchReach', tmp_path / 'run', resume=True, total_steps=800, quiet=True)
    assert run.env_steps == 800


def test_a_second_interrupt_does_not_wait_for_a_collection():
    going = threading.Event()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), _collecting_thread() as executor:
        executor.submit(going.wait, 20.0)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 5.0
    going.set()


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        ({'task': 'FetchRech'}, "did you mean 'FetchReach'"),
        ({'on_cycle': 3}, 'on_cycle 3; allowed: None or a function'),
        ({'output': 0}, 'output 0; allowed: the path of a folder, or None'),
        ({'resume': 'no'}, "resume 'no'; allowed: True or False"),
        ({'resume': True}, 'its run has no checkpoint, or the recipe is robust'),
        ({'resume': True, 'output': None}, 'resume=True needs output'),
        ({'init_from': 'nothing'}, "no actor 'nothing'"),
    ],
)
def test_an_invalid_argument_is_a_value_error_of_one_line(arguments, said, tmp_path):
    with pytest.raises(ValueError, match=said) as error:
        train(**{'task': 'FetchReach', 'output': tmp_path / 'run', 'quiet': True, **arguments})
    assert '\n' not in str(error.value)


def test_ctrl_c_saves_the_run_and_ends_the_program_and_a_second_one_raises_at_once(tmp_path):
    code = f"""
import os, signal
from policy_node.training import train

def run(name, interrupts):
    train('FetchReach', {str(tmp_path)!r} + '/' + name, total_steps=100_000, **{SMALL!r},
          on_cycle=lambda row: [os.kill(os.getpid(), signal.SIGINT) for _ in range(interrupts)])

try:
    run('twice', 2)
except KeyboardInterrupt as error:
    print('alive', error.args)
print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)
run('once', 1)
run('never', 1)
"""
    result = subprocess.run(
        [sys.executable, '-c', code],
        env=script_environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.stdout.splitlines() == ['alive ()', 'True'], result.stderr
    assert result.returncode == -signal.SIGINT
    assert result.stderr.rstrip().endswith('KeyboardInterrupt: stopped by SIGINT')
    assert sorted(os.listdir(tmp_path)) == ['once', 'twice']
    resumed = train('FetchReach', tmp_path / 'once', resume=True, total_steps=800, quiet=True)
    assert resumed.env_steps == 800


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'torch', None)
    message = r"torch missing: pip install 'fetch_hand_sim\[train\]'"
    with pytest.raises(ModuleNotFoundError, match=message):
        from policy_node.training import train  # noqa: F401
