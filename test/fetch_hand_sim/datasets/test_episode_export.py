"""Datasets made of logged episodes, read back by the libraries they are for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from fetch_hand_sim.commands import episodes_export
from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes
from policy_node.training import generate_episodes
from support.episode_recorder import Recorder

TASK = 'FetchPush'


@pytest.fixture(scope='module')
def episodes(tmp_path_factory):
    directory = tmp_path_factory.mktemp('episodes')
    arguments = ['--policy', 'random', '--task', TASK, '--episodes', '2', '--threads', '1']
    assert generate_episodes.main([*arguments, '--output', str(directory)]) == 0
    return directory


def test_parquet_holds_every_value(episodes, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    arguments = [str(episodes), '--to', 'parquet', '--output', str(tmp_path)]
    assert episodes_export.main(arguments) == 0
    assert '2 episodes of FetchPush' in capsys.readouterr().out
    rows = parquet.read_table(tmp_path / f'{TASK}.parquet').to_pylist()
    about = parquet.read_table(tmp_path / f'{TASK}_episodes.parquet').to_pylist()
    loaded = load_episodes(episodes)
    assert len(rows) == 2 * 51
    for index, arrays in enumerate(loaded):
        mine = rows[51 * index : 51 * (index + 1)]
        assert [(row['episode_index'], row['step']) for row in mine] == [
            (index, step) for step in range(51)
        ]
        for key, values in arrays.observations.items():
            np.testing.assert_array_equal([row[key] for row in mine], values)
        steps = {'action': arrays.actions, 'command': arrays.commands, 'reward': arrays.rewards}
        steps |= {'terminated': arrays.terminated, 'truncated': arrays.truncated}
        steps |= {'next_success': arrays.success[1:]}
        for key, values in steps.items():
            np.testing.assert_array_equal([row[key] for row in mine[:-1]], values)
            assert mine[-1][key] is None
        assert mine[1]['timestamp'] == 0.04
        assert (about[index]['seed'], about[index]['steps']) == (index, 50)
        assert json.loads(about[index]['metadata']) == arrays.metadata
        said = json.loads(about[index]['result'])
        assert about[index]['return'] == float(said['return']), 'the last bit too'
    assert episodes_export.main(arguments) == 1
    assert 'nothing is overwritten' in capsys.readouterr().err


def test_minari_holds_every_value_and_recovers_the_environment(episodes, tmp_path, monkeypatch):
    minari = pytest.importorskip('minari')
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
    arguments = [str(episodes), '--to', 'minari', '--output', str(tmp_path)]
    assert episodes_export.main(arguments) == 0
    dataset = minari.load_dataset(f'{TASK}/logged-v0')
    assert (dataset.total_episodes, dataset.total_steps) == (2, 100)
    for episode, arrays in zip(dataset.iterate_episodes(), load_episodes(episodes), strict=True):
        for key, values in arrays.observations.items():
            assert episode.observations[key].tobytes() == values.tobytes()
        assert episode.actions.tobytes() == arrays.actions.tobytes()
        np.testing.assert_array_equal(episode.rewards, arrays.rewards)
        np.testing.assert_array_equal(episode.terminations, arrays.terminated)
        np.testing.assert_array_equal(episode.truncations, arrays.truncated)
        np.testing.assert_array_equal(episode.infos['is_success'][:, 0], arrays.success)
    environment = dataset.recover_environment()
    observation, _ = environment.reset(seed=0)
    first = load_episodes(episodes)[0].observations
    for key, values in observation.items():
        np.testing.assert_array_equal(values, first[key][0])
    environment.close()


@pytest.mark.parametrize(('timing', 'steps'), [('seconds', 100), ('ticks', 50)])
def test_episodes_of_the_recovered_environment_are_as_long_as_those_logged(
    timing, steps, tmp_path, monkeypatch
):
    minari = pytest.importorskip('minari')
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
    path = Recorder('FetchReach', 50.0, timing=timing).record(EpisodeDirectory(tmp_path / 'logged'))
    assert episodes_export.main([str(path), '--to', 'minari', '--output', str(tmp_path)]) == 0
    dataset = minari.load_dataset('FetchReach/logged-v0')
    assert dataset.total_steps == steps
    description = dataset.storage.metadata['description']
    moves_otherwise = 'in the environment it moves so far per second' in description
    assert moves_otherwise == (timing == 'ticks')
    environment = dataset.recover_environment()
    assert environment.spec.max_episode_steps == steps
    environment.reset(seed=0)
    ends = [environment.step(environment.action_space.sample())[3] for _ in range(steps)]
    assert ends == [False] * (steps - 1) + [True]
    environment.close()


@pytest.mark.parametrize(
    'format_',
    [
        'parquet',
        pytest.param('minari', marks=pytest.mark.release),
        pytest.param('lerobot', marks=pytest.mark.release),
    ],
)
def test_a_full_disk_leaves_no_partial_file(episodes, tmp_path, format_, capsys):
    pytest.importorskip('minari' if format_ == 'minari' else 'pyarrow')
    code = (
        'import resource, sys\n'
        'resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n'
        'from fetch_hand_sim.commands.episodes_export import main\n'
        'sys.exit(main(sys.argv[1:]))'
    )
    arguments = [str(episodes), '--to', format_, '--output', str(tmp_path)]
    run = subprocess.run([sys.executable, '-c', code, *arguments], capture_output=True, text=True)
    (line,) = run.stderr.splitlines()
    assert run.returncode == 1 and 'File too large' in line
    assert list(tmp_path.iterdir()) == []
    assert episodes_export.main(arguments) == 0, capsys.readouterr()
    assert not [path for path in tmp_path.rglob('*') if path.name.startswith('.')]


@pytest.fixture(scope='module')
def two_tasks(episodes, tmp_path_factory):
    """A folder of FetchPush and FetchReach, whose files come after the other's."""
    directory = tmp_path_factory.mktemp('two_tasks')
    shutil.copytree(episodes, directory, dirs_exist_ok=True)
    Recorder('FetchReach').record(EpisodeDirectory(directory))
    return directory


