"""Killed processes, full and read-only disks, damaged files."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.writer import Writer

from fetch_hand_sim.commands import episodes_check, episodes_recover
from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeExistsError,
    EpisodeInUseError,
    EpisodeLogError,
    EpisodeReadError,
    EpisodeWriter,
    files,
    find_episodes,
    find_leftovers,
    load_episodes,
    read_episode,
    read_summary,
    recover_episode,
    recovery,
)
from fetch_hand_sim.episodes.checker import check_episode
from support import SUPPORT, script_environment
from support.full_disk import files_at_most

LOG = 'fetch_hand_sim.episode_log'

RECORDER_SCRIPT = SUPPORT / 'episode_recorder.py'
NOBODY = 65534


def assert_one_line(error):
    assert '\n' not in str(error) and len(str(error)) < 300


@pytest.fixture(scope='module')
def killed(tmp_path_factory):
    """A directory with two finished episodes and one whose recorder was killed after 40 ticks."""
    directory = tmp_path_factory.mktemp('killed')
    command = [sys.executable, RECORDER_SCRIPT, directory, 'FetchReach', '2', '40']
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=script_environment())
    try:
        assert process.stdout.readline().strip() == str(directory)
        running = find_leftovers(directory)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    return directory, running


def test_a_killed_recorder_leaves_an_episode_marked_as_unfinished(killed):
    directory, running = killed
    assert running == [], 'an episode that is being written is no leftover'
    (leftover,) = find_leftovers(directory)
    assert leftover.name == 'FetchReach_000002_seed2'
    assert leftover.path == directory / '.FetchReach_000002_seed2.active'
    assert leftover.size_bytes == sum(f.stat().st_size for f in leftover.path.iterdir()) > 0
    assert 0 <= leftover.age_s < 120
    assert 'FetchReach_000002_seed2' in str(leftover)
    assert not (directory / leftover.name).exists()
    assert all(read_episode(path).is_complete for path in find_episodes(directory))
    assert len(find_episodes(directory)) == 2
    for read in (read_episode, read_summary, load_episodes):
        with pytest.raises(EpisodeReadError, match='truncated by a kill') as caught:
            read(leftover.path)
        assert f'`fetch_hand_sim episodes recover {directory}`' in str(caught.value)
        assert_one_line(caught.value)


def test_a_folder_of_episodes_is_no_episode_and_the_error_names_those_in_it(killed):
    directory, _ = killed
    first, second = find_episodes(directory)
    with pytest.raises(EpisodeReadError, match=f'; there are some in {first}, {second}$'):
        read_episode(directory)


@pytest.fixture
def leftover(killed, tmp_path):
    """The unfinished episode in a copy of that directory."""
    shutil.copytree(killed[0], tmp_path / 'copy')
    (leftover,) = find_leftovers(tmp_path / 'copy')
    return leftover


def test_the_next_run_starts_after_the_killed_one(leftover):
    directory = leftover.path.parent
    writer = EpisodeDirectory(directory).begin('FetchReach', 2, {})
    assert writer.finish({}, 'nothing written') is None
    assert [each.name for each in find_leftovers(directory)] == ['FetchReach_000002_seed2']
    with pytest.raises(EpisodeExistsError, match='was cut off'):
        EpisodeWriter(directory, 'FetchReach_000002_seed2', {})
    with pytest.raises(EpisodeExistsError, match='never overwritten'):
        EpisodeWriter(directory, 'FetchReach_000001_seed1', {})


def test_recovery_makes_a_bag_of_what_reached_the_disk(leftover):
    directory = leftover.path.parent
    path = recover_episode(leftover.path)
    assert path == directory / 'FetchReach_000002_seed2'
    assert find_leftovers(directory) == []
    assert sorted(file.name for file in path.iterdir()) == [f'{path.name}_0.mcap', 'metadata.yaml']
    # Compares all messages, their channels and the result with those of a simulation.
    check = check_episode(path)
    assert check.difference is None and check.ticks >= 27
    recovered, whole = read_episode(path), read_episode(min(find_episodes(directory)))
    assert recovered.result['reason'] == 'cut off, recovered later'
    assert recovered.result.keys() == {'complete', 'reason', 'steps', 'return', 'success'}
    assert recovered.metadata.keys() == whole.metadata.keys()


def test_recovery_of_a_whole_file_keeps_its_result(finished, tmp_path):
    """The process died between the last write and the rename."""
    leftover = tmp_path / f'.{finished.name}.active'
    shutil.copytree(finished, leftover)
    (leftover / 'metadata.yaml').unlink()
    path = recover_episode(leftover)
    recovered, original = read_episode(path), read_episode(finished)
    assert recovered.is_complete
    assert (recovered.result, recovered.topics) == (original.result, original.topics)
    name = 'metadata.yaml'
    assert (path / name).read_bytes() == (finished / name).read_bytes()


def test_recovery_refuses_what_it_cannot_recover(finished, recorder, ticks, tmp_path):
    writer = EpisodeWriter(tmp_path, 'running', {})
    recorder.write(writer, ticks)
    with pytest.raises(EpisodeLogError, match='is being written'):
        recover_episode(tmp_path / '.running.active')
    with pytest.raises(EpisodeReadError, match='still being written'):
        read_episode(tmp_path / '.running.active')
    torn = tmp_path / '.torn.active' / 'torn_0.mcap'
    torn.parent.mkdir()
    whole = next(finished.glob('*.mcap')).read_bytes()
    torn.write_bytes(whole[: len(whole) // 2])
    (tmp_path / 'torn').mkdir()
    with pytest.raises(EpisodeLogError, match='never overwritten'):
        recover_episode(torn.parent)
    with pytest.raises(EpisodeLogError, match='no unfinished episode'):
        recover_episode(finished)
    writer.finish({}, 'test')


@pytest.fixture
def active(tmp_path):
    """The folder of an unfinished episode."""
    path = tmp_path / '.episode.active'
    path.mkdir()
    return path


@pytest.mark.parametrize('size', [None, 0, 5, 70])
def test_a_leftover_of_a_header_is_removed(finished, active, size):
    """An empty directory, an empty file, half a header, a few bytes beyond it."""
    if size is not None:
        whole = (finished / f'{finished.name}_0.mcap').read_bytes()
        (active / 'episode_0.mcap').write_bytes(whole[:size])
    assert recover_episode(active) is None
    assert list(active.parent.iterdir()) == []


def with_wrong_length(data):
    """Changes the length of the second record, after the header."""
    position = 8 + 9 + int.from_bytes(data[9:17], 'little') + 7
    return data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :]


# Name and contents of the only file of a leftover, made of those of a whole episode.
UNREADABLE = {
    'half of the metadata': ('episode_0.mcap', lambda data: data[:400]),
    'half of a chunk': ('episode_0.mcap', lambda data: data[:3000]),
    'length': ('episode_0.mcap', with_wrong_length),
    'magic': ('episode_0.mcap', lambda data: b'?' + data[1:]),
    'rewritten file': ('episode_0.recovered', lambda data: bytes(1000)),
    'description': ('metadata.yaml', lambda data: bytes(1000)),
}


@pytest.mark.parametrize(('name', 'damaged'), UNREADABLE.values(), ids=UNREADABLE)
def test_a_leftover_without_readable_messages_is_put_aside(finished, active, name, damaged):
    data = damaged((finished / f'{finished.name}_0.mcap').read_bytes())
    (active / name).write_bytes(data)
    assert recover_episode(active) is None
    assert [path.name for path in active.parent.iterdir()] == ['.episode.aside']
    assert (active.parent / '.episode.aside' / name).read_bytes() == data
    assert find_leftovers(active.parent) == []


def test_the_error_of_a_folder_with_unfinished_episodes_alone_names_their_remedy(active, capsys):
    folder = active.parent
    assert episodes_check.main([str(folder)]) == 2
    remedy = f'some are unfinished: `fetch_hand_sim episodes recover {folder}`'
    assert f'{folder} holds no episode; {remedy}' in capsys.readouterr().err


def test_an_episode_whose_directory_is_cleared_away_while_it_begins_takes_the_next_number(
    tmp_path, monkeypatch, recorder
):
    """Recovery may meet a directory in the instant before its file is locked."""
    locks = []
    lock = files.lock

    def clear_away_once(stream):
        if not locks:
            assert recover_episode(Path(stream.name).parent) is None
        locks.append(stream.name)
        lock(stream)

    monkeypatch.setattr(files, 'lock', clear_away_once)
    path = recorder.record(EpisodeDirectory(tmp_path))
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert path.name.startswith('FetchReach_000001_')


@pytest.mark.parametrize(
    ('step', 'call'), [('open_regular', 0), ('open_regular', 1), ('try_lock', 1), ('publish', 0)]
)
def test_one_of_two_simultaneous_recoveries_makes_the_bag_and_the_other_reports_it(
    leftover, monkeypatch, step, call, capsys
):
    """The other one comes right after a file was opened or locked, or before the bag is shown."""
    directory, do, calls = leftover.path.parent, getattr(files, step), []

    def meanwhile(*arguments, **options):
        result = None if step == 'publish' else do(*arguments, **options)
        calls.append(step)
        if len(calls) == call + 1:
            assert episodes_recover.main([str(directory)]) == 0
        return do(*arguments, **options) if step == 'publish' else result

    monkeypatch.setattr(files, step, meanwhile)
    assert episodes_recover.main([str(directory)]) == 0
    said = capsys.readouterr().out
    assert said.count(f'\nrecovered {directory}') == 1, said
    path = directory / leftover.name
    assert sorted(file.name for file in path.iterdir()) == [f'{path.name}_0.mcap', 'metadata.yaml']
    assert find_leftovers(directory) == []
    with pytest.raises(EpisodeInUseError, match='another process has recovered it'):
        recover_episode(leftover.path)


def test_a_recovery_that_fails_changes_nothing(killed, leftover):
    with files_at_most(5000), pytest.raises(EpisodeLogError, match='File too large') as caught:
        recover_episode(leftover.path)
    assert_one_line(caught.value)
    (file,) = leftover.path.iterdir()
    assert file.read_bytes() == (killed[0] / leftover.path.name / file.name).read_bytes()


def test_leftovers_of_a_directory_that_does_not_exist(tmp_path):
    assert find_leftovers(tmp_path / 'missing') == []


def test_an_error_of_the_disk_is_raised_once_and_stops_the_log(
    tmp_path, recorder, ticks, monkeypatch
):
    monkeypatch.setattr(f'{LOG}.writer.FLUSH_PERIOD_NS', 1)
    writer = EpisodeWriter(tmp_path, 'episode', {})
    with files_at_most(20_000), pytest.raises(EpisodeLogError, match='too large') as caught:
        recorder.write(writer, ticks)
    assert_one_line(caught.value)
    assert '.episode.active/episode_0.mcap: File too large' in str(caught.value)
    # There is room again, but the episode has a hole: it stays closed.
    assert writer.write_tick(10**12, ticks[-1].messages) is False
    assert writer.finish({'success': 'true'}) is None
    assert writer.finish({}, 'late') is None
    assert [leftover.name for leftover in find_leftovers(tmp_path)] == ['episode']
    assert not (tmp_path / 'episode').exists()


@pytest.mark.parametrize(('size', 'left'), [(100, []), (4000, ['.episode.active'])])
def test_an_error_at_the_begin_or_the_end_never_shows_a_finished_episode(
    tmp_path, recorder, ticks, monkeypatch, size, left
):
    monkeypatch.setattr(f'{LOG}.writer.FLUSH_PERIOD_NS', 10**12)
    with files_at_most(size), pytest.raises(EpisodeLogError, match='File too large') as caught:
        writer = EpisodeWriter(tmp_path, 'episode', {'note': 'x' * 100} if not left else {})
        recorder.write(writer, ticks)
        writer.finish({'success': 'true'})
    assert_one_line(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == left


def test_the_next_episode_is_logged_again(tmp_path, recorder, ticks):
    directory = EpisodeDirectory(tmp_path)
    writer = directory.begin('FetchReach', 0, {})
    with files_at_most(4000), pytest.raises(EpisodeLogError):
        recorder.write(writer, ticks)
    assert recorder.record(directory).name.startswith('FetchReach_000001_')


def test_too_little_free_space_is_noticed_before(tmp_path, monkeypatch):
    monkeypatch.setattr(f'{LOG}.writer.MINIMUM_FREE_BYTES', 2**62)
    with pytest.raises(EpisodeLogError, match='MiB free on the disk') as caught:
        EpisodeWriter(tmp_path, 'episode', {})
    assert_one_line(caught.value)
    assert list(tmp_path.iterdir()) == []


@contextmanager
def unprivileged():
    """Root may write everywhere; take the user `nobody` where that is possible."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize('mode', [0o555, 0o000])
