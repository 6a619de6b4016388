"""All commands, as installed: one exit code for one kind of failure, no traceback for anybody."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
from importlib.metadata import distribution

import pytest

from fetch_hand_sim.commands.executables import executable, find_executable
from node_runtime.command_line import EXTRAS
from support import script_environment
from support.entry_points import console_scripts, started_as_modules

NODES = {'sim_node', 'policy_node', 'replay_node', 'visualization_node'}
# What each executable needs beyond the base installation.
NEEDS = {
    'sim_node': ['rclpy'],
    'policy_node': ['rclpy'],
    'replay_node': ['rclpy'],
    'view': ['rclpy'],
    'visualization_node': ['rclpy'],
    'render_episode': [],
    'evaluate_policy': [],
    'generate_episodes': [],
    'train_her': ['torch', 'matplotlib', 'tensorboard'],
    'benchmark': ['torch', 'matplotlib', 'tensorboard'],
    'export_actor': ['torch', 'onnx', 'onnxscript'],
    'export_episodes': ['pyarrow', 'minari'],
    'fetch_hand_sim': [],
    'list_episodes': [],
    'check_episode': [],
    'recover_episodes': [],
}


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs an executable through its entry point; returns exit code, stdout and stderr.

    In this process, because most of them load torch.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def call(name: str, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, 'argv', [name, *map(str, arguments)])
        try:
            code = find_executable(name).load()()
        except SystemExit as exit_:
            code = exit_.code
        return code, *capsys.readouterr()

    yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_every_executable_says_what_it_needs():
    assert set(console_scripts()) == set(NEEDS)


@pytest.mark.parametrize(
    ('name', 'module'), [(name, module) for name, needs in NEEDS.items() for module in needs]
)
def test_a_missing_extra_is_one_line_that_says_what_to_install(name, module, run, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    to = 'minari' if module == 'minari' else 'parquet'
    required = ['x', '--to', to, '--output', 'x'] if name == 'export_episodes' else []
    code, output, error = run(name, *required)
    assert (code, output) == (2, '')
    line = rf"{name}: {module} missing: .*pip install 'fetch_hand_sim\[\w+\]'\n"
    assert re.fullmatch(line, error)


# Runs modules as `python -m` does, each in a fork: what all of them load is loaded once.
WITHOUT_EXTRAS = """
import os, runpy, sys, traceback

sys.modules.update(dict.fromkeys({extras!r}))
import fetch_hand_sim.episodes.generator, node_runtime.node_main, rich.progress, rich.table, shtab

for module in {modules!r}:
    print(f'== {{module}}', file=sys.stderr, flush=True)
    if os.fork() == 0:
        sys.argv = [module]
        code = 1
        try:
            runpy.run_module(module, run_name='__main__', alter_sys=True)
        except SystemExit as exit_:
            code = exit_.code
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        os._exit(code)
    print(f'exit {{os.waitstatus_to_exitcode(os.wait()[1])}}', file=sys.stderr, flush=True)
"""


def test_modules_without_any_extra_end_without_traceback(tmp_path):
    modules = started_as_modules()
    assert len(modules) > 15 and 'policy_node.training.train_her' in modules
    extras = sorted({module for needed in EXTRAS.values() for module in needed})
    code = WITHOUT_EXTRAS.format(extras=extras, modules=modules)
    command = [sys.executable, '-c', code]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=script_environment()
    )
    assert 'Traceback' not in done.stderr, done.stderr
    for said in done.stderr.split('== ')[1:]:
        *lines, code = said.splitlines()[1:]
        assert code in ('exit 0', 'exit 2'), said
        assert len(lines) <= 1, said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('name', sorted(set(NEEDS) - NODES))
def test_help_is_there(name, run):
    code, output, error = run(name, '--help')
    assert (code, error) == (0, '')
    assert f'usage: {name}' in output


@pytest.mark.parametrize(
    ('name', 'arguments'),
    [
        ('evaluate_policy', ['--policy', 'nosuch']),
        ('generate_episodes', ['--policy', 'nosuch', '--output', 'x']),
        ('export_actor', ['nosuch', 'x.onnx']),
        ('export_actor', ['FetchReach', 'nosuch.txt']),
        ('train_her', ['--task', 'FetchReach', '--set', 'nosuch=1']),
        ('list_episodes', ['nosuch']),
        ('view', ['nosuch']),
        ('render_episode', ['nosuch', '--out', 'x.png']),
        ('render_episode', ['x', '--out', 'x.nosuch']),
        ('check_episode', ['nosuch']),
        ('recover_episodes', ['nosuch']),
        ('export_episodes', ['nosuch', '--to', 'parquet', '--output', 'x']),
    ],
)
def test_what_is_not_there_is_bad_usage_in_one_line(name, arguments, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, output, error = run(name, *arguments)
    assert (code, output) == (2, '')
    assert re.fullmatch(rf'{name}: .*nosuch.*\n', error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('name', 'arguments', 'line'),
    [
        (
            'evaluate_policy',
            ['--episodes', '0'],
            "--episodes: '0' given; allowed: whole numbers from 1",
        ),
        (
            'evaluate_policy',
            ['--first-seed', 'inf'],
            "'inf' given; allowed: whole numbers 0 ... 4294967295",
        ),
        ('benchmark', ['--jobs', '0'], "--jobs: '0' given; allowed: whole numbers from 1"),
        (
            'generate_episodes',
            ['--first-seed', '9223372036854775808'],
            'allowed: whole numbers 0 ... 4294967295',
        ),
        ('generate_episodes', [], 'the following arguments are required: --output'),
        ('list_episodes', ['--nosuch'], 'the following arguments are required: directory'),
        ('train_her', ['--set', 'seed=1', 'gamma=.9'], 'a --set of its own: --set gamma=.9'),
        ('benchmark', ['--seeds', '0,1'], "'0,1' given; allowed: whole numbers with spaces"),
        ('train_her', ['--nosuch', '\x1b[31m'], 'unrecognized arguments: --nosuch \\x1b[31m'),
    ],
)
def test_bad_usage_is_one_line(name, arguments, line, run):
    code, output, error = run(name, *arguments)
    assert (code, output) == (2, '')
    assert error.startswith(f'{name}: ') and line in error and error.count('\n') == 1


def test_ctrl_c_in_an_evaluation_keeps_what_is_finished():
    arguments = ['--policy', 'resting', '--task', 'FetchReach', '--episodes', '1000000']
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        [*executable('evaluate_policy'), *arguments, '--num-envs', '4', '--threads', '1'],
        stdout=subprocess.PIPE,
        stderr=end,
        text=True,
    )
    os.close(end)
    shown = b''
    while not re.search(rb'[1-9]\d*/1000000', shown):
        shown += os.read(terminal, 4096)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    shown += os.read(terminal, 65536)
    os.close(terminal)
    assert process.returncode == 130
    assert b'evaluate_policy: stopping' in shown and b'Traceback' not in shown
    assert re.search(r'FetchReach: resting, \d+ episodes', output)


def test_extras_are_those_of_the_package():
    declared = set(distribution('fetch_hand_sim').metadata.get_all('Provides-Extra'))
    assert set(EXTRAS) <= declared