@pytest.mark.parametrize(
    ('format_', 'there'),
    [
        ('parquet', 'FetchReach_episodes.parquet'),
        ('minari', 'FetchReach/logged-v0'),
        ('lerobot', 'FetchReach'),
    ],
)
def test_of_two_tasks_none_is_written_where_one_is_there(two_tasks, tmp_path, format_, there):
    pytest.importorskip('minari' if format_ == 'minari' else 'pyarrow')
    (tmp_path / there).mkdir(parents=True)
    arguments = [str(two_tasks), '--to', format_, '--output', str(tmp_path)]
    assert episodes_export.main(arguments) == 1
    assert [path.name for path in tmp_path.iterdir()] == [there.partition('/')[0]]
    (tmp_path / there).rmdir()
    assert episodes_export.main(arguments) == 0


def test_a_minari_dataset_has_episodes_of_one_environment(tmp_path, monkeypatch, capsys):
    minari = pytest.importorskip('minari')
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
    logged = EpisodeDirectory(tmp_path / 'logged')
    for control_hz in (25.0, 50.0, 25.0):
        Recorder('FetchReach', control_hz).record(logged)
    arguments = [str(tmp_path / 'logged'), '--output', str(tmp_path), '--to']
    assert episodes_export.main([*arguments, 'minari']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'FetchReach_000001_seed0: control_hz 50.0, and 25.0 in ' in line
    dataset = minari.load_dataset('FetchReach/logged-v0')
    assert (dataset.total_episodes, dataset.total_steps) == (2, 100)
    # Tables say the rate of each.
    assert episodes_export.main([*arguments, 'parquet']) == 0


def test_a_dataset_name_that_no_disk_takes_is_one_line(episodes, tmp_path, capsys):
    pytest.importorskip('minari')
    arguments = [str(episodes), '--to', 'minari', '--output', str(tmp_path), '--name', 'x' * 300]
    assert episodes_export.main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'File name too long' in line


def test_minari_datasets_in_folders_of_folders_stand_beside_each_other(
    episodes, tmp_path, monkeypatch
):
    minari = pytest.importorskip('minari')
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path / 'minari'))
    # A relative path, as people write it.
    monkeypatch.chdir(tmp_path)
    names = ('logged-v0', 'me/logged-v0', 'me/logged-v1')
    for name in names:
        arguments = [str(episodes), '--to', 'minari', '--output', 'minari', '--name', name]
        assert episodes_export.main(arguments) == 0
    assert sorted(minari.list_local_datasets()) == [f'{TASK}/{name}' for name in names]
    assert episodes_export.main(arguments) == 1


