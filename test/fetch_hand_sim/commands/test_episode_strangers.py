"""Folders with hostile entries: one line each, no link followed, no pipe waited for."""

from __future__ import annotations

import errno
import os
import shutil
import struct
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import Writer

from fetch_hand_sim.commands import (
    episodes_check,
    episodes_export,
    episodes_list,
    episodes_recover,
)
from fetch_hand_sim.episode_log import (
    EpisodeLogError,
    EpisodeReadError,
    find_leftovers,
    load_episodes,
    read_episode,
    read_summary,
    recover_episode,
)
from fetch_hand_sim.replay_node.schedule import ReplaySchedule
from msgs_spec.schemas import schema_text
from support import script_environment

NAME = 'FetchReach_000000_seed0'


@pytest.fixture
def directory(finished, tmp_path):
    """One finished episode and one that was cut off."""
    path = tmp_path / 'episodes'
    shutil.copytree(finished, path / NAME)
    leave(path, 'cut', (finished / f'{NAME}_0.mcap').read_bytes()[:-2000])
    return path


def leave(directory, name, data):
    """Makes what a killed robot leaves."""
    leftover = directory / f'.{name}.active'
    leftover.mkdir(parents=True)
    (leftover / f'{name}_0.mcap').write_bytes(data)
    return leftover


def assert_one_line_each(text, count):
    lines = text.splitlines()
    assert len(lines) == count, text
    assert all(line.isprintable() and len(line) < 500 for line in lines)


# Bad entries hide no good episode


def bad_leftover(directory, kind):
    """Makes an entry `.bad.active` that no robot leaves."""
    bad = directory / '.bad.active'
    match kind:
        case 'fifo inside':
            bad.mkdir()
            os.mkfifo(bad / 'bad_0.mcap')
        case 'unknown fifo inside':
            os.mkfifo(leave(directory, 'bad', b'') / 'pipe')
        case 'fifo':
            os.mkfifo(bad)
        case 'file':
            bad.write_text('no directory')
        case 'folder inside':
            (bad / 'bad_0.mcap').mkdir(parents=True)
        case 'link to itself':
            bad.symlink_to(bad)
        case 'link elsewhere':
            bad.symlink_to(directory / NAME)


BAD_LEFTOVERS = (
    *('fifo inside', 'unknown fifo inside', 'fifo', 'file', 'folder inside'),
    *('link to itself', 'link elsewhere'),
)


@pytest.mark.timeout(20)
@pytest.mark.parametrize('kind', BAD_LEFTOVERS)
def test_a_bad_entry_hides_no_good_one(directory, kind, capsys):
    bad_leftover(directory, kind)
    bad, good = find_leftovers(directory)
    assert bad.problem and not good.problem
    assert episodes_list.main([str(directory)]) == 0
    assert '1 episodes' in capsys.readouterr().out
    assert episodes_recover.main([str(directory)]) == 1
    output = capsys.readouterr()
    assert 'recovered' in output.out
    assert_one_line_each(output.err, 1)
    assert 'is no' in output.err or 'is not' in output.err
    assert read_episode(directory / 'cut').metadata['task'] == 'FetchReach'
    assert os.path.lexists(directory / '.bad.active')


# Links are not followed


@pytest.mark.parametrize('link', ['cut_0.recovered', 'metadata.yaml', 'cut_0.mcap'])
def test_links_in_a_leftover_are_not_followed(directory, tmp_path, link):
    target = tmp_path / 'precious'
    target.write_text('precious')
    entry = directory / '.cut.active' / link
    entry.unlink(missing_ok=True)
    entry.symlink_to(target)
    with pytest.raises(EpisodeLogError, match='is no regular file'):
        recover_episode(directory / '.cut.active')
    assert target.read_text() == 'precious'
    assert not (directory / 'cut').exists()


# A leftover that is damaged or not of a robot


def cut_with(metadata, type_name='std_msgs/msg/Float64', **options):
    """A file with one message of `reward`, as a killed robot leaves it."""
    stream = BytesIO()
    writer = Writer(stream, **options)
    writer.start(profile='ros2')
    writer.add_metadata('episode', {'task': 'FetchReach'})
    schema = writer.register_schema(type_name, 'ros2msg', schema_text(type_name).encode())
    channel = writer.register_channel('/reward', 'cdr', schema, metadata)
    writer.add_message(channel, 1, bytes(12), 1)
    writer.flush()
    return stream.getvalue()


def flipped(data, position, bit=6):
    return data[:position] + bytes([data[position] ^ 1 << bit]) + data[position + 1 :]


def chunks(data):
    """Where the chunks begin."""
    position, found = 8, []
    while position < len(data) - 9:
        if data[position] == Opcode.CHUNK:
            found.append(position)
        position += 9 + int.from_bytes(data[position + 1 : position + 9], 'little')
    return found


