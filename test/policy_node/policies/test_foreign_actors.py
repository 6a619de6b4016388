"""Actors in other formats answer as their originals do: ONNX files and Stable-Baselines3's."""

from __future__ import annotations

import sys
import zipfile

import gymnasium
import numpy as np
import pytest

import fetch_hand_sim  # noqa: F401  registers the environments
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.actions import command_from_action
from msgs_spec.tasks import task_spec
from policy_node.policies.actor import load_actor
from policy_node.policies.commander import make_commander
from policy_node.policies.export_actor import main as export_actor
from policy_node.policies.shipped import shipped_actors

REACH = task_spec('FetchReach')


@pytest.fixture(scope='module')
def status():
    return EpisodeRunner(Simulation('FetchReach', num_threads=1)).waiting_status()


@pytest.fixture(scope='module')
def onnx_file(tmp_path_factory):
    path = tmp_path_factory.mktemp('onnx') / 'reach.onnx'
    assert export_actor(['FetchReach', str(path)]) == 0
    return path


def random_observation(seed):
    generator = np.random.default_rng(seed)
    return {
        'observation': generator.normal(size=REACH.observation_size),
        'achieved_goal': generator.normal(size=3),
        'desired_goal': generator.normal(size=3),
    }


def test_onnx_actor_answers_as_its_checkpoint(onnx_file, status):
    commander, actor = make_commander(str(onnx_file), status), load_actor('FetchReach')
    for seed in range(20):
        observation = random_observation(seed)
        wanted = command_from_action(REACH.robot, actor.predict(observation)[0])
        np.testing.assert_allclose(commander.command(observation), wanted, atol=1e-5)
    assert commander.description == 'actor reach.onnx'
    assert len(commander.sha256) == 64


def test_onnx_actor_solves_its_task(onnx_file, status):
    commander = make_commander(str(onnx_file), status)
    runner = EpisodeRunner(Simulation('FetchReach', num_threads=1), first_seed=5, episodes=3)
    successes, command = [], np.zeros(4)
    while not runner.is_done:
        tick = runner.advance(command)
        observation = runner.simulation.observe()
        command = commander.command({name: rows[0] for name, rows in observation.items()})
        if tick.status.phase == 'finished':
            successes.append(tick.is_success)
    assert successes == [True, True, True]


def test_onnx_runs_without_torch(onnx_file):
    code = (
        'import sys; from pathlib import Path\n'
        'from msgs_spec.tasks import task_spec\n'
        'from policy_node.policies.onnx import OnnxCommander\n'
        f'OnnxCommander(Path({str(onnx_file)!r}), task_spec("FetchReach"), "")\n'
        'assert "torch" not in sys.modules'
    )
    import subprocess

    subprocess.run([sys.executable, '-c', code], check=True)


def test_onnx_of_another_task_or_damaged_is_refused_in_one_line(onnx_file, tmp_path, status):
    hand = EpisodeRunner(Simulation('HandReach', num_threads=1)).waiting_status()
    with pytest.raises(ValueError, match=r'reach.onnx was trained on FetchReach, not on HandReach'):
        make_commander(str(onnx_file), hand)
    cut = tmp_path / 'cut.onnx'
    cut.write_bytes(onnx_file.read_bytes()[:1000])
    with pytest.raises(ValueError, match='is not a readable ONNX file') as error:
        make_commander(str(cut), status)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('library', 'suffix', 'line'),
    [
        ('onnxruntime', '.onnx', 'reach.onnx needs onnxruntime: pip install onnxruntime'),
        ('stable_baselines3', '.zip', 'sac.zip needs stable-baselines3: pip install stable-'),
    ],
)
def test_a_missing_library_is_named(
    library, suffix, line, onnx_file, tmp_path, status, monkeypatch
):
    path = onnx_file
    if suffix == '.zip':
        path = tmp_path / 'sac.zip'
        with zipfile.ZipFile(path, 'w') as file:
            module = '{"policy_class": {"__module__": "stable_baselines3.sac.policies"}}'
            file.writestr('data', module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=line):
        make_commander(str(path), status)


def test_export_says_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'onnxscript', None)
    assert export_actor(['FetchReach', str(tmp_path / 'x.onnx')]) == 1
    assert 'pip install onnx onnxscript' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert export_actor([str(tmp_path / 'none'), str(tmp_path / 'x.onnx')]) == 2
    assert ', '.join(shipped_actors()) in capsys.readouterr().err


@pytest.mark.parametrize('algorithm', ['SAC', 'TD3', 'DDPG'])
def test_stable_baselines3_model_answers_as_it_does_there(algorithm, tmp_path, status):
    library = pytest.importorskip('stable_baselines3')
    env = gymnasium.make('fetch_hand_sim/FetchReach-v0')
    model = getattr(library, algorithm)(
        'MultiInputPolicy',
        env,
        replay_buffer_class=library.HerReplayBuffer,
        policy_kwargs={'net_arch': [32, 32]},
        buffer_size=1000,
        seed=1,
    )
    path = tmp_path / 'model.zip'
    model.save(path)
    commander = make_commander(str(path), status)
    for seed in range(5):
        observation = random_observation(seed)
        action, _ = model.predict(observation, deterministic=True)
        wanted = command_from_action(REACH.robot, action)
        assert commander.command(observation).tolist() == wanted.astype(np.float64).tolist()
    hand = EpisodeRunner(Simulation('HandReach', num_threads=1)).waiting_status()
    with pytest.raises(ValueError, match=r'has shapes .*\(10,\).*; HandReach has .*\(63,\)'):
        make_commander(str(path), hand)


def test_another_zip_is_refused(tmp_path, status):
    path = tmp_path / 'other.zip'
    with zipfile.ZipFile(path, 'w') as file:
        file.writestr('readme', 'hello')
    with pytest.raises(ValueError, match=r'is not a file of Stable-Baselines3'):
        make_commander(str(path), status)
    path.write_bytes(b'no zip')
    with pytest.raises(ValueError, match=r'is not a file of Stable-Baselines3'):
        make_commander(str(path), status)
