"""Hostile files end in a clear error at little cost."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys

import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeReadError,
    find_episodes,
    load_episodes,
    read_episode,
    read_summary,
)
from support import SUPPORT, script_environment
from support.crafted_files import Crafter
from support.episode_recorder import Recorder

# `make torture` turns these up.
FILES = int(os.environ.get('EPISODE_MUTATIONS', '240'))
CRAFTED = int(os.environ.get('EPISODE_CRAFTED', '25'))
SCRIPT = SUPPORT / 'mutated_files.py'
READERS = 6


@pytest.fixture(scope='module')
def episode(tmp_path_factory):
    return Recorder('FetchReach').record(EpisodeDirectory(tmp_path_factory.mktemp('episode')))


@pytest.mark.timeout(60 + FILES)
def test_damaged_files_end_in_one_line_or_a_result(episode):
    environment = script_environment()
    run = subprocess.run(
        [sys.executable, SCRIPT, episode / f'{episode.name}_0.mcap', str(FILES), '7'],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert run.returncode == 0, run.stderr
    report = json.loads(run.stdout)
    print(report)
    assert sum(report['outcomes'].values()) == READERS * FILES
    assert report['outcomes']['read_episode error'] > 0.8 * FILES
    assert report['slowest_s'] < 5.0


@pytest.mark.timeout(120 + 5 * CRAFTED)
def test_crafted_files_end_in_one_line_within_two_seconds_and_half_a_gigabyte(episode):
    """Right checksums, wrong meaning, through all command lines; nothing is written outside."""
    run = subprocess.run(
        [sys.executable, SUPPORT / 'crafted_files.py', episode, str(CRAFTED), '3'],
        capture_output=True,
        text=True,
        env=script_environment(),
    )
    assert run.returncode == 0, run.stderr
    report = json.loads(run.stdout)
    print(report)
    assert sum(report['outcomes'].values()) == READERS * CRAFTED
    assert report['slowest_s'] < 2.0
    assert report['peak_bytes'] < 500 * 10**6
    # The memory that one process keeps levels off.
    assert report['held_bytes'] < 750 * 10**6
    # Most are found out, and by far not all: what is only strange is read.
    assert 0.2 * CRAFTED < report['outcomes']['episodes check exit 2'] < CRAFTED


def test_a_pipe_is_no_episode(tmp_path):
    os.mkfifo(tmp_path / 'pipe.mcap')
    for read in (read_episode, read_summary, load_episodes):
        with pytest.raises(EpisodeReadError, match='no regular file'):
            read(tmp_path / 'pipe.mcap')
    assert find_episodes(tmp_path) == [tmp_path / 'pipe.mcap']


def test_an_empty_file_is_no_episode(tmp_path):
    (tmp_path / 'empty.mcap').touch()
    for read in (read_episode, read_summary, load_episodes):
        with pytest.raises(EpisodeReadError, match=r'empty\.mcap'):
            read(tmp_path / 'empty.mcap')


def test_a_message_shorter_than_its_header_is_one_line(tmp_path):
    def record(opcode, content):
        return bytes([opcode]) + struct.pack('<Q', len(content)) + content

    short = record(Opcode.MESSAGE, struct.pack('<H', 1))
    sizes = struct.pack('<QQQIIQ', 0, 0, len(short), 0, 0, len(short))
    body = record(Opcode.HEADER, bytes(8)) + record(Opcode.CHUNK, sizes + short)
    body += record(Opcode.DATA_END, bytes(4))
    (tmp_path / 'short.mcap').write_bytes(MCAP0_MAGIC + body + MCAP0_MAGIC)
    with pytest.raises(EpisodeReadError, match='a message is shorter than its header'):
        load_episodes(tmp_path / 'short.mcap')


@pytest.mark.parametrize('read', [load_episodes, read_episode])
def test_a_thousand_metadata_records_are_one_line(read, tmp_path):
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path / 'logged'))
    content = Crafter(path, 0, 0).whole()
    content.records += ('rosbag2', *(f'record {number}' for number in range(1000)))
    (tmp_path / 'many.mcap').write_bytes(content.to_bytes())
    with pytest.raises(EpisodeReadError, match='more than 16 metadata records'):
        read(tmp_path / 'many.mcap')
