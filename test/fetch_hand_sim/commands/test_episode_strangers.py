"""Folders with hostile entries: one line each, no link followed, no pipe waited for."""

from __future__ import annotations

import os
import shutil
from io import BytesIO
from pathlib import Path

import pytest
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
    find_leftovers,
    load_episodes,
    read_episode,
    recover_episode,
)

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


# Functions that make an entry which no robot leaves.
BAD_LEFTOVERS = {
    'pipe inside': lambda bad: (bad.mkdir(), os.mkfifo(bad / 'bad_0.mcap')),
    'unknown pipe inside': lambda bad: os.mkfifo(leave(bad.parent, 'bad', b'') / 'pipe'),
    'pipe': os.mkfifo,
    'file': lambda bad: bad.write_text('no directory'),
    'folder inside': lambda bad: (bad / 'bad_0.mcap').mkdir(parents=True),
    'link to itself': lambda bad: bad.symlink_to(bad),
    'link elsewhere': lambda bad: bad.symlink_to(bad.parent / NAME),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize('make', BAD_LEFTOVERS.values(), ids=BAD_LEFTOVERS)
def test_a_bad_entry_hides_no_good_one(directory, make, capsys):
    make(directory / '.bad.active')
    bad, good = find_leftovers(directory)
    assert bad.problem and not good.problem
    assert episodes_list.main([str(directory)]) == 0
    assert '1 episode, ' in capsys.readouterr().out
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


def test_a_leftover_with_a_topic_of_another_type_stays_and_stops_no_other(directory, capsys):
    stream = BytesIO()
    writer = Writer(stream)
    writer.start(profile='ros2')
    writer.add_metadata('episode', {'task': 'FetchReach'})
    schema = writer.register_schema('std_msgs/msg/Empty', 'ros2msg', b'')
    writer.add_message(writer.register_channel('/reward', 'cdr', schema), 1, bytes(12), 1)
    writer.flush()
    leave(directory, 'bad', stream.getvalue())
    assert episodes_recover.main([str(directory)]) == 1
    output = capsys.readouterr()
    assert 'recovered' in output.out and read_episode(directory / 'cut')
    assert_one_line_each(output.err, 1)
    assert "no topic '/reward' of type" in output.err
    assert (directory / '.bad.active' / 'bad_0.mcap').read_bytes() == stream.getvalue()


def test_recovery_keeps_unreadable_files_aside(directory, finished):
    """One flipped bit in the length of a later chunk."""
    whole = (finished / f'{NAME}_0.mcap').read_bytes()[:-2000]
    damaged = flipped(whole, chunks(whole)[2] + 4)
    leave(directory, 'damaged', damaged)
    path = recover_episode(directory / '.damaged.active')
    assert 2 < len(read_episode(path).topics['/clock'].messages) < 30
    assert (directory / '.damaged.aside' / 'damaged_0.mcap').read_bytes() == damaged
    assert find_leftovers(directory)[0].name == 'cut'


# Paths


def test_names_that_are_no_text_and_command_a_terminal(finished, tmp_path, capsys):
    name = b'\xff\xfe \x1b]0;owned\x07 line\nbreak'
    directory = Path(os.fsdecode(os.fsencode(tmp_path) + b'/' + name))
    shutil.copytree(finished, directory / NAME)
    leave(directory, 'cut', (finished / f'{NAME}_0.mcap').read_bytes()[:-2000])
    (directory / 'text.mcap').write_text('no bag')
    export = ['--to', 'parquet', '--output', str(directory / 'out')]
    assert episodes_list.main([str(directory)]) == 1
    assert episodes_recover.main([str(directory)]) == 0
    assert episodes_export.main([str(directory), *export]) == 1
    output = capsys.readouterr()
    assert len(output.out.splitlines()) > 4 and len(output.err.splitlines()) == 2
    assert all(line.isprintable() for line in (output.out + output.err).splitlines())


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
    assert '1 episode, ' in listed.out and '1 episode of FetchReach' in exported.out
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
