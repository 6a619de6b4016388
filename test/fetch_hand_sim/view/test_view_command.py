"""If `view` cannot show a source, it prints one line, returns the right exit code and ends."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.view import main
from fetch_hand_sim.view.command import parse
from fetch_hand_sim.view.live_session import check_alive
from fetch_hand_sim.view.web import open_browser
from node_runtime.node_main import NodeFailure
from support.episode_recorder import Recorder


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


def test_a_folder_without_episodes_or_with_one_of_an_unknown_task(capsys, tmp_path):
    code, (line,) = error_of(capsys, [tmp_path, '--no-browser'])
    assert (code, line) == (2, f'view: {tmp_path} holds no episode')
    recorder = Recorder('FetchReach')
    unknown = recorder.metadata() | {'task': 'FetchWalk'}
    recorder.metadata = lambda started=None: unknown
    recorder.record(EpisodeDirectory(tmp_path))
    code, (line,) = error_of(capsys, [tmp_path, '--no-browser'])
    assert code == 2
    assert 'FetchWalk' in line and 'FetchReach' in line, 'what was given and what is allowed'


@pytest.mark.parametrize(
    ('arguments', 'begin', 'end'),
    [
        (['x', '--task', 'FetchPush'], 'a file and --task exclude', ''),
        (['x', '--robot', 'left'], 'a file and --robot exclude', ''),
        (['x', '--episode-dir', 'y', '--task', 'FetchPush'], 'a file and --task and --epi', ''),
        (['--policy', 'x', '--wait', '0'], '--policy: only together with --task', ''),
        (['--episode-dir', 'x', '--wait', '0'], '--episode-dir: only together with --task', ''),
        (['--trust', '--wait', '0'], '--trust: only together with --task', ''),
        (['--wait=nan'], '--wait nan; allowed: 0 and more', ''),
        (['--port', '99999'], '--port 99999; allowed: 0 ... 65535', ''),
        (['--task', 'fetchpush'], '', "; did you mean 'FetchPush'?"),
    ],
)
def test_wrong_options_are_one_line(capsys, arguments, begin, end):
    code, (line,) = error_of(capsys, arguments)
    assert code == 2
    assert line.startswith(f'view: {begin}') and line.endswith(end)


@pytest.mark.parametrize(
    ('name', 'hint'),
    [
        ('left-arm', "'left_arm'"),
        ('/a/b-1/', "'a/b_1'"),
        ('1a', ''),
        ('\u00fc', ''),
        ('x' * 151, ''),
    ],
)
def test_what_is_no_namespace_is_one_line_with_what_is_meant(capsys, name, hint):
    code, (line,) = error_of(capsys, ['--robot', name, '--wait', '0'])
    assert code == 2
    assert line.startswith(f"view: argument --robot: '{name[:80]}' given; allowed: letters, ")
    assert line.endswith(f'did you mean {hint}?' if hint else 'up to 150 characters')


@pytest.mark.parametrize('name', ['', 'left', '/left/', 'a/b_1', '_x', 'x' * 150])
def test_a_namespace_is_taken_with_and_without_slashes(name):
    assert parse(['--robot', name]).robot == name.strip('/')


@pytest.mark.parametrize(
    ('code', 'said'),
    [
        ('import os; os.kill(os.getpid(), 9)', 'sim_node was killed by SIGKILL'),
        (
            'import sys; print("[INFO] [sim_node]: episode 0", file=sys.stderr); exit("no task")',
            'sim_node ended with exit code 1: no task',
        ),
    ],
)
def test_a_node_that_dies_is_named_with_its_cause(code, said, tmp_path):
    with (tmp_path / 'log').open('w') as log:
        running = subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE)
        dead = subprocess.Popen([sys.executable, '-c', code], stderr=log)
        dead.wait()
        with running, pytest.raises(NodeFailure) as failure:
            check_alive({'policy_node': running, 'sim_node': dead}, log)
    assert str(failure.value) == said


@pytest.mark.parametrize('answer', [True, False])
def test_without_a_browser_the_remedy_is_printed(capsys, answer):
    open_browser('http://127.0.0.1:8080/', lambda url: answer).join()
    said = capsys.readouterr().out
    assert said == ('' if answer else 'No browser was found: open the address in one\n')