def test_a_directory_without_permission(mode):
    reads = [find_leftovers, read_episode, read_summary, load_episodes] if not mode else []
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, mode)
        for call in (lambda path: EpisodeDirectory(path).begin('FetchReach', 0, {}), *reads):
            with unprivileged(), pytest.raises((EpisodeLogError, EpisodeReadError)) as error:
                call(Path(name))
            assert name in str(error.value) and str(error.value).endswith('Permission denied')
            assert_one_line(error.value)
        assert os.listdir(name) == []


def test_a_directory_that_is_a_file(tmp_path):
    path = tmp_path / 'file'
    path.touch()
    with pytest.raises(EpisodeLogError, match=r'cannot log episode .*file.*: (File exists|Not a)'):
        EpisodeWriter(path, 'episode', {})


def test_truncated_files_and_flipped_bytes_are_refused(finished, tmp_path):
    whole = (finished / f'{finished.name}_0.mcap').read_bytes()
    path = tmp_path / 'damaged.mcap'
    sizes = [*range(0, 200, 7), *range(200, len(whole), 997), len(whole) - 1]
    flipped = (
        whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :]
        for position in range(0, len(whole), 397)
    )
    for data in (*(whole[:size] for size in sizes), *flipped):
        path.write_bytes(data)
        with pytest.raises(EpisodeReadError) as caught:
            read_episode(path)
        assert str(path) in str(caught.value)
        assert_one_line(caught.value)


