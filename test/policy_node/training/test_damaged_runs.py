"""Runs with damaged or wrong files, and the shipping of their actors."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from policy_node.policies.files import read_tensors, write_tensors
from policy_node.policies.loading import shipped_actors
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.evaluation import FIRST_SEED
from policy_node.training.experience.episode_files import load_replay
from policy_node.training.experience.replay import EpisodeReplay
from policy_node.training.machine import available_memory
from policy_node.training.runs import run as run_module
from policy_node.training.runs.initial_networks import read_initial_networks
from policy_node.training.runs.run import Caller, train_run
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import read_counters
from policy_node.training.ship_actor import ACTORS
from policy_node.training.ship_actor import main as ship_actor
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
    ('available', 'device', 'is_supported', 'others'),
    [
        (WHOLE, 'cpu', False, {}),
        (WHOLE - 1, 'cpu', True, {}),
        (None, 'cuda', True, {}),
        (None, 'cpu', False, {'algorithm': 'ppo', 'overlap': False}),
    ],
)
def test_too_little_memory_and_emulated_bfloat16_are_reported_at_the_start(
    tmp_path, monkeypatch, capsys, available, device, is_supported, others
):
    """Learning on a GPU needs no bfloat16 of the processor, and PPO computes in float32."""
    supporting = is_supported and device == 'cpu'
    monkeypatch.setattr('torch.cpu._is_avx512_bf16_supported', lambda: supporting)
    monkeypatch.setattr('torch.cuda.is_bf16_supported', lambda: True)
    monkeypatch.setattr(run_module, 'choose_device', lambda _: torch.device(device))
    monkeypatch.setattr(run_module, 'available_memory', lambda: available)
    changes = {'num_envs': 2, 'total_steps': 800, 'device': 'cpu', 'precision': 'bfloat16'}
    fields = options_of(**SMALL | changes | others)
    assert main(['--task', 'FetchReach', *fields, '--output', str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert ('use precision=float32' in said) == (not is_supported and not others)
    assert ('a smaller replay_transitions would fit' in said) == (available == WHOLE - 1)


def test_the_available_memory_is_known_here():
    available = available_memory()
    assert available is not None and 10**7 < available < 10**14


NAMES = ('FetchReach', 'FetchReach_robust')
TEXT = '{"success_gymnasium": 0.5, "mean_return": -1, "episodes": "9"}'


def ship(run, actors, episodes):
    options = ['--episodes', str(episodes), '--threads', '1', '--actors', str(actors)]
    return ship_actor([str(run), *options])


def files_in(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_an_evaluation_of_fewer_episodes_replaces_no_actor(run, tmp_path, capsys):
    """One lucky episode has a success of 1, better than any actor of 2,000."""
    actors = tmp_path / 'actors'
    assert ship(run, actors, 4) == 0
    said = f'ship_actor: {actors / "FetchReach.safetensors"} is now the actor of {run}\n'
    assert capsys.readouterr().out.endswith(said)
    before = files_in(actors)
    assert ship(run, actors, 3) == 2
    error = capsys.readouterr().err
    assert 'give --episodes 4 or more' in error
    assert ship(run, actors, 4) == 0
    assert 'is already this actor' in capsys.readouterr().out
    assert files_in(actors) == before


@pytest.mark.parametrize('better', ['best.safetensors', 'latest.safetensors'])
def test_the_better_of_the_best_and_the_latest_actor_is_shipped(run, tmp_path, better):
    shutil.copy(ACTORS / 'FetchReach.safetensors', run / better)
    assert ship(run, tmp_path / 'actors', 4) == 0
    report = json.loads((tmp_path / 'actors' / 'FetchReach.json').read_text())
    assert (report['checkpoint'], report['success_gymnasium']) == (better, 1.0)
    assert report['first_seed'] == FIRST_SEED


@pytest.mark.parametrize('content', ['{', '{"episodes": 1}', TEXT])
def test_an_invalid_evaluation_is_one_line(run, tmp_path, content, capsys):
    actors = tmp_path / 'actors'
    actors.mkdir()
    (actors / 'FetchReach.json').write_text(content)
    assert ship(run, actors, 2) == 2
    assert 'FetchReach.json is no evaluation of an actor' in one_line(capsys)
    assert [file.name for file in actors.iterdir()] == ['FetchReach.json']


@pytest.mark.parametrize('name', ['progress.csv', 'training_state.safetensors'])
def test_a_damaged_run_changes_no_actor(run, tmp_path, name, capsys):
    actors = tmp_path / 'actors'
    (run / name).write_bytes(b'\xff\xfe,a\n1,2\n')
    assert ship(run, actors, 2) == 2
    assert name in one_line(capsys)
    assert not actors.exists()


def test_a_folder_that_takes_no_actor_is_refused_before_any_episode(
    run, tmp_path, capsys, monkeypatch
):
    actors = tmp_path / 'actors'
    actors.touch()
    monkeypatch.setattr('policy_node.training.runs.shipping.evaluate', None)
    assert ship(run, actors, 2) == 2
    assert 'FetchReach.safetensors cannot be written: ' in one_line(capsys)


def test_a_robust_actor_is_shipped_beside_the_usual_one_and_evaluated_with_its_disturbances(
    run, tmp_path
):
    actors = tmp_path / 'actors'
    robust = tmp_path / 'robust'
    train_run(
        recipe_config(
            'FetchReach', 'robust', **SMALL | {'hidden_sizes': (256, 256, 256), 'total_steps': 800}
        ),
        robust,
        caller=Caller(quiet=True),
    )
    assert ship(run, actors, 2) == ship(robust, actors, 2) == 0
    reports = {name: json.loads((actors / f'{name}.json').read_text()) for name in NAMES}
    assert [report['actor'] for report in reports.values()] == list(NAMES)
    assert 'disturbances' not in reports['FetchReach']
    assert 'latency' in reports['FetchReach_robust']['disturbances']


def test_json_and_actor_are_of_one_run(run, tmp_path):
    """A curve without the success while exploring, as of a log from elsewhere, is drawn too."""
    rows = (run / 'progress.csv').read_text().splitlines()
    (run / 'progress.csv').write_text('env_steps,updates\n400,4\n')
    assert len(rows) > 1 and ship(run, tmp_path / 'actors', 2) == 0
    assert json.loads((tmp_path / 'actors' / 'FetchReach.json').read_text())['episodes'] == 2


def test_an_actor_of_another_rate_replaces_none(run, tmp_path, capsys):
    """Otherwise robots at the earlier rate would have no actor."""
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    before = files_in(actors)
    tensors, metadata = read_tensors(run / 'best.safetensors')
    write_tensors(run / 'best.safetensors', tensors, metadata | {'control_hz': '50.0'})
    assert ship(run, actors, 4) == 2
    assert 'acts at 25 Hz, this actor at 50 Hz' in capsys.readouterr().err
    assert files_in(actors) == before
    assert ship(run, tmp_path / 'faster', 2) == 0


def make_worse(actors):
    """Let the shipped actor be one that any other beats."""
    report = json.loads((actors / 'FetchReach.json').read_text())
    worse = report | {'run_sha256': '', 'success_gymnasium': -1.0}
    (actors / 'FetchReach.json').write_text(json.dumps(worse))


def test_the_critic_of_another_actor_does_not_stay_beside_one_that_has_none(run, tmp_path):
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    critic = actors / 'FetchReach.training.safetensors'
    assert critic.is_file()
    make_worse(actors)
    (run / 'training_state.safetensors').unlink()
    assert ship(run, actors, 2) == 0
    assert not critic.exists()


def test_a_full_disk_leaves_the_actor_before_with_all_that_belongs_to_it(
    run, tmp_path, monkeypatch, capsys
):
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    make_worse(actors)
    before = files_in(actors)
    room = iter(range(3))

    def sync(_):
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, 'fsync', sync)
    assert ship(run, actors, 2) == 2
    error = capsys.readouterr().err
    assert 'No space left on device' in error and 'FetchReach.json' in error
    assert files_in(actors) == before