def test_a_missing_extra_is_one_line(episodes, tmp_path):
    code = (
        'import sys\n'
        'sys.modules["pyarrow"] = None\n'
        'from fetch_hand_sim.commands.episodes_export import main\n'
        'sys.exit(main(sys.argv[1:]))'
    )
    arguments = [episodes, '--to', 'parquet', '--output', tmp_path / 'x']
    run = subprocess.run([sys.executable, '-c', code, *arguments], capture_output=True, text=True)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith('fetch_hand_sim episodes export: pyarrow missing: pip install')


def test_a_name_is_for_minari_alone(tmp_path, capsys):
    with pytest.raises(SystemExit):
        episodes_export.main(
            [str(tmp_path), '--to', 'parquet', '--output', str(tmp_path / 'x'), '--name', 'mine']
        )
    assert '--name is for --to minari, not parquet' in capsys.readouterr().err


def test_of_a_folder_only_what_is_asked_for_is_exported(episodes, tmp_path, monkeypatch, capsys):
    minari = pytest.importorskip('minari')
    folder = tmp_path / 'with a short one'
    shutil.copytree(episodes, folder)
    recorder = Recorder(TASK)
    writer = EpisodeDirectory(folder).begin(TASK, 0, recorder.metadata())
    recorder.write(writer, recorder.ticks()[:5])
    writer.finish({}, 'the robot stopped')
    arguments = [str(folder), '--to', 'minari', '--output', str(tmp_path / 'minari')]
    assert episodes_export.main([*arguments, '--name', 'all']) == 0
    assert f'3 episodes, 1 of them interrupted, of {TASK}' in capsys.readouterr().out
    assert episodes_export.main([*arguments, '--name', 'whole', '--complete']) == 0
    assert f'2 episodes of {TASK}' in capsys.readouterr().out
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path / 'minari'))
    for name, complete in (('all', [True, True, False]), ('whole', [True, True])):
        dataset = minari.load_dataset(f'{TASK}/{name}-v0')
        assert dataset.spec.dataset_id == f'{TASK}/{name}-v0'
        told = dataset.storage.get_episode_metadata(dataset.episode_indices)
        assert [each['complete'] for each in told] == complete
        assert dataset.storage.metadata['dataset_size'] == dataset.storage.get_size()
    assert episodes_export.main([*arguments, '--task', 'FetchReach']) == 2
    assert f'the filters reject all 3 episodes in {folder}' in capsys.readouterr().err
    assert episodes_export.main([str(tmp_path), *arguments[1:]]) == 2
    assert f'{tmp_path} holds no episode; there are some in {folder}' in capsys.readouterr().err


@pytest.mark.parametrize('before', [None, '/data/mine'])
def test_minari_looks_afterwards_where_it_looked_before(before, episodes, tmp_path, monkeypatch):
    pytest.importorskip('minari')
    monkeypatch.delenv('MINARI_DATASETS_PATH', raising=False)
    if before is not None:
        monkeypatch.setenv('MINARI_DATASETS_PATH', before)
    arguments = [str(episodes), '--to', 'minari', '--output', str(tmp_path)]
    assert episodes_export.main(arguments) == 0
    assert os.environ.get('MINARI_DATASETS_PATH') == before
