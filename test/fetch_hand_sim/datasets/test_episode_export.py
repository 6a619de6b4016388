"""Datasets made of logged episodes, read back by the libraries they are for."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes, reader
from fetch_hand_sim.episode_log.indexes import parse_file
from policy_node.training import generate_episodes
from support.episode_recorder import Recorder
from support.full_disk import files_at_most

TASK = 'FetchPush'


def test_parquet_holds_every_value(episodes, export, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    assert export(episodes, 'parquet', tmp_path) == 0
    assert '3 episodes of FetchPush' in capsys.readouterr().out
    columns = parquet.read_table(tmp_path / f'{TASK}.parquet').to_pydict()
    about = parquet.read_table(tmp_path / f'{TASK}_episodes.parquet').to_pylist()
    for index, arrays in enumerate(load_episodes(episodes)):
        rows = slice(51 * index, 51 * (index + 1))
        expected = {'episode_index': [index] * 51, 'step': list(range(51))}
        expected |= {name: values.tolist() for name, values in arrays.observations.items()}
        steps = {'action': arrays.actions, 'command': arrays.commands, 'reward': arrays.rewards}
        steps |= {'terminated': arrays.terminated, 'truncated': arrays.truncated}
        steps |= {'next_success': arrays.success[1:]}
        expected |= {name: [*values.tolist(), None] for name, values in steps.items()}
        assert {name: columns[name][rows] for name in expected} == expected
        assert columns['timestamp'][rows][1] == 0.04
        assert (about[index]['seed'], about[index]['steps']) == (index, 50)
        assert json.loads(about[index]['metadata']) == arrays.metadata
        result = json.loads(about[index]['result'])
        assert about[index]['return'] == float(result['return']), 'the last bit too'
    assert len(columns['step']) == 3 * 51
    assert export(episodes, 'parquet', tmp_path) == 1
    assert 'nothing is overwritten' in capsys.readouterr().err


def test_an_export_parses_each_file_once(episodes, export, tmp_path, monkeypatch):
    parsed = []
    monkeypatch.setattr(reader, 'parse_file', lambda data: parsed.append(1) or parse_file(data))
    assert export(episodes, 'parquet', tmp_path) == 0
    assert len(parsed) == 3


def test_minari_holds_every_value_and_recovers_the_environment(episodes, export, minari, tmp_path):
    assert export(episodes, 'minari', tmp_path / 'minari') == 0
    dataset = minari.load_dataset(f'{TASK}/logged-v0')
    assert (dataset.total_episodes, dataset.total_steps) == (3, 150)
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
def test_the_recovered_environment_has_episodes_as_long_as_those_logged(
    timing, steps, export, minari, tmp_path
):
    path = Recorder('FetchReach', 50.0, timing=timing).record(EpisodeDirectory(tmp_path / 'logged'))
    assert export(path, 'minari', tmp_path / 'minari') == 0
    dataset = minari.load_dataset('FetchReach/logged-v0')
    assert dataset.total_steps == steps
    warning = 'in the environment it moves so far per second'
    assert (warning in dataset.storage.metadata['description']) == (timing == 'ticks')
    environment = dataset.recover_environment()
    assert environment.spec.max_episode_steps == steps
    environment.close()


def test_the_recovered_environment_is_disturbed_as_the_robot_was(export, minari, tmp_path):
    arguments = ['--policy', 'random', '--task', 'FetchReach', '--episodes', '1', '--threads', '1']
    disturbed = ['--disturbances', 'mild', '--output', str(tmp_path / 'logged')]
    assert generate_episodes.main([*arguments, *disturbed]) == 0
    assert export(tmp_path / 'logged', 'minari', tmp_path / 'minari') == 0
    environment = minari.load_dataset('FetchReach/logged-v0').recover_environment()
    observation, _ = environment.reset(seed=0)
    (logged,) = load_episodes(tmp_path / 'logged')
    np.testing.assert_array_equal(observation['observation'], logged.observations['observation'][0])
    environment.close()


@pytest.mark.parametrize(
    'format_',
    [
        'parquet',
        pytest.param('minari', marks=pytest.mark.release),
        pytest.param('lerobot', marks=pytest.mark.release),
    ],
)
def test_a_full_disk_leaves_no_partial_file(episodes, export, tmp_path, format_, capsys):
    with files_at_most(4096):
        assert export(episodes, format_, tmp_path) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'File too large' in line
    assert list(tmp_path.iterdir()) == []
    (tmp_path / '.partial.of_a_killed_export').mkdir()
    assert export(episodes, format_, tmp_path) == 0, capsys.readouterr()
    assert not [path for path in tmp_path.rglob('*') if path.name.startswith('.')]


@pytest.mark.parametrize(
    ('format_', 'there'),
    [
        ('parquet', 'FetchReach_episodes.parquet'),
        ('minari', 'FetchReach/logged-v0'),
        ('lerobot', 'FetchReach'),
    ],
)
def test_of_two_tasks_none_is_written_where_one_is_there(
    episodes, finished, export, tmp_path, format_, there
):
    """The files of FetchReach come after those of FetchPush."""
    shutil.copytree(episodes, tmp_path / 'logged')
    shutil.copytree(finished, tmp_path / 'logged' / finished.name)
    output = tmp_path / 'output'
    (output / there).mkdir(parents=True)
    assert export(tmp_path / 'logged', format_, output) == 1
    assert [path.name for path in output.iterdir()] == [there.partition('/')[0]]
    (output / there).rmdir()
    assert export(tmp_path / 'logged', format_, output) == 0


def test_a_minari_dataset_has_episodes_with_steps_of_one_environment(
    export, minari, tmp_path, capsys
):
    logged = EpisodeDirectory(tmp_path / 'logged')
    for control_hz in (25.0, 50.0, 25.0):
        Recorder('FetchReach', control_hz).record(logged)
    # A robot in lockstep without commands.
    recorder = Recorder('FetchReach', first_seed=5)
    writer = logged.begin('FetchReach', 5, recorder.metadata())
    writer.write_tick(1_000_000_000, recorder.ticks()[0].messages)
    writer.finish({'success': 'false', 'return': '0.0'})
    assert export(logged.path, 'minari', tmp_path / 'minari') == 1
    rate, steps = capsys.readouterr().err.splitlines()
    assert 'FetchReach_000001_seed0: control_hz 50.0, and 25.0 in ' in rate
    assert 'FetchReach_000003_seed5: no steps; Minari needs at least one' in steps
    dataset = minari.load_dataset('FetchReach/logged-v0')
    assert (dataset.total_episodes, dataset.total_steps) == (2, 100)
    # Tables say the rate of each.
    assert export(logged.path, 'parquet', tmp_path) == 0


def test_minari_datasets_in_folders_of_folders_stand_beside_each_other(
    episodes, export, tmp_path, monkeypatch
):
    minari = pytest.importorskip('minari')
    monkeypatch.delenv('MINARI_DATASETS_PATH', raising=False)
    # A relative path, as people write it.
    monkeypatch.chdir(tmp_path)
    names = ('logged-v0', 'me/logged-v0', 'me/logged-v1')
    for name in names:
        assert export(episodes, 'minari', 'minari', '--name', name) == 0
    assert export(episodes, 'minari', 'minari', '--name', name) == 1
    assert 'MINARI_DATASETS_PATH' not in os.environ
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path / 'minari'))
    assert sorted(minari.list_local_datasets()) == [f'{TASK}/{name}' for name in names]


def test_of_a_folder_only_what_is_asked_for_is_exported(episodes, export, minari, tmp_path, capsys):
    folder = tmp_path / 'with a short one'
    shutil.copytree(episodes, folder)
    recorder = Recorder(TASK)
    writer = EpisodeDirectory(folder).begin(TASK, 0, recorder.metadata())
    recorder.write(writer, recorder.ticks()[:5])
    writer.finish({}, 'the robot stopped')
    output = tmp_path / 'minari'
    assert export(folder, 'minari', output, '--name', 'all') == 0
    assert f'4 episodes, 1 of them interrupted, of {TASK}' in capsys.readouterr().out
    assert export(folder, 'minari', output, '--name', 'whole', '--complete') == 0
    assert f'3 episodes of {TASK}' in capsys.readouterr().out
    for name, complete in (('all', [True, True, True, False]), ('whole', [True, True, True])):
        dataset = minari.load_dataset(f'{TASK}/{name}-v0')
        assert dataset.spec.dataset_id == f'{TASK}/{name}-v0'
        about = dataset.storage.get_episode_metadata(dataset.episode_indices)
        assert [each['complete'] for each in about] == complete
        assert dataset.storage.metadata['dataset_size'] == dataset.storage.get_size()
    assert export(folder, 'minari', output, '--task', 'FetchReach') == 2
    assert f'the filters reject all 4 episodes in {folder}' in capsys.readouterr().err
    assert export(tmp_path, 'minari', output) == 2
    assert f'{tmp_path} holds no episode; there are some in {folder}' in capsys.readouterr().err
