"""What `view` cannot show is one line with the exit code of its kind; nothing is left running."""

from __future__ import annotations

import socket
import threading

import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.view import main
from fetch_hand_sim.view.web import open_browser
from support.episode_recorder import Recorder


class StrangeRecorder(Recorder):
    """Logs a task that is not installed here."""

    def metadata(self, started=None):
        return super().metadata(started) | {'task': 'FetchWalk'}


@pytest.fixture(scope='module')
def episode(tmp_path_factory):
    return Recorder('FetchReach').record(EpisodeDirectory(tmp_path_factory.mktemp('episodes')))


def error_of(capsys, arguments):
    """Exit code and the one line."""
    threads = threading.active_count()
    try:
        code = main([str(word) for word in arguments])
    except SystemExit as exit_:
        # As argparse ends.
        code = exit_.code
    output, error = capsys.readouterr()
    assert 'page is at' not in output and 'Traceback' not in error
    assert threading.active_count() == threads
    return code, error.strip().splitlines()


@pytest.mark.parametrize('content', [None, b'', b'no episode'])
def test_a_file_that_cannot_be_read(capsys, tmp_path, content):
    path = tmp_path / 'episode.mcap'
    if content is not None:
        path.write_bytes(content)
    code, (line,) = error_of(capsys, [path, '--no-browser'])
    assert code == 2
    assert line.startswith('view: ') and 'episode.mcap' in line


def test_a_folder_without_episodes(capsys, tmp_path):
    code, (line,) = error_of(capsys, [tmp_path, '--no-browser'])
    assert (code, line) == (2, f'view: {tmp_path}: no episodes')


def test_a_file_of_a_task_that_is_not_installed(capsys, tmp_path):
    path = StrangeRecorder('FetchReach').record(EpisodeDirectory(tmp_path))
    code, (line,) = error_of(capsys, [path, '--no-browser'])
    assert code == 2
    assert 'FetchWalk' in line and 'FetchReach' in line, 'what was given and what is allowed'


def test_a_mistyped_task_is_one_line(capsys):
    code, (line,) = error_of(capsys, ['--task', 'fetchpush'])
    assert code == 2 and line.endswith("; did you mean 'FetchPush'?")


def test_a_file_and_a_task_exclude_each_other(capsys, episode):
    code, lines = error_of(capsys, [episode, '--task', 'FetchPush'])
    assert code == 2
    assert lines[-1] == 'view: a file and --task or --robot exclude each other'


def test_a_port_that_is_in_use(capsys, episode):
    with socket.socket() as other:
        other.bind(('127.0.0.1', 0))
        other.listen()
        port = other.getsockname()[1]
        code, (line,) = error_of(capsys, [episode, '--no-browser', '--port', port])
    assert code == 1
    assert line.startswith(f'view: cannot listen on 127.0.0.1 port {port}: ')


@pytest.mark.parametrize('answer', [True, False])
def test_without_a_browser_it_says_what_to_do(capsys, answer):
    open_browser('http://127.0.0.1:8080/', lambda url: answer).join()
    said = capsys.readouterr().out
    assert said == ('' if answer else 'No browser was found: open the address in one\n')
