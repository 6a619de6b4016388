"""The examples in README and docs are valid: Python blocks run, parsers accept command lines.

Some command lines also run. Other programs (pip, git, ...) are only known by name.
"""

from __future__ import annotations

import argparse
import itertools
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import pytest
import yaml
from test_architecture import pages

from fetch_hand_sim.__main__ import main as fetch_hand_sim
from fetch_hand_sim.__main__ import ros_arguments
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.simulation import Simulation
from msgs_spec.parameters import NODES, validate
from msgs_spec.tasks import TASKS
from msgs_spec.topics import SERVICES, topics
from support import ROOT, script_environment
from support.shell_lines import commands, python_blocks, shell_lines

# Other programs, or files of the reader.
FOREIGN = set('. > apt cd colcon git ls mkdir pip plotjuggler python3 rviz2 ssh touch uvx'.split())
# Its task is there only when its package is: test_own_task.py reads its command lines.
WITH_ANOTHER_PACKAGE = {'own_task.md'}
# They train for half a minute.
TRAINING = {'notebook.md'}


class UnderstoodError(BaseException):
    """Ends a command when its parser has taken the command line."""


@pytest.fixture(scope='module')
def episodes(tmp_path_factory) -> Path:
    """A folder whose `episodes` holds what `make demo` would log, with a policy that rests."""
    folder = tmp_path_factory.mktemp('reader')
    simulation = Simulation('FetchReach', num_envs=2, num_threads=1)
    context = RecordingContext(simulation, with_compiled_model=False)
    rest = [[0.0] * simulation.spec.robot.action_size] * 2
    generator = EpisodeGenerator(simulation, folder / 'episodes', lambda _: rest, context)
    assert len(list(generator.generate(2, 0))) == 2
    return folder


def _pages_with(find) -> list[Path]:
    return [page for page in pages() if list(find(page.read_text()))]


@pytest.mark.parametrize(
    'page',
    [
        pytest.param(page, marks=[pytest.mark.release] if page.name in TRAINING else [])
        for page in _pages_with(python_blocks)
    ],
    ids=lambda page: page.name,
)
def test_python_runs_as_it_stands(page, episodes):
    """All blocks of a page, one after the other, where the demo has logged episodes."""
    if page.parent.name == 'tutorials':
        pytest.skip('followed whole, by test_tutorials.py')
    code = '\n'.join(python_blocks(page.read_text()))
    result = subprocess.run(
        [sys.executable, '-W', 'ignore', '-c', code],
        cwd=episodes,
        env=script_environment(),
        capture_output=True,
        text=True,
        timeout=170,
    )
    assert result.returncode == 0, result.stderr


@pytest.fixture
def understand(monkeypatch):
    """Checks the words of a command line; fails with what is wrong."""
    parse = argparse.ArgumentParser.parse_args

    def parse_only(self, args=None, namespace=None):
        parse(self, args, namespace)
        raise UnderstoodError

    monkeypatch.setattr(argparse.ArgumentParser, 'parse_args', parse_only)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def check(words: list[str]) -> None:
        name, *rest = words
        if name in FOREIGN and rest[:1] != ['-m']:
            return
        monkeypatch.setattr(sys, 'argv', words)
        try:
            _run(name.removeprefix('.venv/bin/'), rest)
        except UnderstoodError:
            pass
        except SystemExit as exit_:
            pytest.fail(f'{words}: not understood, exit code {exit_.code}')

    yield check
    for number, handler in handlers.items():
        signal.signal(number, handler)


def _run(name: str, rest: list[str]) -> None:
    """Finds what a command line means and lets its parser read it."""
    if name == 'make':
        _check_make(rest)
    elif name == 'ros2':
        _check_ros2(*rest)
    elif name in ('python', 'python3', 'torchrun'):
        _run_python([word for word in rest if word != '-O'])
    elif name in NODES:
        _check_parameters(name, rest)
    elif name == 'fetch_hand_sim' and rest[0] in ('sim', 'policy', 'replay'):
        node = {'sim': 'sim_node', 'policy': 'policy_node', 'replay': 'replay_node'}[rest[0]]
        _check_parameters(node, ros_arguments(rest[1:]))
    elif name == 'fetch_hand_sim':
        fetch_hand_sim(rest)
    elif name == 'view':
        fetch_hand_sim([name, *rest])
    else:
        assert name == 'pip', name