def bomb():
    """Chunks of 15 MiB of zeros that have 1 KB each."""
    zeros = bytes([Opcode.HEADER]) + struct.pack('<Q', 60 * 2**20 - 9) + bytes(60 * 2**20 - 9)
    packed = zstandard.compress(zeros)
    sizes = struct.pack('<QQQI', 0, 0, len(zeros), 0)
    content = sizes + struct.pack('<I', 4) + b'zstd' + struct.pack('<Q', len(packed)) + packed
    chunk = bytes([Opcode.CHUNK]) + struct.pack('<Q', len(content)) + content
    return cut_with({}) + 200 * chunk


@pytest.mark.timeout(60)
def test_one_bad_leftover_stops_no_other_and_loses_no_byte(directory, finished, capsys):
    whole = (finished / f'{NAME}_0.mcap').read_bytes()[:-2000]
    start = chunks(whole)[0]
    bad = {
        'another type': ('active', cut_with({}, 'std_msgs/msg/Empty')),
        'flipped length of the first chunk': ('aside', flipped(whole, start + 4)),
        'flipped length of the header': ('aside', flipped(whole, 8 + 4)),
    }
    for name, (_, data) in bad.items():
        leave(directory, name, data)
    began = time.process_time()
    assert episodes_recover.main([str(directory)]) == 1
    assert time.process_time() - began < 5.0
    output = capsys.readouterr()
    assert 'recovered' in output.out and read_episode(directory / 'cut')
    assert_one_line_each(output.err, 1)
    for name, (end, data) in bad.items():
        assert (directory / f'.{name}.{end}' / f'{name}_0.mcap').read_bytes() == data


def test_recovery_keeps_unreadable_files_aside(directory, finished):
    """One flipped bit in the length of a later chunk."""
    whole = (finished / f'{NAME}_0.mcap').read_bytes()[:-2000]
    damaged = flipped(whole, chunks(whole)[2] + 4)
    leave(directory, 'damaged', damaged)
    path = recover_episode(directory / '.damaged.active')
    assert 2 < len(read_episode(path).topics['/clock'].messages) < 30
    assert (directory / '.damaged.aside' / 'damaged_0.mcap').read_bytes() == damaged
    assert find_leftovers(directory)[0].name == 'cut'


def test_chunks_that_unpack_to_gigabytes_cost_little(tmp_path):
    leave(tmp_path, 'bomb', bomb())
    script = (
        'import sys, time\n'
        'from pathlib import Path\n'
        'from fetch_hand_sim.commands import episodes_recover\n'
        'code = episodes_recover.main([sys.argv[1]])\n'
        # ru_maxrss would include the memory of the process that starts this one.
        'status = Path("/proc/self/status").read_text().splitlines()\n'
        '(peak,) = (line.split()[1] for line in status if line.startswith("VmHWM:"))\n'
        'print(peak, time.process_time())\n'
    )
    command = [sys.executable, '-c', script, tmp_path]
    run = subprocess.run(command, capture_output=True, text=True, env=script_environment())
    kilobytes, seconds = run.stdout.splitlines()[-1].split()
    assert int(kilobytes) < 500_000 and float(seconds) < 4.0, run.stdout + run.stderr


def test_an_episode_without_messages_cannot_be_replayed(tmp_path):
    path = tmp_path / 'empty.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        writer.add_metadata('episode', {'task': 'FetchReach', 'control_hz': '25.0'})
        writer.add_metadata('episode_result', {'complete': 'true'})
        writer.finish()
    with pytest.raises(EpisodeReadError, match='an episode without messages'):
        ReplaySchedule(path)
    assert episodes_check.main([str(path)]) == 2


# Paths


def test_names_that_are_no_text_and_command_a_terminal(finished, tmp_path):
    """Through real processes, since it is their output that must take them."""
    name = b'\xff\xfe \x1b]0;owned\x07 line\nbreak'
    directory = Path(os.fsdecode(os.fsencode(tmp_path) + b'/' + name))
    shutil.copytree(finished, directory / NAME)
    leave(directory, 'cut', (finished / f'{NAME}_0.mcap').read_bytes()[:-2000])
    (directory / 'text.mcap').write_text('no bag')
    parquet = ['--to', 'parquet', '--output', str(directory / 'out')]
    for command, arguments, code in (
        ('list', [], 1),
        ('recover', [], 0),
        ('export', parquet, 1),
    ):
        run = subprocess.run(
            [sys.executable, '-m', 'fetch_hand_sim', 'episodes', command, directory, *arguments],
            capture_output=True,
            env=script_environment() | {'PYTHONIOENCODING': 'utf-8'},
        )
        output = (run.stdout + run.stderr).decode()
        assert run.returncode == code, (command, output)
        assert 'Traceback' not in output
        assert all(line.isprintable() for line in output.splitlines())


