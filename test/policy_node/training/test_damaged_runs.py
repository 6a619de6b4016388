"""Runs with damaged or wrong files: a one-line error, or the run continues."""

from __future__ import annotations

import json
import os
import re
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from policy_node.policies.files import read_tensors, write_tensors
from policy_node.policies.loading import shipped_actors
from policy_node.training.experience.episode_files import load_replay
from policy_node.training.experience.replay import EpisodeReplay
from policy_node.training.machine import available_memory
from policy_node.training.runs import run as run_module
from policy_node.training.runs.initial_networks import read_initial_networks
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import read_counters
from policy_node.training.train_her import main
from support.runs import SMALL, STATE, one_line, options_of, resumed

REPLAY, BEST = 'replay.safetensors', 'best.safetensors'


def change_state(run, part=None, change=None, counters=None, **extra):
    """Change a tensor, or remove it or a part of the state; change counters and other metadata."""
    tensors, metadata = read_tensors(run / STATE)
    chosen = [name for name in tensors if name == part or name.startswith(f'{part}.')]
    changed = {name: change(tensors[name]) for name in chosen if change}
    kept = {name: values for name, values in tensors.items() if name not in chosen}
    metadata['counters'] = json.dumps(json.loads(metadata['counters']) | (counters or {}))
    metadata['extra'] = json.dumps(json.loads(metadata['extra']) | extra)
    write_tensors(run / STATE, kept | changed, metadata)


def nan(values):
    return np.full_like(values, np.nan)


def shorter(values):
    return values[:1]


def refusal(run, capsys, *more):
    assert main(['--resume', str(run), '--steps', '1600', *more]) == 2
    return one_line(capsys)


@pytest.mark.parametrize(
    ('counters', 'message'),
    [
        ({'env_steps': 'abc'}, "env_steps is 'abc'"),
        ({'env_steps': -400}, 'env_steps is -400'),
        ({'env_steps': 1200.5}, 'env_steps is 1200.5'),
        ({'episodes': True}, 'episodes is True'),
        ({'best_success': float('nan')}, 'best_success is nan'),
        ({'zzz': 1}, "'zzz'"),
    ],
)
def test_invalid_counters_are_rejected(run, counters, message):
    change_state(run, counters=counters)
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        read_counters(run / STATE)
    assert f'{run / STATE} has unreadable metadata: ' in str(raised.value)


def test_an_invalid_origin_is_rejected(run, capsys):
    change_state(run, init_from=[1])
    assert 'init_from is not an object' in refusal(run, capsys)


@pytest.mark.parametrize(
    ('part', 'change', 'message'),
    [
        ('actor.network.output.bias', nan, 'actor.network.output.bias'),
        # Adam's fused step would write beyond the end of these.
        ('critic_optimizer.0.exp_avg', shorter, 'exp_avg of parameter 0 is (1, 17) torch.float32'),
        ('critic_optimizer.1.step', None, 'parameter 1 has'),
        ('critic_optimizer', None, 'critic_optimizer is missing'),
        ('goal_statistics.count', None, 'Missing key(s) in state_dict: "count"'),
        ('actor.network.output.bias', shorter, 'Actor: size mismatch for network.output.bias'),
    ],
)
def test_invalid_tensors_are_rejected(run, part, change, message):
    change_state(run, part, change)
    with pytest.raises(ValueError, match=re.escape(message)):
        resumed(run)


def test_an_actor_is_no_training_state(run, capsys):
    shutil.copy(run / BEST, run / STATE)
    assert 'fetch_hand_actor' in refusal(run, capsys)


def test_no_run_starts_from_networks_that_are_not_finite(run):
    change_state(run, 'critic.network.output.bias', nan)
    with pytest.raises(ValueError, match=r'critic\.network\.output\.bias'):
        read_initial_networks(str(run))


@pytest.mark.parametrize(
    ('name', 'change', 'message'),
    [
        ('observation', nan, 'observation has a value that is not'),
        ('observation', lambda a: a.astype(np.int32), 'observation is int32, not float32'),
        # NumPy would give the one goal to every episode.
        ('desired_goal', shorter, 'desired_goal is (1, 3), action (24, 50, 4)'),
        ('action', lambda a: np.zeros((), np.float32).reshape(1)[0:1], 'observation is (24, 51'),
    ],
)
def test_an_invalid_replay_is_rejected(run, name, change, message):
    tensors = load_file(run / REPLAY)
    save_file(tensors | {name: change(tensors[name])}, run / REPLAY)
    with pytest.raises(ValueError, match=re.escape(f'is no replay of this run: {message}')):
        load_replay(run / REPLAY, EpisodeReplay(24, 50, 10, 3, 4))


