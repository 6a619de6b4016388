"""Fixtures of the tests of episode files."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import pytest


@pytest.fixture(scope='session')
def recorder():
    """A recorder of FetchReach; its metadata stay those of its first episode, `ticks`."""
    # Imported late: the environment of ROS is set before message classes are imported.
    from support.episode_recorder import Recorder

    recorder = Recorder('FetchReach')
    metadata = recorder.metadata()
    recorder.metadata = lambda started=None: metadata
    recorder.first_ticks = recorder.ticks()
    return recorder


@pytest.fixture(scope='session')
def ticks(recorder):
    """One episode."""
    return recorder.first_ticks


@pytest.fixture
def mount():
    """Makes small file systems; needs the right to mount."""
    mounted = []

    def make(*options):
        path = Path(tempfile.mkdtemp(prefix='episodes_'))
        command = ['mount', '-t', 'tmpfs', '-o', ','.join(options), 'tmpfs', path]
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode:
            path.rmdir()
            pytest.skip(f'no right to mount a small disk: {result.stderr.strip()}')
        mounted.append(path)
        return path

    yield make
    for path in mounted:
        subprocess.run(['umount', '-l', path], check=True)
        path.rmdir()
