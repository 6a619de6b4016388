"""`fetch_hand_sim`: help, unknown commands, short ROS parameters, completion."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest

from fetch_hand_sim.__main__ import COMMANDS, main, ros_arguments


@pytest.mark.parametrize('arguments', [[], ['--help'], ['episodes'], ['episodes', '--help']])
def test_without_a_command_help_is_printed(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    for name in COMMANDS['episodes'].commands if 'episodes' in arguments else COMMANDS:
        assert f' {name} ' in shown


@pytest.mark.parametrize(
    ('arguments', 'line'),
    [
        (['trian', '--task', 'FetchPush'], "no command 'trian'; did you mean 'train'?"),
        (['x'], "no command 'x'; allowed: demo, "),
        (['episodes', 'chek'], "no command 'chek'; did you mean 'check'?"),
        (['--verbose'], 'required: command'),
    ],
)
def test_an_unknown_command_is_one_line(arguments, line, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith('fetch_hand_sim') and line in error and error.count('\n') == 1


@pytest.mark.parametrize(
    ('words', 'expected'),
    [
        ([], []),
        (['task:=FetchPush', 'seed:=1'], ['--ros-args', '-p', 'task:=FetchPush', '-p', 'seed:=1']),
        (['--ros-args', '-p', 'seed:=1'], ['--ros-args', '-p', 'seed:=1']),
        (
            ['seed:=1', '--ros-args', '-r', 'commands:=c', '--', 'left over'],
            ['--ros-args', '-p', 'seed:=1', '-r', 'commands:=c', '--', 'left over'],
        ),
        (
            ['a:=1', '-r', 'commands:=c', '--params-file', 'my.yaml'],
            ['--ros-args', '-p', 'a:=1', '-r', 'commands:=c', '--params-file', 'my.yaml'],
        ),
        (['a:=1', 'left over', '-r', 'b:=c'], ['a:=1', 'left over', '-r', 'b:=c']),
        (['__ns:=/left', 'a:=1'], ['--ros-args', '-r', '__ns:=/left', '-p', 'a:=1']),
        (['--task', 'a:=1'], ['--task', 'a:=1']),
        (['--help'], ['--help']),
    ],
)
def test_parameters_of_a_node_need_no_ros_args(words, expected):
    assert ros_arguments(words) == expected


def test_a_node_takes_short_parameters(tmp_path):
    command = [sys.executable, '-m', 'fetch_hand_sim', 'sim', 'task:=NoSuchTask']
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2
    assert 'NoSuchTask' in result.stderr and result.stderr.count('\n') == 1


def test_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit):
        main(['--version'])
    assert capsys.readouterr().out == f'fetch_hand_sim {version("fetch_hand_sim")}\n'


@pytest.mark.parametrize('shell', ['bash', 'zsh', 'tcsh'])
def test_completion_knows_the_commands(shell, capsys):
    with pytest.raises(SystemExit) as caught:
        main(['--print-completion', shell])
    assert caught.value.code == 0
    script = capsys.readouterr().out
    assert 'benchmark' in script and 'recover' in script
