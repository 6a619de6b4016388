"""Ctrl-C while a command is imported ends in one line and exit code 130, without traceback."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from node_runtime.signals import EXECUTABLES
from support import script_environment
from support.entry_points import console_scripts

# As pip writes it into the folder of programs.
SCRIPT = 'import sys\nfrom {module} import {function}\nsys.exit({function}())\n'
# Start of the lines of `python -X importtime`.
IMPORT = 'import time:'
# The last import before Ctrl-C has its handler.
GUARD = 'node_runtime.signals'


def interrupt(command: Sequence[str | Path], imports: int) -> tuple[int, str]:
    """Press Ctrl-C when so many modules have been loaded after the handler; return code and stderr.

    On a busy machine a short command may be over before the signal reaches it: then again.
    """
    for _ in range(10):
        process = subprocess.Popen(
            [sys.executable, '-X', 'importtime', *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=script_environment(),
            start_new_session=True,
        )
        said, left = [], None
        for line in process.stderr:
            if not line.startswith(IMPORT):
                said.append(line)
            elif left is None and line.split('|')[-1].strip() == GUARD:
                left = imports
            elif left:
                left -= 1
                if left == 0:
                    process.send_signal(signal.SIGINT)
        if process.wait(60) not in (0, 2):
            break
    return process.returncode, ''.join(said)


@pytest.fixture(scope='module')
def programs(tmp_path_factory) -> Path:
    """A folder of programs, as an installation makes it."""
    folder = tmp_path_factory.mktemp('bin')
    for name, (module, function) in console_scripts().items():
        (folder / name).write_text(SCRIPT.format(module=module, function=function))
    return folder


# Modules share the code of programs; these import least and most.
MODULES = ('fetch_hand_sim', 'fetch_hand_sim.sim_node', 'policy_node.training.train_her')


@pytest.mark.parametrize('started', [*sorted(EXECUTABLES), *(f'-m {name}' for name in MODULES)])
def test_ctrl_c_during_the_import_of_a_program_or_module(started, programs):
    command = started.split() if started.startswith('-m') else [programs / started]
    name = started.rpartition(' ')[2].rpartition('.')[2]
    assert interrupt(command, 1) == (130, f'{name}: stopping\n')


@pytest.mark.parametrize(
    ('name', 'words', 'imports'),
    [
        ('fetch_hand_sim', ['episodes', 'list', '.'], 60),
        ('fetch_hand_sim', ['demo'], 300),
        ('fetch_hand_sim', ['train', '--task', 'FetchReach', '--output', 'run'], 60),
        ('view', ['--no-browser'], 300),
    ],
)
def test_a_command_at_any_moment(name, words, imports, programs):
    code, said = interrupt([programs / name, *words], imports)
    assert code == 130, said
    assert re.fullmatch(rf'{name}( [a-z]+)*: stopping\n', said)


def test_a_third_party_program_keeps_its_handler(tmp_path):
    # Beside a folder of the package's name, as in a checkout.
    (tmp_path / 'fetch_hand_sim').mkdir()
    program = tmp_path / 'view'
    program.write_text(
        'import signal, fetch_hand_sim, policy_node\n'
        'assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n'
    )
    subprocess.run([sys.executable, program], check=True, env=script_environment())
