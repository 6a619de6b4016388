"""Films: real pictures of real episodes, in every kind of file."""

from __future__ import annotations

import base64
import errno
import io
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from PIL import Image

import fetch_hand_sim
from fetch_hand_sim.commands.episodes_film import main as episodes_film
from fetch_hand_sim.episode_log import EpisodeDirectory, EpisodeReadError, load_episodes, reader
from fetch_hand_sim.episode_log.indexes import parse_file
from fetch_hand_sim.films.film import Roll, check_kind, check_size, write_film, write_picture
from fetch_hand_sim.films.playing import Film, film_episode
from fetch_hand_sim.films.recording import Studio, grid, load_recordings, sheets
from fetch_hand_sim.gym_envs.env import FetchHandEnv
from fetch_hand_sim.simulation.opengl import prepare_opengl
from support.episode_recorder import Recorder
from support.full_disk import files_at_most


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp('episodes')
    recorder = Recorder('FetchReach')
    for _ in range(3):
        recorder.record(EpisodeDirectory(directory))
    return directory


@pytest.fixture(scope='module')
def opengl():
    try:
        return prepare_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))


PICTURES = [np.full((5, 7, 3), 40 * number, dtype=np.uint8) for number in range(5)]


@pytest.mark.parametrize('kind', ['.gif', '.webp'])
@pytest.mark.parametrize(
    ('fps', 'shown'),
    [(0.01, 51), (30.0, 51), (50.0, 51), (62.5, 26), (125.0, 17), (500.0, 6), (50_000.0, 1)],
)
def test_animations_last_as_long_as_asked_at_rates_that_browsers_show(kind, fps, shown, tmp_path):
    path = tmp_path / f'film{kind}'
    # Files keep equal neighbours as one.
    pictures = np.kron(np.eye(51, dtype=np.uint8) * 255, np.ones((8, 8), dtype=np.uint8))
    write_film(path, iter(np.repeat(pictures.reshape(51, 8, 408, 1), 3, axis=3)), fps)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    with Image.open(path) as image:
        assert image.n_frames == shown and image.size == (408, 8)
        if shown == 1:
            return
        durations = []
        for number in range(shown):
            image.seek(number)
            image.load()
            durations.append(image.info['duration'])
    assert min(durations) >= 20
    # The last picture may be too short to be shown.
    assert abs(sum(durations) - 51_000.0 / fps) < 20.0
    assert np.ptp(durations[:-1]) <= (10 if kind == '.gif' else 1)


@pytest.mark.parametrize('kind', ['.gif', '.webp'])
def test_a_long_animation_needs_less_memory_than_its_pictures(kind, tmp_path):
    code = (
        'import pathlib, resource, sys\n'
        'import numpy as np\n'
        'from fetch_hand_sim.films.film import write_film\n'
        'def most(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n'
        'def pictures():\n'
        '    for number in range(150):\n'
        '        picture = np.full((480, 640, 3), 90, np.uint8)\n'
        '        picture[200:280, 2 * number : 2 * number + 80] = 200\n'
        '        yield picture\n'
        'before = most()\n'
        'write_film(pathlib.Path(sys.argv[1]), pictures(), 25.0)\n'
        'print(most() - before)'
    )
    path = tmp_path / f'film{kind}'
    result = subprocess.run(
        [sys.executable, '-c', code, str(path)], check=True, capture_output=True, text=True
    )
    with Image.open(path) as image:
        assert image.n_frames == 150
    # Of the pictures themselves, KiB.
    assert int(result.stdout) < 0.6 * 150 * 480 * 640 * 3 / 1024


def test_the_last_picture_of_an_mp4_is_where_its_time_says(tmp_path):
    """To the tenth of a millisecond, at a rate that no few digits say."""
    ffmpeg = pytest.importorskip('imageio_ffmpeg').get_ffmpeg_exe()
    path, rate, count = tmp_path / 'film.mp4', 500 / 11, 6000
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    write_film(path, (picture for _ in range(count)), fps=rate)
    command = [ffmpeg, '-i', path, '-vf', 'showinfo', '-f', 'null', '-']
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    times = [float(each) for each in re.findall(r'pts_time:([\d.]+)', said)]
    assert len(times) == count
    np.testing.assert_allclose(times, np.arange(count) / rate, atol=1e-4)


