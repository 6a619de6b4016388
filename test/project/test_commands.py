"""Every command: names, help, exit codes, and errors of one line."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
from importlib.metadata import distribution

import pytest
from reference_pages import leaves

from fetch_hand_sim.__main__ import main
from fetch_hand_sim.commands.node_processes import executable
from node_runtime.command_line import EXTRAS
from node_runtime.signals import EXECUTABLES
from support import script_environment
from support.entry_points import console_scripts, started_as_modules

# Modules that each command needs beyond the base installation.
NEEDS = {
    'sim': ['rclpy'],
    'policy': ['rclpy'],
    'replay': ['rclpy'],
    'visualize': ['rclpy'],
    'view': ['rclpy'],
    'demo': ['rclpy'],
    'train': ['torch', 'matplotlib', 'tensorboard'],
    'evaluate': [],
    'robustness': ['torch', 'matplotlib', 'tensorboard'],
    'benchmark': ['torch', 'matplotlib', 'tensorboard'],
    'export': ['torch', 'onnx', 'onnxscript'],
    'episodes list': [],
    'episodes check': [],
    'episodes film': [],
    'episodes recover': [],
    'episodes export': ['pyarrow', 'minari'],
    'episodes generate': [],
}
NODES = {'sim': 'sim_node', 'policy': 'policy_node', 'replay': 'replay_node'} | {
    'visualize': 'visualization_node'
}


def shown_name(command: str) -> str:
    """The name that starts the error lines of a command."""
    if command == 'view':
        return command
    return NODES.get(command, f'fetch_hand_sim {command}')


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command in this process, because most of them load torch.

    Returns exit code, stdout and stderr.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(sys, 'argv', [])

    def call(name: str, *arguments: object) -> tuple[int, str, str]:
        try:
            code = main([*name.split(), *map(str, arguments)])
        except SystemExit as exit_:
            code = exit_.code
        return code, *capsys.readouterr()

    yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_every_command_is_in_the_table_of_extras():
    assert {' '.join(path) for path, _ in leaves()} == set(NEEDS)


def test_executables_are_the_nodes_view_and_one_for_all_commands():
    assert set(console_scripts()) == EXECUTABLES == {'fetch_hand_sim', 'view', *NODES.values()}


@pytest.mark.parametrize(
    ('name', 'module'), [(name, module) for name, needs in NEEDS.items() for module in needs]
)
def test_a_missing_extra_is_one_line_with_the_pip_command(name, module, run, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    to = 'minari' if module == 'minari' else 'parquet'
    required = ['x', '--to', to, '--output', 'x'] if name == 'episodes export' else []
    code, output, error = run(name, *required)
    assert (code, output) == (2, '')
    line = rf"{shown_name(name)}: {module} missing: .*pip install 'fetch_hand_sim\[\w+\]'\n"
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
    assert len(modules) > 10 and 'policy_node.training.train_her' in modules
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


@pytest.mark.parametrize('name', sorted(set(NEEDS) - set(NODES)))
def test_every_command_has_help(name, run):
    code, output, error = run(name, '--help')
    assert (code, error) == (0, '')
    assert f'usage: {shown_name(name)} [-h]' in output


def test_help_loads_no_large_library():
    code = (
        'import sys\nfrom fetch_hand_sim.__main__ import main\n'
        'try: main(sys.argv[1:])\nexcept SystemExit: pass\n'
        "sys.exit(bool({'torch', 'rclpy', 'pyarrow', 'matplotlib'} & set(sys.modules)))"
    )
    for words in ([], ['train'], ['evaluate'], ['episodes', 'list'], ['demo']):
        command = [sys.executable, '-c', code, *words, '--help']
        assert subprocess.run(command, stdout=subprocess.DEVNULL).returncode == 0, words


@pytest.mark.parametrize(
    ('name', 'arguments', 'line'),
    [
        ('evaluate', '--policy nosuch', 'nosuch'),
        ('episodes generate', '--policy nosuch --output x', 'nosuch'),
        ('export', 'nosuch x.onnx', 'nosuch'),
        ('export', 'FetchReach nosuch.txt', 'nosuch'),
        ('train', '--task FetchReach --set nosuch=1', 'nosuch'),
        ('episodes list', 'nosuch', 'nosuch'),
        ('view', 'nosuch', 'nosuch'),
        ('episodes film', 'nosuch --out x.png', 'nosuch'),
        ('episodes film', 'x --out x.nosuch', 'nosuch'),
        ('episodes check', 'nosuch', 'nosuch'),
        ('episodes recover', 'nosuch', 'nosuch'),
        ('episodes export', 'nosuch --to parquet --output x', 'nosuch'),
        ('evaluate', '--episodes 0', "--episodes: '0' given; allowed: whole numbers from 1"),
        ('evaluate', '--first-seed inf', "'inf' given; allowed: whole numbers 0 ... 4294967295"),
        ('benchmark', '--jobs 0', "--jobs: '0' given; allowed: whole numbers from 1"),
        ('benchmark', '--seeds 0,1', "'0,1' given; allowed: whole numbers from 0"),
        ('episodes generate', '--first-seed 9223372036854775808', 'numbers 0 ... 4294967295'),
        ('episodes generate', '', 'the following arguments are required: --output'),
        ('episodes list', '--nosuch', 'the following arguments are required: path'),
        ('train', '--set seed=1 gamma=.9', 'a --set of its own: --set gamma=.9'),
        ('train', '--nosuch \x1b[31m', 'unrecognized arguments: --nosuch \\x1b[31m'),
    ],
)
def test_bad_usage_is_one_line_and_leaves_no_file(
    name, arguments, line, run, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    code, output, error = run(name, *arguments.split())
    assert (code, output) == (2, '')
    assert error.startswith(f'{shown_name(name)}: ') and line in error and error.count('\n') == 1
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_in_an_evaluation_keeps_finished_episodes():
    arguments = (
        '--policy resting --task FetchReach --episodes 1000000 --num-envs 4 --threads 1'.split()
    )
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        [*executable('fetch_hand_sim'), 'evaluate', *arguments],
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
    assert b'fetch_hand_sim evaluate: stopping' in shown and b'Traceback' not in shown
    assert re.search(r'FetchReach: resting, \d+ episodes', output)


def test_setup_py_declares_all_extras():
    declared = set(distribution('fetch_hand_sim').metadata.get_all('Provides-Extra'))
    assert set(EXTRAS) <= declared
