"""`colcon build` installs the layout of ROS packages; `colcon test` runs the tests."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from support import ROOT
from support.entry_points import console_scripts
from support.graph import finish

PACKAGE = 'fetch_hand_sim'
BIN = Path(sys.prefix) / 'bin'

# It builds the package; test_packages.py checks the same files in the wheel.
pytestmark = pytest.mark.release


def tracked_files() -> list[str]:
    """The files git tracks: a forgotten `git add` must break the build here, not elsewhere."""
    # A build machine may run the tests as another user than the one who cloned.
    command = ['git', '-c', f'safe.directory={ROOT}', 'ls-files', '-z']
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in listing.stdout.split('\0') if name and (ROOT / name).exists()]


def colcon(workspace, verb, *arguments):
    """Runs colcon on the package in a workspace."""
    environment = os.environ | {
        'PATH': f'{BIN}{os.pathsep}{os.environ["PATH"]}',
        'COLCON_HOME': str(workspace / 'home'),
        'COLCON_LOG_PATH': str(workspace / 'log'),
    }
    # The workspace must be tested, not the checkout that this run may have on its path.
    environment.pop('PYTHONPATH', None)
    command = [BIN / 'colcon', verb, '--packages-select', PACKAGE, *arguments]
    return subprocess.run(command, cwd=workspace, env=environment, capture_output=True, text=True)


@pytest.fixture(scope='module')
def workspace(tmp_path_factory):
    """A colcon workspace with the package in `src`, built into `install`."""
    workspace = tmp_path_factory.mktemp('workspace')
    for name in tracked_files():
        target = workspace / 'src' / PACKAGE / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)
    build = colcon(workspace, 'build')
    assert build.returncode == 0, build.stdout + build.stderr
    # colcon completes missing `data_files` with a warning; pip does not.
    assert 'WARNING' not in build.stderr
    return workspace


@pytest.fixture(scope='module')
def prefix(workspace):
    """The install prefix of the package."""
    return workspace / 'install' / PACKAGE


def test_every_executable_is_where_ros2_run_looks(prefix):
    folder = prefix / 'lib' / PACKAGE
    assert {path.name for path in folder.iterdir()} == set(console_scripts())
    for path in folder.iterdir():
        assert path.stat().st_mode & stat.S_IXUSR, path
        # Not the interpreter of the build: the node needs the packages of the user's environment.
        assert path.read_text().startswith('#!/usr/bin/env python3\n'), path


def test_the_package_is_in_the_ament_index_with_all_data_files(prefix):
    assert (prefix / 'share/ament_index/resource_index/packages' / PACKAGE).is_file()
    share = prefix / 'share' / PACKAGE
    manifest = (share / 'package.xml').read_bytes()
    assert manifest == (ROOT / 'package.xml').read_bytes()
    licence = ElementTree.fromstring(manifest).find('license').get('file')
    assert (share / licence).read_bytes() == (ROOT / 'LICENSE').read_bytes()
    for folder in ('launch', 'config'):
        tracked = {Path(name).name for name in tracked_files() if name.startswith(f'{folder}/')}
        assert tracked and {path.name for path in (share / folder).iterdir()} == tracked


def test_it_builds_with_links_to_the_sources_too(workspace, tmp_path):
    """`colcon` then links setup.py into its build folder, and nothing beside it."""
    shutil.copytree(workspace / 'src', tmp_path / 'src')
    build = colcon(tmp_path, 'build', '--symlink-install')
    assert build.returncode == 0, build.stdout + build.stderr
    assert (tmp_path / 'install' / PACKAGE / 'lib' / PACKAGE / 'sim_node').is_file()


def test_colcon_test_runs_the_tests(workspace):
    """A requirement that colcon cannot read makes it find none, and be content with that."""
    file = 'test/msgs_spec/test_rotations.py'
    result = colcon(workspace, 'test', '--return-code-on-test-failure', '--pytest-args', file)
    assert result.returncode == 0, result.stdout + result.stderr
    report = ElementTree.parse(workspace / 'build' / PACKAGE / 'pytest.xml').getroot()
    suite = report if report.tag == 'testsuite' else report.find('testsuite')
    counts = {name: int(suite.get(name)) for name in ('tests', 'failures', 'errors', 'skipped')}
    command = [sys.executable, '-m', 'pytest', '--collect-only', '-q', file]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    expected = listing.count('::')
    assert expected > 5
    assert counts == {'tests': expected, 'failures': 0, 'errors': 0, 'skipped': 0}


def test_colcon_test_collects_every_module(workspace):
    """Beside the pytest plugin of `launch_testing`, and without optional libraries."""
    plugin = ('-p', 'support.launch_testing_collection')
    arguments = ('--collect-only', '-q', *plugin, '-m', 'release or not release')
    shown = ('--event-handlers', 'console_direct+')
    output = colcon(workspace, 'test', *shown, '--pytest-args', *arguments).stdout
    collected = set(re.findall(r'^(test/\S+?\.py)::', output, re.MULTILINE))
    skipped = set(re.findall(r'^SKIPPED .* (test/\S+?\.py):\d+: could not', output, re.MULTILINE))
    modules = {name for name in tracked_files() if re.fullmatch(r'test/.*test_\w+\.py', name)}
    assert modules - collected == skipped, output[-2000:]
    assert 'test/policy_node/policies/test_foreign_actors.py' in skipped
    assert len(skipped) < 10


def test_installed_sim_node_runs_an_episode(
    prefix, start_process, ros_environment, monkeypatch, tmp_path
):
    """With the installed parameter file, as a user starts it, and as fast as it goes."""
    # As for a user who activated the environment: scripts start `/usr/bin/env python3`.
    monkeypatch.setitem(ros_environment, 'PATH', f'{BIN}{os.pathsep}{ros_environment["PATH"]}')
    line = (
        f'. {prefix.parent}/setup.sh && exec {prefix}/lib/{PACKAGE}/sim_node --ros-args '
        f'--params-file {prefix}/share/{PACKAGE}/config/sim_node.yaml '
        '-p task:=FetchReach -p episodes:=1 -p real_time_factor:=0.0 -p episode_dir:=episodes'
    )
    code, output = finish(start_process('sh', '-c', line, cwd=tmp_path), 60.0)
    assert code == 0, output
    (episode,) = (tmp_path / 'episodes').glob('FetchReach_*')
    assert {path.suffix for path in episode.iterdir()} == {'.mcap', '.yaml'}
