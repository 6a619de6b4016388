"""Shipping of actors: which are shipped, and that a folder of actors stays consistent."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
import torch

from policy_node.policies.files import read_tensors, write_tensors
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.machine import Workers
from policy_node.training.runs.run import Caller, train_run
from policy_node.training.runs.run_log import RunLog
from policy_node.training.runs.trainer import Trainer
from policy_node.training.ship_actor import main

torch.set_num_threads(1)

SMALL = {'num_envs': 8, 'updates_per_cycle': 4, 'batch_size': 64, 'evaluation_episodes': 8}
SMALL |= {'simulation_threads': 1, 'torch_threads': 1, 'total_steps': 800, 'evaluate_every': 400}


NAMES = ('FetchReach', 'FetchReach_robust')
TEXT = '{"success_gymnasium": 0.5, "mean_return": -1, "episodes": "9"}'


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / 'run'
    folder.mkdir()
    trainer = Trainer(recipe_config('FetchReach', 'best', **SMALL), folder, Workers())
    log = RunLog(folder, 800, 0.0)
    trainer.train(log)
    log.close()
    return folder


def ship(run: Path, actors: Path, episodes: int) -> int:
    options = ['--episodes', str(episodes), '--threads', '1', '--actors', str(actors)]
    return main([str(run), *options])


def test_an_evaluation_of_fewer_episodes_replaces_no_actor(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One lucky episode has a success of 1, better than any actor of 2,000."""
    actors = tmp_path / 'actors'
    assert ship(run, actors, 4) == 0
    said = f'ship_actor: {actors / "FetchReach.safetensors"} is now the actor of {run}\n'
    assert capsys.readouterr().out.endswith(said)
    before = {file.name: file.read_bytes() for file in actors.iterdir()}
    assert ship(run, actors, 3) == 2
    error = capsys.readouterr().err
    assert 'give --episodes 4 or more' in error
    assert ship(run, actors, 4) == 0
    assert 'is already this actor' in capsys.readouterr().out
    assert {file.name: file.read_bytes() for file in actors.iterdir()} == before


@pytest.mark.parametrize(
    'content', ['{', '[]', '{"episodes": 1}', '{"success_gymnasium": "x"}', TEXT]
)
def test_an_invalid_evaluation_is_one_line(
    run: Path, tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    actors = tmp_path / 'actors'
    actors.mkdir()
    (actors / 'FetchReach.json').write_text(content)
    assert ship(run, actors, 2) == 2
    error = capsys.readouterr().err
    assert 'FetchReach.json is no evaluation of an actor' in error and error.count('\n') == 1
    assert [file.name for file in actors.iterdir()] == ['FetchReach.json']


@pytest.mark.parametrize('name', ['progress.csv', 'training_state.safetensors'])
def test_a_damaged_run_changes_no_actor(
    run: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    actors = tmp_path / 'actors'
    (run / name).write_bytes(b'\xff\xfe,a\n1,2\n')
    assert ship(run, actors, 2) == 2
    error = capsys.readouterr().err
    assert name in error and error.count('\n') == 1
    assert not actors.exists()


def test_a_folder_that_takes_no_actor_is_refused_before_any_episode(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    actors = tmp_path / 'actors'
    actors.touch()
    monkeypatch.setattr('policy_node.training.runs.shipping.evaluate', None)
    assert ship(run, actors, 2) == 2
    error = capsys.readouterr().err
    assert 'FetchReach.safetensors cannot be written: ' in error and error.count('\n') == 1


def test_a_robust_actor_is_shipped_beside_the_usual_one_and_evaluated_with_its_disturbances(
    run: Path, tmp_path: Path
) -> None:
    actors = tmp_path / 'actors'
    robust = tmp_path / 'robust'
    train_run(recipe_config('FetchReach', 'robust', **SMALL), robust, caller=Caller(quiet=True))
    assert ship(run, actors, 2) == ship(robust, actors, 2) == 0
    reports = {name: json.loads((actors / f'{name}.json').read_text()) for name in NAMES}
    assert [report['actor'] for report in reports.values()] == list(NAMES)
    assert 'disturbances' not in reports['FetchReach']
    assert 'latency' in reports['FetchReach_robust']['disturbances']


def test_json_and_actor_are_of_one_run(run: Path, tmp_path: Path) -> None:
    """A curve without the success while exploring, as of a log from elsewhere, is drawn too."""
    rows = (run / 'progress.csv').read_text().splitlines()
    (run / 'progress.csv').write_text('env_steps,updates\n400,4\n')
    assert len(rows) > 1 and ship(run, tmp_path / 'actors', 2) == 0
    assert json.loads((tmp_path / 'actors' / 'FetchReach.json').read_text())['episodes'] == 2


def test_an_actor_of_another_rate_replaces_none(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise robots at the earlier rate would have no actor."""
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    before = {file.name: file.read_bytes() for file in actors.iterdir()}
    tensors, metadata = read_tensors(run / 'best.safetensors')
    write_tensors(run / 'best.safetensors', tensors, metadata | {'control_hz': '50.0'})
    assert ship(run, actors, 4) == 2
    assert 'acts at 25 Hz, this actor at 50 Hz' in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in actors.iterdir()} == before
    assert ship(run, tmp_path / 'faster', 2) == 0


def test_the_critic_of_another_actor_does_not_stay_beside_one_that_has_none(
    run: Path, tmp_path: Path
) -> None:
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    critic = actors / 'FetchReach.training.safetensors'
    assert critic.is_file()
    report = json.loads((actors / 'FetchReach.json').read_text())
    worse = report | {'run_sha256': '', 'success_gymnasium': -1.0}
    (actors / 'FetchReach.json').write_text(json.dumps(worse))
    (run / 'training_state.safetensors').unlink()
    assert ship(run, actors, 2) == 0
    assert not critic.exists()


def test_a_full_disk_leaves_the_actor_before_with_all_that_belongs_to_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    actors = tmp_path / 'actors'
    assert ship(run, actors, 2) == 0
    report = json.loads((actors / 'FetchReach.json').read_text())
    worse = report | {'run_sha256': '', 'success_gymnasium': -1.0}
    (actors / 'FetchReach.json').write_text(json.dumps(worse))
    before = {file.name: file.read_bytes() for file in actors.iterdir()}
    room = iter(range(3))

    def sync(_: int) -> None:
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, 'fsync', sync)
    assert ship(run, actors, 2) == 2
    error = capsys.readouterr().err
    assert 'No space left on device' in error and 'FetchReach.json' in error
    assert {file.name: file.read_bytes() for file in actors.iterdir()} == before
