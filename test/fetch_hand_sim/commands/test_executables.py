"""Executables are found through entry points, and start as the installed scripts do."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from fetch_hand_sim.commands.node_processes import executable, policy_or_default


def test_an_executable_runs_with_its_exit_code_and_no_python_file_of_its_folder(tmp_path):
    for name in ('random', 'numpy', 'yaml'):
        (tmp_path / f'{name}.py').write_text('raise RuntimeError("not asked for")')
    for folder, code, output, error in (
        ('.', 0, '0 episodes', ''),
        ('none', 2, '', 'fetch_hand_sim episodes list: none'),
    ):
        command = [*executable('fetch_hand_sim'), 'episodes', 'list', folder]
        result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        assert result.returncode == code and result.stdout.startswith(output)
        assert result.stderr.startswith(error) and result.stderr.count('\n') == bool(error)


@pytest.mark.parametrize('closed', [1, 2])
def test_a_node_without_stdout_or_stderr_does_its_work(closed):
    words = ['-p', 'task:=FetchReach', '-p', 'episodes:=1', '-p', 'real_time_factor:=0.0']
    command = [*executable('sim_node'), '--ros-args', *words]
    process = subprocess.Popen(command, preexec_fn=lambda: os.close(closed))
    assert process.wait(60) == 0


def test_an_rclpy_of_another_python_is_one_line(tmp_path):
    (tmp_path / 'rclpy').mkdir()
    code = 'raise ImportError("no _rclpy_pybind11 for this Python")'
    (tmp_path / 'rclpy' / '__init__.py').write_text(code)
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path)}
    for name in ('sim_node', 'view'):
        command = [*executable(name), *(['--task', 'FetchReach'] if name == 'view' else [])]
        result = subprocess.run(command, capture_output=True, text=True, env=environment)
        (line,) = result.stderr.splitlines()
        assert result.returncode == 2
        assert line.startswith(f'{name}: rclpy cannot be used by Python 3.')
        assert line.endswith('for this Python')


@pytest.mark.skipif(sys.platform != 'linux', reason='Linux tells of a parent that has ended')
def test_an_executable_whose_parent_has_ended_does_not_start(tmp_path):
    for parent, code in ((os.getpid(), 0), (os.getppid(), -signal.SIGTERM)):
        command = [*executable('fetch_hand_sim', parent), 'episodes', 'list', tmp_path]
        assert subprocess.run(command, capture_output=True).returncode == code


def test_the_default_policy_is_the_shipped_actor_or_random(capsys):
    assert policy_or_default('mine.onnx', 'SomebodysTask') == 'mine.onnx'
    assert policy_or_default('', 'FetchReach') == 'FetchReach'
    assert capsys.readouterr().out == ''
    assert policy_or_default('', 'SomebodysTask') == 'random'
    assert 'No actor is shipped for SomebodysTask' in capsys.readouterr().out