def _check_make(words: list[str]) -> None:
    makefile = (ROOT / 'Makefile').read_text()
    for word in words:
        variable, given, _ = word.partition('=')
        pattern = rf'\b{variable} \?=|\b{variable}\b.*\n?' if given else rf'^{re.escape(word)}:'
        assert re.search(pattern, makefile, re.MULTILINE), f'make {word}'


def _check_ros2(verb: str, *rest: str) -> None:
    if verb == 'run':
        package, name, *arguments = rest
        assert package == 'fetch_hand_sim'
        sys.argv = [name, *arguments]
        _run(name, arguments)
    elif verb == 'launch':
        package, name, *arguments = rest
        launch = ElementTree.parse(ROOT / 'launch' / name)
        known = {argument.get('name') for argument in launch.findall('arg')}
        assert {word.partition(':=')[0] for word in arguments} <= known
    elif verb == 'topic':
        known = {f'/{each.name.strip("/")}' for task in TASKS.values() for each in topics(task)}
        (named,) = (word for word in rest if word.startswith('/'))
        assert named in known, named
    elif verb == 'service':
        known = {each.name.replace('~', f'/{each.node}') for each in SERVICES}
        assert rest[1] in known, rest[1]
    elif verb == 'param':
        _, node, name, value = rest
        _check_parameter(node.strip('/'), name, value)
    else:
        assert verb == 'bag', verb


def _check_parameters(node: str, words: list[str]) -> None:
    for flag, word in itertools.pairwise(words):
        if flag == '-p':
            name, _, value = word.partition(':=')
            _check_parameter(node, name, value)


def _check_parameter(node: str, name: str, value: str) -> None:
    specs = {spec.name: spec for spec in NODES[node]}
    validate(specs[name], yaml.safe_load(value))


def _run_python(words: list[str]) -> None:
    if '-m' in words:
        module, rest = words[words.index('-m') + 1], words[words.index('-m') + 2 :]
        if module in ('venv', 'pip', 'colcon'):
            return
        if module == 'pytest':
            assert all((ROOT / word).exists() for word in rest if not word.startswith('-'))
            return
        sys.argv = [module, *rest]
        if module == 'fetch_hand_sim':
            fetch_hand_sim(rest)
        else:
            import_module(module).main()
    elif (ROOT / words[0]).is_file():
        script = compile((ROOT / words[0]).read_text(), words[0], 'exec')
        sys.argv = words
        if 'argparse' in script.co_names:
            file = ROOT / words[0]
            with patch.object(sys, 'path', [str(file.parent), *sys.path]):
                exec(script, {'__name__': '__main__', '__file__': str(file)})
    else:
        assert words[0] in ('my_controller.py', 'my_robot.py'), words


@pytest.mark.parametrize('page', _pages_with(shell_lines), ids=lambda page: page.name)
def test_command_lines_are_understood(page, understand):
    if page.name in WITH_ANOTHER_PACKAGE:
        assert page.name in (ROOT / 'test/nodes/test_own_task.py').read_text()
        return
    for line in shell_lines(page.read_text()):
        for words in commands(line):
            understand(words)


@pytest.mark.parametrize(
    'line',
    [
        'make nosuchtarget',
        'fetch_hand_sim train --taks FetchPush',
        'ros2 run fetch_hand_sim sim_node --ros-args -p tsak:=FetchPush',
        'ros2 topic hz /joint_state',
        'ros2 service call /sim_node/pauze std_srvs/srv/SetBool',
        'ros2 launch fetch_hand_sim demo.launch.xml tsak:=FetchReach',
        'fetch_hand_sim sim seed:=-1',
        'python -m pytest test/test_gone.py',
    ],
)
def test_a_wrong_command_line_is_noticed(line, understand, capsys):
    (words,) = commands(line)
    with pytest.raises((AssertionError, KeyError, ValueError, pytest.fail.Exception)):
        understand(words)


def test_lines_of_a_page_are_found():
    page = 'Text\n\n    a b  # c\n\n```sh\nX=1 d && e > f\n```\n\n```\nno\n```\n- item\n      no\n'
    assert list(shell_lines(page)) == ['a b  # c', 'X=1 d && e > f']
    found = [words for line in shell_lines(page) for words in commands(line)]
    assert found == [['a', 'b'], ['d'], ['e'], ['>', 'f']]
