"""LeRobot datasets made of logged episodes: every value, and the layout that lerobot reads."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.commands import episodes_export
from fetch_hand_sim.datasets.writing import why_apart
from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.films import film
from fetch_hand_sim.films.recording import Studio, load_recordings
from fetch_hand_sim.simulation.opengl import prepare_opengl
from support.episode_recorder import Recorder

parquet = pytest.importorskip('pyarrow.parquet')
lerobot = pytest.importorskip('fetch_hand_sim.datasets.lerobot')

TASK = 'FetchPush'
DATA, EPISODES = 'data/chunk-000/file-{:03d}.parquet', 'meta/episodes/chunk-000/file-000.parquet'


@pytest.fixture(scope='module')
def dataset(episodes, export, tmp_path_factory):
    output = tmp_path_factory.mktemp('datasets')
    assert export(episodes, 'lerobot', output) == 0
    return output / TASK


def test_frames_hold_what_the_episodes_hold(episodes, dataset):
    columns = parquet.read_table(dataset / DATA.format(0)).to_pydict()
    first = 0
    for number, episode in enumerate(load_episodes(episodes)):
        rows = slice(first, first + len(episode))
        seen = episode.observations['observation'][:-1].astype(np.float32)
        # Position of the gripper, fingers, both velocities; between them what is seen of the block.
        robot = [0, 1, 2, 9, 10, *range(20, 25)]
        block = [index for index in range(25) if index not in robot]
        goal = episode.observations['desired_goal'][:-1].astype(np.float32)
        expected = {
            'observation.state': seen[:, robot],
            'observation.environment_state': np.concatenate([seen[:, block], goal], axis=1),
            'action': episode.actions.astype(np.float32),
            'next.reward': episode.rewards,
            'next.success': episode.success[1:],
            'next.done': [False] * 49 + [True],
            'timestamp': (np.arange(50) / 25).astype(np.float32),
            'frame_index': np.arange(50),
            'episode_index': [number] * 50,
            'index': np.arange(first, first + 50),
            'task_index': [0] * 50,
        }
        assert columns.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(columns[name][rows], values, err_msg=name)
        first += len(episode)
    assert len(columns['index']) == first == 150


def test_metadata_describe_the_files(dataset):
    info = json.loads((dataset / 'meta/info.json').read_text())
    table = parquet.read_table(dataset / DATA.format(0))
    assert list(info['features']) == table.column_names
    for name, feature in info['features'].items():
        kind, (size,) = table.schema.field(name).type, feature['shape']
        value = str(kind.value_type if size > 1 else kind)
        assert {'float': 'float32'}.get(value, value) == feature['dtype']
        assert size == 1 or kind.list_size == size == len(feature['names'])
    assert (info['total_episodes'], info['total_frames'], info['fps']) == (3, 150, 25)
    rows = parquet.read_table(dataset / EPISODES).to_pylist()
    bounds = [(row['dataset_from_index'], row['dataset_to_index']) for row in rows]
    assert bounds == [(0, 50), (50, 100), (100, 150)]
    assert [row['tasks'] for row in rows] == [[TASK]] * 3
    tasks = parquet.read_table(dataset / 'meta/tasks.parquet')
    (index,) = json.loads(tasks.schema.metadata[b'pandas'])['index_columns']
    assert tasks.to_pydict() == {'task_index': [0], index: [TASK]}


def test_statistics_are_those_of_all_frames(dataset):
    statistics = json.loads((dataset / 'meta/stats.json').read_text())
    columns = parquet.read_table(dataset / DATA.format(0)).to_pydict()
    for name, values in columns.items():
        rows = np.asarray(values, dtype=np.float64).reshape(150, -1)
        found = statistics[name]
        np.testing.assert_array_equal(found['min'], rows.min(axis=0))
        np.testing.assert_array_equal(found['max'], rows.max(axis=0))
        np.testing.assert_allclose(found['mean'], rows.mean(axis=0), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found['std'], rows.std(axis=0), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found['q50'], np.median(rows, axis=0), rtol=1e-6, atol=1e-9)
        assert found['count'] == [150]


def test_long_datasets_are_several_files(episodes, export, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot, '_FILE_MEGABYTES', 0.01)
    assert export(episodes, 'lerobot', tmp_path) == 0
    rows = parquet.read_table(tmp_path / TASK / EPISODES).to_pylist()
    assert [row['data/file_index'] for row in rows] == [0, 1, 2]
    indices = [
        parquet.read_table(tmp_path / TASK / DATA.format(file))['index'].to_pylist()
        for file in range(3)
    ]
    assert indices == [list(range(50 * n, 50 * n + 50)) for n in range(3)]


FILM = 'videos/observation.images.scene/chunk-000/file-000.mp4'


@pytest.mark.release
def test_films_show_every_frame_and_say_where_each_episode_begins(episodes, export, tmp_path):
    imageio_ffmpeg = pytest.importorskip('imageio_ffmpeg')
    try:
        prepare_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))
    assert export(episodes, 'lerobot', tmp_path, '--pictures', '64x48') == 0
    reader = imageio_ffmpeg.read_frames(str(tmp_path / TASK / FILM))
    about = next(reader)
    pictures = [np.frombuffer(picture, np.uint8).reshape(48, 64, 3) for picture in reader]
    assert (about['size'], about['fps'], len(pictures)) == ((64, 48), 25.0, 150)
    studio = Studio(64, 48)
    for number, recording in enumerate(load_recordings(episodes, 3)):
        for index in (0, 49):
            drawn = studio.plain(recording, index).astype(int)
            assert np.abs(drawn - pictures[50 * number + index]).mean() < 8.0
    studio.close()
    info = json.loads((tmp_path / TASK / 'meta/info.json').read_text())
    assert info['features']['observation.images.scene']['shape'] == [48, 64, 3]
    rows = parquet.read_table(tmp_path / TASK / EPISODES).to_pylist()
    key = 'videos/observation.images.scene'
    bounds = [(row[f'{key}/from_timestamp'], row[f'{key}/to_timestamp']) for row in rows]
    assert bounds == [(0.0, 2.0), (2.0, 4.0), (4.0, 6.0)]


def test_colors_are_summed_up_as_numbers_are():
    picture = np.random.default_rng(0).integers(0, 256, size=(6, 8, 3), dtype=np.uint8)
    histogram = np.array([np.bincount(picture[..., c].ravel(), minlength=256) for c in range(3)])
    found = lerobot.color_statistics(histogram, pixels=48)
    rows = picture.reshape(-1, 3) / 255.0
    expected = {'min': rows.min(axis=0), 'max': rows.max(axis=0), 'mean': rows.mean(axis=0)}
    expected |= {'std': rows.std(axis=0)}
    expected |= {'q50': np.quantile(rows, 0.5, axis=0, method='inverted_cdf')}
    for name, values in expected.items():
        np.testing.assert_allclose(np.ravel(found[name]), values, atol=1e-9)
    assert found['count'] == [1]


@pytest.mark.parametrize(
    ('to', 'options', 'line'),
    [
        ('lerobot', '--pictures 95x96', 'must be even'),
        ('minari', '--pictures 96x96', '--pictures is for --to lerobot, not minari'),
        ('lerobot', '--camera gripper_camera_rgb', 'needs --pictures'),
        ('lerobot', '--pictures 96x96 --camera nosuch', 'nosuch'),
        ('parquet', '--name mine', '--name is for --to minari, not parquet'),
    ],
)
def test_options_that_do_not_fit_are_refused(
    episodes, export, tmp_path, to, options, line, monkeypatch, capsys
):
    monkeypatch.setattr(film, 'find_ffmpeg', lambda: 'not reached')
    assert export(episodes, to, tmp_path / 'out', *options.split()) == 2
    assert line in capsys.readouterr().err
    assert not list(tmp_path.rglob('*.*'))


def test_a_missing_ffmpeg_is_reported_before_an_episode_is_read(
    episodes, export, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, 'imageio_ffmpeg', None)
    monkeypatch.setenv('PATH', '')
    monkeypatch.setattr(episodes_export, 'read_episode', lambda path: pytest.fail('read'))
    assert export(episodes, 'lerobot', tmp_path / 'out', '--pictures', '96x96') == 2
    line = "export: .mp4 needs ffmpeg: pip install 'fetch_hand_sim[film]'"
    assert line in capsys.readouterr().err


def test_the_environment_of_a_task_without_object_is_its_goal(export, tmp_path):
    Recorder('FetchReach', 12.5).record(EpisodeDirectory(tmp_path / 'logged'))
    assert export(tmp_path / 'logged', 'lerobot', tmp_path) == 0
    info = json.loads((tmp_path / 'FetchReach/meta/info.json').read_text())
    assert info['fps'] == 12.5
    assert info['features']['observation.state']['shape'] == [10]
    assert info['features']['observation.environment_state']['shape'] == [3]


def test_a_dataset_has_one_rule_of_rewards_and_one_timing(finished, tmp_path):
    def apart(episode, **changes):
        other = replace(episode, record=replace(episode.record, **changes))
        return why_apart(other, episode)

    usual = load_episode(finished)
    fast = load_episode(Recorder('FetchReach', 50.0).record(EpisodeDirectory(tmp_path)))
    assert apart(usual) == apart(usual, timing='ticks') == ''
    assert apart(usual, reward_type='dense').startswith('reward_type dense, and sparse in')
    assert apart(usual, success_rule='paper').startswith('success_rule paper, and gymnasium in')
    assert apart(fast, timing='ticks').startswith('timing ticks, and seconds in')


def test_lerobot_reads_it(dataset, monkeypatch):
    monkeypatch.setenv('HF_HUB_OFFLINE', '1')
    package = pytest.importorskip('lerobot.datasets.lerobot_dataset')
    window = {'action': [step / 25 for step in range(8)]}
    read = package.LeRobotDataset(f'me/{TASK}', root=dataset, delta_timestamps=window)
    assert (read.num_episodes, len(read), read.fps) == (3, 150, 25)
    assert read[148]['action'].shape == (8, 4)
    assert read[148]['action_is_pad'].tolist() == [False] * 2 + [True] * 6
    assert read[148]['task'] == TASK