def test_companion_files_of_macos_are_ignored(finished, tmp_path, capsys):
    """`tar` there adds a companion to each file, and to each folder."""
    shutil.copytree(finished, tmp_path / NAME)
    shutil.copytree(finished, tmp_path / 'alone')
    (tmp_path / 'alone' / 'metadata.yaml').unlink()
    (tmp_path / 'alone' / f'{NAME}_0.mcap').rename(tmp_path / 'alone.mcap')
    for file in (f'{NAME}/._{NAME}_0.mcap', f'{NAME}/._metadata.yaml', f'._{NAME}', '._alone.mcap'):
        (tmp_path / file).write_bytes(b'\0\5\x16\7')
    (tmp_path / 'alone' / '._x.mcap').write_bytes(b'\0\5\x16\7')
    assert episodes_list.main([str(tmp_path)]) == episodes_check.main([str(tmp_path)]) == 0
    assert '2 episodes' in capsys.readouterr().out
    assert len(load_episodes(tmp_path)) == 2


def test_a_folder_without_permission_is_one_line(finished, monkeypatch):
    """Such as those that root has logged in a container."""

    def refuse(path):
        raise PermissionError(errno.EACCES, 'Permission denied', path)

    monkeypatch.setattr(os, 'scandir', refuse)
    monkeypatch.setattr(os, 'listdir', refuse)
    for read in (read_episode, read_summary, load_episodes):
        with pytest.raises(EpisodeReadError, match=f'{NAME}: Permission denied'):
            read(finished)


def test_too_long_a_name_is_one_line(capsys):
    for tool in (episodes_list, episodes_check, episodes_recover):
        assert tool.main(['x' * 5000]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


# Exports


@pytest.mark.parametrize('name', ['../../../x', '/x', 'a/../b', '', 'a//b', '.x', 'a b', 'x\n'])
def test_a_name_that_leads_elsewhere_creates_nothing(finished, tmp_path, name, capsys):
    output = tmp_path / 'a' / 'b' / 'datasets'
    arguments = [str(finished), '--to', 'minari', '--output', str(output), '--name', name]
    assert episodes_export.main(arguments) in (1, 2)
    assert_one_line_each(capsys.readouterr().err, 1)
    assert list(tmp_path.iterdir()) == []


def test_an_export_has_the_episodes_that_a_list_has(finished, tmp_path, capsys):
    """Entries that cannot be read are named; nothing comes twice."""
    directory = tmp_path / 'episodes'
    shutil.copytree(finished, directory / NAME)
    (directory / 'dangling.mcap').symlink_to(tmp_path / 'nothing')
    (directory / 'loop').symlink_to(directory / 'loop')
    shutil.copytree(finished, directory / 'cut')
    os.truncate(directory / 'cut' / f'{NAME}_0.mcap', 5000)
    (directory / 'hollow').mkdir()
    (directory / 'hollow' / 'metadata.yaml').touch()
    (directory / 'notes.txt').write_text('not an episode and no claim to be one')
    (directory / 'several').mkdir()
    for name in ('a.mcap', 'b.mcap'):
        shutil.copy(finished / f'{NAME}_0.mcap', directory / 'several' / name)
    assert episodes_list.main([str(directory)]) == 1
    listed = capsys.readouterr()
    output = ['--to', 'parquet', '--output', str(tmp_path / 'data')]
    assert episodes_export.main([str(directory), *output]) == 1
    exported = capsys.readouterr()
    assert '1 episodes' in listed.out and '1 episodes of FetchReach' in exported.out
    for text in (listed.err, exported.err):
        for part in ('dangling.mcap', f'cut/{NAME}_0.mcap', 'hollow', 'several holds 2 MCAP files'):
            assert sum(part in line for line in text.splitlines()) == 1
        assert_one_line_each(text, 4)


@pytest.mark.parametrize('is_inside', [True, False])
def test_one_unfinished_episode_is_recovered_by_the_path_that_lists_give(
    directory, is_inside, monkeypatch, capsys
):
    leave(directory, 'other', b'')
    leftover = directory / '.cut.active'
    if is_inside:
        monkeypatch.chdir(leftover)
    assert episodes_recover.main(['.' if is_inside else str(leftover)]) == 0
    assert 'recovered' in capsys.readouterr().out
    assert not leftover.exists() and read_episode(directory / 'cut')
    assert [each.name for each in find_leftovers(directory)] == ['other']


def test_a_dry_run_returns_1_for_unrecoverable_episodes(directory, capsys):
    leave(directory, 'strange', b'').joinpath('notes.txt').write_text('hi')
    for options in (['--dry-run'], []):
        assert episodes_recover.main([str(directory), *options]) == 1
        output = capsys.readouterr()
        assert 'no episode of a robot' in output.err and 'strange' in output.err
        assert_one_line_each(output.err, 1)
        assert 'strange' not in output.out
