"""Shipping of actors: which are shipped, and that a folder of actors stays consistent."""

from __future__ import annotations

import errno
import json
import os

import pytest

from policy_node.policies.files import read_tensors, write_tensors
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.runs.run import Caller, train_run
from policy_node.training.ship_actor import main
from support.runs import SMALL, one_line

NAMES = ('FetchReach', 'FetchReach_robust')
TEXT = '{"success_gymnasium": 0.5, "mean_return": -1, "episodes": "9"}'


def ship(run, actors, episodes):
    options = ['--episodes', str(episodes), '--threads', '1', '--actors', str(actors)]
    return main([str(run), *options])


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