def test_files_that_are_no_episodes_are_rejected_by_all_readers(tmp_path):
    foreign, text, folder = tmp_path / 'foreign.mcap', tmp_path / 'text.mcap', tmp_path / 'folder'
    with foreign.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        writer.finish()
    text.write_text('no bag at all')
    folder.mkdir()
    os.mkfifo(tmp_path / 'pipe.mcap')
    (tmp_path / 'empty.mcap').touch()
    for path, reason in (
        (foreign, "no metadata record 'episode'"),
        (text, 'no MCAP file'),
        (tmp_path / 'empty.mcap', 'no MCAP file'),
        (tmp_path / 'pipe.mcap', 'no regular file'),
        (tmp_path / 'missing', 'No such file'),
        (folder, 'holds 0 MCAP files'),
    ):
        for read in (read_episode, read_summary, load_episodes)[: 2 if path is folder else 3]:
            with pytest.raises(EpisodeReadError, match=reason) as caught:
                read(path)
            assert str(path) in str(caught.value)
            assert_one_line(caught.value)
    assert find_episodes(tmp_path) == sorted(tmp_path.glob('*.mcap'))


def test_clearing_the_folder_keeps_the_file_of_a_starting_episode(tmp_path, monkeypatch):
    leftover = files.active_path(tmp_path, 'FetchReach_000000_seed0')
    leftover.mkdir()
    file = files.bag_file(leftover, 'FetchReach_000000_seed0')
    remove = recovery._remove

    def begins(path, entries):
        file.write_bytes(b'begun')
        remove(path, entries)

    # A moment after recovery has found no file.
    monkeypatch.setattr(recovery, '_remove', begins)
    with pytest.raises(EpisodeInUseError):
        recover_episode(leftover)
    assert file.read_bytes() == b'begun'
    file.unlink()
    monkeypatch.setattr(recovery, '_remove', remove)
    assert recover_episode(leftover) is None
    assert not leftover.exists()
