"""The programs of docs/libraries.md run, each where its library is installed.

The libraries are of others, large, and none is needed here: install one and run this file.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from support import ROOT, script_environment

PAGE = (ROOT / 'docs' / 'libraries.md').read_text()
PROGRAMS = dict(re.findall(r'^## ([^\n]*)\n.*?^```py\n(.*?)^```', PAGE, re.DOTALL | re.MULTILINE))
# Nothing but what is installed anyway.
ALWAYS = 'CleanRL, or any script of one file'
DATA = (
    ['generate', '--policy', 'FetchReach', '--episodes', '4', '--output', 'data'],
    ['export', 'data', '--to', 'minari', '--output', 'datasets', '--name', 'expert-v0'],
)


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = script_environment() | {'MINARI_DATASETS_PATH': str(folder / 'datasets')}
    command = [sys.executable, '-W', 'ignore', *words]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize(
    'name',
    [
        name if name == ALWAYS else pytest.param(name, marks=pytest.mark.release)
        for name in PROGRAMS
    ],
)
def test_the_program_runs(tmp_path: Path, name: str) -> None:
    imports = re.findall(r'^(?:import|from) .*', PROGRAMS[name], re.MULTILINE)
    missing = run(tmp_path, '-c', '\n'.join(imports))
    if 'ModuleNotFoundError' in missing.stderr and name != ALWAYS:
        pytest.skip(missing.stderr.splitlines()[-1])
    if 'minari' in PROGRAMS[name]:
        for words in DATA:
            made = run(tmp_path, '-m', 'fetch_hand_sim', 'episodes', *words)
            assert made.returncode == 0, made.stderr
    program = tmp_path / 'program.py'
    program.write_text(PROGRAMS[name])
    done = run(tmp_path, str(program))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() or done.stderr.strip()


def test_every_library_of_the_table_has_a_program() -> None:
    rows = re.findall(r'^\| ([A-Za-z0-9-]+)', PAGE, re.MULTILINE)
    assert set(rows) - {'library', '---'} == {re.split(r'[ ,]', name)[0] for name in PROGRAMS}