@pytest.mark.parametrize(
    ('log', 'best'),
    [
        (bytes(range(256)) * 10, None),
        (b'env_steps\n9999\n', shipped_actors()['FetchPush'].read_bytes()),
    ],
)
def test_an_invalid_log_best_actor_or_curve_does_not_stop_a_run(run, log, best, capsys):
    change_state(run, counters={'best_success': 1.0, 'best_return': 0.0})
    (run / 'progress.csv').write_bytes(log)
    (run / BEST).unlink() if best is None else (run / BEST).write_bytes(best)
    (run / 'curve.png').unlink(missing_ok=True)
    (run / 'curve.png').mkdir()
    assert main(['--resume', str(run), '--steps', '1600']) == 0
    said = capsys.readouterr().err
    assert 'the next evaluated actor replaces it' in said and 'Traceback' not in said
    assert 'no curve, the run itself is saved: ' in said
    assert read_tensors(run / BEST)[1]['task'] == '"FetchReach"'
    assert [row['env_steps'] for row in read_progress(run / 'progress.csv')] == [1_600]


@pytest.mark.parametrize(
    'success',
    [
        {'episodes': 1000, 'rule': 'gymnasium', 'mean_return': 1, 'last_step': 5},
        {'episodes': 1000, 'rule': 'gymnasium', 'mean_return': None, 'last_step': 0.5},
    ],
)
def test_a_best_actor_with_an_invalid_evaluation_has_no_effect(run, success):
    tensors, metadata = read_tensors(run / BEST)
    write_tensors(run / BEST, tensors, metadata | {'success': json.dumps(success)})
    counters = resumed(run).counters
    assert counters.best_success == read_counters(run / STATE).best_success < 5


@pytest.mark.parametrize('resumed', [True, False])
def test_a_full_disk_is_reported_with_the_file(run, resumed, capsys, monkeypatch):
    def full(descriptor):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    fields = options_of(**SMALL)
    fresh = ['--task', 'FetchReach', '--output', str(run.parent / 'new'), *fields]
    where = ['--resume', str(run)] if resumed else fresh
    assert main([*where, '--steps', '1600']) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "No space left on device: '" in said and "safetensors'; " in said
    kept = f'the last checkpoint is in {run}'
    none = f'{run.parent / "new"} contains no checkpoint'
    assert said.endswith(kept if resumed else none)


def test_a_run_larger_than_the_memory_is_one_line(tmp_path, capsys):
    arguments = ['--task', 'FetchReach', '--threads', '1', '--torch-threads', '1']
    size = 'replay_transitions=10000000000000'
    assert main([*arguments, '--set', size, '--output', str(tmp_path)]) == 2
    assert 'not enough memory; use smaller replay_transitions' in one_line(capsys)


# A step of FetchReach is 10 + 3 + 4 numbers of 4 bytes; an episode has one observation more and a
# goal.
WHOLE = 16 * (51 * 13 + 3 + 50 * 4) * 4


@pytest.mark.parametrize(
    ('available', 'is_supported'), [(WHOLE, False), (WHOLE - 1, True), (None, True)]
)
def test_too_little_memory_and_emulated_bfloat16_are_reported_at_the_start(
    tmp_path, monkeypatch, capsys, available, is_supported
):
    monkeypatch.setattr('torch.cpu._is_avx512_bf16_supported', lambda: is_supported)
    monkeypatch.setattr(run_module, 'available_memory', lambda: available)
    changes = {'num_envs': 2, 'total_steps': 800, 'device': 'cpu', 'precision': 'bfloat16'}
    fields = options_of(**SMALL | changes)
    assert main(['--task', 'FetchReach', *fields, '--output', str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert ('use precision=float32' in said) != is_supported
    assert ('a smaller replay_transitions would fit' in said) == (available == WHOLE - 1)


def test_the_available_memory_is_known_here():
    available = available_memory()
    assert available is not None and 10**7 < available < 10**14
