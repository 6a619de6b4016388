"""The controller in the documentation, run as it stands there."""

from __future__ import annotations

import ast
import re
import sys

import pytest

from support import ROOT
from support.graph import logged_run

PAGE = ROOT / 'docs' / 'tutorials' / 'write_your_own_controller.md'


@pytest.fixture
def controller(tmp_path):
    """The code block of the page as a file."""
    (code,) = re.findall(r'```python my_controller.py\n(.*?)```', PAGE.read_text(), re.DOTALL)
    path = tmp_path / 'my_controller.py'
    path.write_text(code)
    return path


def test_the_controller_is_short_and_imports_only_ros(controller):
    code = controller.read_text()
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 40
    imported = {
        (alias.name if isinstance(node, ast.Import) else node.module).partition('.')[0]
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert imported == {'rclpy', 'geometry_msgs', 'std_msgs'}


@pytest.mark.parametrize('mode', ['realtime', pytest.param('lockstep', marks=pytest.mark.release)])
def test_it_drives_the_arm_to_its_goals(controller, start_process, tmp_path, mode):
    start_process(sys.executable, controller, cwd=tmp_path)
    settings = {'mode': mode, 'episodes': 2, 'real_time_factor': 2.0}
    logged = logged_run(start_process, tmp_path / 'episodes', **settings)
    assert [episode.result['success'] for episode in logged] == ['true', 'true']
    assert all(episode.is_complete for episode in logged)