@pytest.mark.parametrize('side', [10, 224])
def test_the_error_message_of_ffmpeg_is_kept(side, tmp_path, monkeypatch):
    pytest.importorskip('imageio_ffmpeg')
    ffmpeg = tmp_path / 'ffmpeg'
    ffmpeg.write_text('#!/bin/sh\necho "No space left on device" >&2\nexit 1\n')
    ffmpeg.chmod(0o755)
    monkeypatch.setenv('IMAGEIO_FFMPEG_EXE', str(ffmpeg))
    picture = np.zeros((side, side, 3), dtype=np.uint8)
    with pytest.raises(OSError, match='ffmpeg: No space left on device'):
        write_film(tmp_path / 'film.mp4', (picture for _ in range(200)), fps=25.0)
    assert [each.name for each in tmp_path.iterdir()] == ['ffmpeg']


def test_an_mp4_holds_every_picture_also_if_two_processes_write_it(tmp_path):
    pytest.importorskip('imageio_ffmpeg')
    import imageio.v3 as imageio

    path = tmp_path / 'film.mp4'
    code = (
        'import numpy as np, pathlib, sys\n'
        'from fetch_hand_sim.films.film import write_film\n'
        'pictures = iter(np.zeros((9, 48, 64, 3), np.uint8))\n'
        'write_film(pathlib.Path(sys.argv[1]), pictures, 25.0)'
    )

    def pictures():
        for number, picture in enumerate(PICTURES):
            if number == 3:
                subprocess.run([sys.executable, '-c', code, str(path)], check=True)
                assert len(imageio.imread(path)) == 9
            yield np.kron(picture, np.ones((20, 20, 1), dtype=np.uint8))

    write_film(path, pictures(), fps=25.0)
    frames = imageio.imread(path)
    assert frames.shape == (5, 100, 140, 3)
    assert np.abs(frames.mean(axis=(1, 2, 3)) - 40.0 * np.arange(5)).max() < 6.0
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_read_only_disk_is_one_line(tmp_path, monkeypatch):
    """As Linux does it: it looks for a file only where it may write."""

    def refuse(path, *_, **options):
        raise OSError(errno.EROFS, 'Read-only file system', str(path))

    with monkeypatch.context() as patch:
        patch.setattr('pathlib.Path.unlink', refuse)
        patch.setattr('PIL.Image.Image.save', lambda image, path, **options: refuse(path))
        with pytest.raises(OSError, match=r'picture\.png: Read-only file system'):
            write_picture(tmp_path / 'picture.png', PICTURES[0])


@pytest.mark.parametrize('out', ['film.avi', 'film', 'nosuch/film.gif'])
def test_an_unwritable_file_is_reported_before_drawing(out, tmp_path):
    with pytest.raises(ValueError, match=out.rpartition('/')[2] or out):
        check_kind(tmp_path / out)
    for name in (out, 'film.png'):
        with pytest.raises(ValueError, match='film') as error:
            Film(PICTURES).save(tmp_path / name)
        assert '--out' not in str(error.value)
    (tmp_path / 'film.webp').mkdir()
    with pytest.raises(ValueError, match=r'film\.webp is a directory'):
        check_kind(tmp_path / 'film.webp')


@pytest.mark.parametrize(('kind', 'largest'), [('webp', 16383), ('mp4', 16384), ('jpg', 65500)])
def test_a_sheet_that_a_file_cannot_hold_is_one_line_before_drawing(
    folder, tmp_path, kind, largest, monkeypatch, capsys
):
    monkeypatch.setattr(Studio, 'picture', lambda *_: pytest.fail('drawn'))
    out = tmp_path / f'x.{kind}'
    arguments = ['--grid', '20x1', '--size', '4096x48', '--out', str(out)]
    assert episodes_film([str(folder), *arguments]) == 2
    assert capsys.readouterr().err == (
        'fetch_hand_sim episodes film: 81958x48 pixels; '
        f'allowed: {largest} a side of a .{kind} file\n'
    )
    check_size(out, largest, min(largest, 2**28 // largest))
    with pytest.raises(ValueError, match='allowed: 268435456 in all'):
        check_size(out.with_suffix('.png'), 2**14, 2**14 + 1)


def test_an_episode_is_read_once(folder, monkeypatch):
    parsed = []
    monkeypatch.setattr(reader, 'parse_file', lambda data: parsed.append(1) or parse_file(data))
    assert len(load_recordings(folder, 2)) == len(parsed) == 2


@pytest.mark.usefixtures('opengl')
def test_pictures_in_a_grid_mark_success(folder, tmp_path):
    recordings = load_recordings(folder, 3)
    reached = [[frame.is_success for frame in each.frames] for each in recordings]
    index = next(index for index, each in enumerate(zip(*reached, strict=True)) if any(each))
    path = tmp_path / 'grid.png'
    arguments = ['--grid', '3x1', '--out', str(path), '--size', '64x48', '--frame', str(index)]
    assert episodes_film([str(folder), *arguments]) == 0
    with Image.open(path) as image:
        edge = np.asarray(image)[24, ::66].astype(int)
    is_green = edge[:, 1] > edge[:, 0] + 40
    assert is_green.tolist() == [each[index] for each in reached]


@pytest.mark.usefixtures('opengl')
def test_pictures_show_what_was_logged(folder):
    (recording, *others) = load_recordings(folder, 3)
    studio = Studio(64, 48)
    first, last = studio.picture(recording, 0), studio.picture(recording, -1)
    assert first.shape == (48, 64, 3) and first.std() > 10
    assert (first != last).any()
    np.testing.assert_array_equal(studio.picture(recording, 0), first)
    drawn = grid(studio, [recording, *others], columns=2, hz=25.0)
    assert next(drawn).shape == (98, 130, 3)
    studio.close()


def test_in_a_grid_all_episodes_have_the_same_time(folder, monkeypatch):
    """A robot at 250 Hz beside one at 25 Hz: both take two seconds."""
    slow, _ = load_recordings(folder, 2)
    times = np.arange(10 * len(slow.frames) - 9) / 250.0
    fast = replace(slow, times=times, frames=[slow.frames[0]] * len(times))
    drawn = {id(slow): [], id(fast): []}

    def draw(studio, recording, index):
        drawn[id(recording)].append(index)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr(Studio, 'framed', draw)
    count = len(list(grid(Studio(4, 4), [slow, fast], columns=2, hz=250.0)))
    assert count == sheets([slow, fast], 250.0) == len(times)
    assert drawn[id(fast)] == list(range(len(times)))
    assert drawn[id(slow)] == list(range(len(slow.frames)))
    assert len(list(grid(Studio(4, 4), [slow], columns=1, hz=25.0))) == len(slow.frames)


@pytest.mark.usefixtures('opengl')
def test_command_writes_a_film_and_a_picture(folder, tmp_path, capsys):
    for out, more in (('grid.png', ['--grid', '2x2']), ('one.jpg', ['--camera', 'lidar'])):
        path = tmp_path / out
        assert episodes_film([str(folder), '--out', str(path), '--size', '64x48', *more]) == 0
        said = capsys.readouterr().out.splitlines()
        assert said[-1].startswith(str(path))
        alone = ['FetchReach_000000_seed0 alone, of 3 episodes; --grid CxR takes several']
        assert said[:-1] == ([] if more[0] == '--grid' else alone)
        with Image.open(path) as image:
            assert image.size == ((130, 98) if more[0] == '--grid' else (64, 48))


@pytest.mark.usefixtures('opengl')
def test_unreadable_files_are_skipped_and_reported(folder, tmp_path, capsys):
    damaged, path = tmp_path / 'damaged', tmp_path / 'grid.png'
    shutil.copytree(folder, damaged)
    first, *others = sorted(damaged.glob('*/*.mcap'))
    first.write_bytes(first.read_bytes()[:2000])
    arguments = [str(damaged), '--grid', '2x1', '--out', str(path), '--size', '64x48']
    assert episodes_film(arguments) == 0
    error = capsys.readouterr().err
    assert error.startswith('fetch_hand_sim episodes film: skipped ') and error.count('\n') == 1
    assert 'FetchReach_000000_seed0_0.mcap: truncated' in error
    with Image.open(path) as image:
        right = np.asarray(image)[:, 68:]
    assert right.std() > 10, 'the third episode in place of the first'
    for file in others:
        file.write_bytes(b'')
    assert episodes_film(arguments) == 2
    error = capsys.readouterr().err
    assert 'film: none of 3 episodes can be read; the first: ' in error and error.count('\n') == 1


@pytest.mark.usefixtures('opengl')
@pytest.mark.parametrize(
    ('name', 'options', 'said'),
    [
        ('x.png', ['--frame', '51'], 'FetchReach_000000_seed0: frame 51; allowed: -51 ... 50\n'),
        ('x.png', ['--frame', '-52'], 'FetchReach_000000_seed0: frame -52; allowed: -51 ... 50\n'),
        ('x.png', ['--camera', 'nosuch'], 'allowed'),
        ('x.gif', ['--frame', '2'], '--frame is for pictures (.png, .jpg)'),
        ('x.PNG', ['--speed', '2'], '--speed is for films (.mp4, .gif'),
    ],
)
def test_an_impossible_option_is_one_line(folder, tmp_path, name, options, said, capsys):
    assert episodes_film([str(folder), '--out', str(tmp_path / name), *options]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count('\n') == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('size', ['100', '4x4x4', '0x7', '9999x7'])
def test_a_size_is_two_numbers(folder, size, capsys):
    with pytest.raises(SystemExit) as caught:
        episodes_film([str(folder), '--out', 'x.png', '--size', size])
    error = capsys.readouterr().err
    assert caught.value.code == 2 and error.count('\n') == 1
    assert f'{size!r} given; allowed: 1x1 ... 4096x4096' in error


def test_without_opengl_there_is_one_line(folder, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise RuntimeError('rendering needs OpenGL')

    monkeypatch.setattr(Studio, '__init__', refuse)
    assert episodes_film([str(folder), '--out', str(tmp_path / 'x.png')]) == 1
    assert capsys.readouterr().err == 'fetch_hand_sim episodes film: rendering needs OpenGL\n'


def test_a_closed_output_ends_the_command_with_its_code(folder, tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, '-m', 'fetch_hand_sim', 'episodes', 'film', folder]
    command += ['--out', tmp_path / 'x.png']
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, '')


def test_a_film_in_memory_gives_back_every_picture_and_plays_in_a_notebook(tmp_path):
    film = Film(PICTURES, fps=np.float32(25.0))
    assert len(film) == 5
    assert [picture.tolist() for picture in film] == [picture.tolist() for picture in PICTURES]
    assert repr(film) == 'Film(5 pictures of 7x5, 0.2 s)'
    shown = film._repr_html_()
    data = base64.b64decode(shown.split('base64,')[1].split('"')[0])
    with Image.open(io.BytesIO(data)) as image:
        assert (image.format, image.n_frames, image.size) == ('WEBP', 5, (7, 5))
    for name in ('film.gif', 'film.webp'):
        with Image.open(film.save(tmp_path / name)) as image:
            assert image.n_frames == 5
    assert film.save(tmp_path / 'film.mp4').is_file()


def test_a_long_film_takes_a_picture_without_reading_all_earlier_ones(monkeypatch):
    reads = []

    class Watched(io.BytesIO):
        def read(self, *size):
            reads.append(size)
            return super().read(*size)

    monkeypatch.setattr('fetch_hand_sim.films.film.BytesIO', Watched)
    counts = []
    roll = Roll()
    for picture in PICTURES * 20:
        reads.clear()
        roll.add(picture)
        counts.append(len(reads))
    assert counts[-1] == counts[2]
    assert [each.tolist() for each in roll] == [each.tolist() for each in PICTURES * 20]


@pytest.mark.parametrize(
    ('pictures', 'fps', 'said'),
    [
        ([], 25.0, 'no pictures; allowed: one or more'),
        (PICTURES, 0.0, 'fps 0; allowed: 0.01 ... 1000'),
        (PICTURES, '25', "fps '25'; allowed: a number"),
        (PICTURES, float('inf'), 'fps inf'),
        ([*PICTURES, np.zeros((5, 8, 3), np.uint8)], 25.0, 'picture 5 is uint8 (5, 8, 3)'),
        ([np.zeros((5, 7, 3))], 25.0, 'picture 0 is float64 (5, 7, 3); allowed: uint8'),
        ([None], 25.0, 'picture 0 is object ()'),
    ],
)
def test_what_is_no_film_is_refused(pictures, fps, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        Film(pictures, fps)


def test_a_film_that_a_full_disk_does_not_take_is_an_os_error(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(3, 64, 64, 3), dtype=np.uint8)
    with files_at_most(1_000), pytest.raises(OSError, match='film'):
        Film(noise).save(tmp_path / 'film.webp')
    assert not list(tmp_path.iterdir())


@pytest.mark.release
def test_the_film_of_an_episode_is_that_of_the_command(folder, opengl, tmp_path):
    episode = sorted(folder.iterdir())[0]
    film = Film.of_episode(episode, width=64, height=48)
    out = tmp_path / 'film.gif'
    assert episodes_film([str(episode), '--out', str(out), '--size', '64x48']) == 0
    assert film.save(tmp_path / 'same.gif').read_bytes() == out.read_bytes()
    with pytest.raises(ValueError, match='nowhere'):
        Film.of_episode(tmp_path / 'nowhere')


@pytest.mark.release
def test_an_environment_without_a_time_limit_is_filmed_for_an_episode(opengl):
    env = FetchHandEnv('FetchReach', render_mode='rgb_array', width=32, height=32)
    assert len(film_episode(env, lambda observation: np.zeros(4))) == 51
    limited = TimeLimit(env, 60)
    assert len(film_episode(limited, lambda observation: np.zeros(4))) == 61


def test_film_episode_plays_to_the_end_with_a_policy_or_a_function(opengl):
    env = fetch_hand_sim.make('FetchReach', render_mode='rgb_array', width=64, height=48)
    rests = np.zeros(4, dtype=np.float32)

    class Resting:
        def predict(self, observation, deterministic=False):
            assert deterministic and set(observation) == set(env.observation_space.spaces)
            return rests, None

    film = film_episode(env, Resting(), seed=3)
    assert (len(film), film.fps) == (51, 25)
    # Drawing takes long: the others end early.
    short = TimeLimit(env, 5)
    same = film_episode(short, lambda observation: rests, seed=3)
    assert len(same) == 6 and all((a == b).all() for a, b in zip(same, film, strict=False))
    other = film_episode(short, Resting())
    assert not all((a == b).all() for a, b in zip(other, film, strict=False))
    with pytest.raises(ValueError, match=re.escape("render_mode None; allowed: 'rgb_array'")):
        film_episode(fetch_hand_sim.make('FetchReach'), Resting())
    with pytest.raises(ValueError, match="policy 'FetchReach'; allowed: what has predict"):
        film_episode(env, 'FetchReach')
    with pytest.raises(ValueError, match="env 'FetchReach'; allowed: an environment"):
        film_episode('FetchReach', Resting())


@pytest.mark.parametrize('lost', [0, 50, -1])
def test_a_pose_of_the_object_that_is_missing_is_one_line(lost, tmp_path):
    """Poses are not observed, so no other check counts them."""
    recorder = Recorder('HandManipulateEggRotate')
    writer = EpisodeDirectory(tmp_path).begin(recorder.spec.name, 0, recorder.metadata())
    ticks = recorder.ticks()
    messages = ticks[lost].messages
    messages.remove(next(each for each in messages if each[0].name == 'object_pose'))
    recorder.write(writer, ticks)
    path = writer.finish({})
    assert len(load_episodes(path)) == 1
    with pytest.raises(EpisodeReadError, match='object_pose is missing at some ticks'):
        load_recordings(path, 1)
