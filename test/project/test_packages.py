"""Wheel, sdist and package.xml are complete and agree."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from importlib.metadata import packages_distributions
from pathlib import Path

import grimp
import pytest
import yaml
from catkin_pkg.package import parse_package
from test_colcon_install import tracked_files

from support import PACKAGES, ROOT

# Generated or of use in a checkout alone.
NOT_IN_SDIST = (
    '.ci/',
    '.github/',
    '.gitignore',
    '.pre-commit-config.yaml',
    '.dockerignore',
    'Dockerfile',
)

ROS = {
    'rclpy',
    'rcl_interfaces',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_msgs',
    'visualization_msgs',
}


@pytest.fixture(scope='module')
def built(tmp_path_factory) -> Path:
    """A folder with wheel and sdist, built from what git tracks."""
    source, target = tmp_path_factory.mktemp('source'), tmp_path_factory.mktemp('dist')
    for name in tracked_files():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    build = 'from setuptools.build_meta import *; build_sdist({0!r}); build_wheel({0!r})'
    command = [sys.executable, '-c', build.format(str(target))]
    result = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return target


@pytest.fixture(scope='module')
def wheel(built: Path) -> zipfile.ZipFile:
    (path,) = built.glob('*.whl')
    assert path.name.endswith('-py3-none-any.whl')
    return zipfile.ZipFile(path)


@pytest.fixture(scope='module')
def metadata(wheel: zipfile.ZipFile):
    (name,) = (name for name in wheel.namelist() if name.endswith('.dist-info/METADATA'))
    return Parser().parsestr(wheel.read(name).decode())


def test_the_wheel_holds_the_packages_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    names = {
        name for name in wheel.namelist() if '.dist-info/' not in name and '.data/' not in name
    }
    wanted = {
        name
        for name in tracked_files()
        if name.split('/')[0] in PACKAGES and not name.endswith('.training.safetensors')
    }
    assert names == wanted


def test_the_sdist_holds_all_that_is_tracked(built: Path) -> None:
    (path,) = built.glob('*.tar.gz')
    with tarfile.open(path) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    missing = set(tracked_files()) - names
    allowed = (*NOT_IN_SDIST, 'policy_node/actors/')
    forgotten = {name for name in missing if not name.startswith(allowed)}
    assert not forgotten, f'MANIFEST.in does not name {sorted(forgotten)}'
    left_out = {name for name in missing if name.startswith('policy_node/actors/')}
    assert all(name.endswith('.training.safetensors') for name in left_out)


def test_the_metadata_are_complete_and_the_base_installation_is_small(metadata) -> None:
    assert metadata['Requires-Python'] == '>=3.11'
    assert metadata['Description-Content-Type'] == 'text/markdown'
    assert metadata.get_payload().startswith('# fetch_hand_sim')
    assert metadata.get_all('Project-URL') and len(metadata.get_all('Classifier')) > 5
    base = [each for each in metadata.get_all('Requires-Dist') if 'extra ==' not in each]
    heavy = ('torch', 'pyarrow', 'tensorboard', 'matplotlib', 'ray', 'ros-jazzy', 'onnx', 'stable')
    assert base and not [each for each in base if each.startswith(heavy)]


def imported_packages() -> set[str]:
    """Top-level names of what the sources import, wherever in them."""
    graph = grimp.build_graph(*PACKAGES, include_external_packages=True, cache_dir=None)
    return {name.partition('.')[0] for name in graph.modules}


def test_everything_that_is_imported_is_required(metadata) -> None:
    """Not left to what another package happens to bring along."""
    # MuJoCo's own backend of that name, and what works without it.
    names = imported_packages() - {'glfw', *ROS}
    owners = {name: set(found) for name, found in packages_distributions().items()}
    required = {re.match(r'[\w.-]+', each)[0].lower() for each in metadata.get_all('Requires-Dist')}
    missing = {
        name
        for name in names & set(owners) - {*PACKAGES, *sys.stdlib_module_names}
        if not {each.lower().replace('_', '-') for each in owners[name]} & required
    }
    assert not missing


def test_package_xml_names_every_ros_package_that_is_imported() -> None:
    depends = {each.name for each in parse_package(ROOT / 'package.xml').build_depends}
    assert imported_packages() & ROS <= depends


def test_all_versions_are_one(metadata) -> None:
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    versions = {metadata['Version'], parse_package(ROOT / 'package.xml').version}
    assert versions == {citation['version']}
    news, *releases = (ROOT / 'CHANGELOG.md').read_text().split('\n## [')[1:]
    (version,) = (tuple(map(int, each.split('.'))) for each in versions)
    released = tuple(map(int, releases[0].partition(']')[0].split('.')))
    assert news.startswith('Unreleased]'), 'where what comes next is written down'
    assert version > released if '- ' in news else version == released


def test_package_xml_is_valid_and_agrees_with_setup_py(metadata) -> None:
    warnings: list[str] = []
    package = parse_package(ROOT / 'package.xml', warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3 and package.urls
    (license_,) = package.licenses
    assert (package.name, license_.file) == (metadata['Name'], 'LICENSE')
    assert str(license_) == (metadata['License-Expression'] or metadata['License'])
    assert 'Apache License' in (ROOT / 'LICENSE').read_text()


def test_hooks_run_the_checks_of_make_lint_and_hosted_checks_make_test() -> None:
    """The same tools over the same files: a commit that passes the hooks passes `make lint`."""
    hooks = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text())['repos'][0]['hooks']
    commands = subprocess.run(
        ['make', '--dry-run', 'lint', 'PYTHON_FILES='], cwd=ROOT, capture_output=True, text=True
    ).stdout.splitlines()
    linted = [line.split('-m ')[1].rstrip() for line in commands if ' -m ' in line]
    assert [hook['entry'].split('-m ')[1] for hook in hooks] == linted
    workflow = yaml.safe_load((ROOT / '.github/workflows/test.yml').read_text())
    steps = workflow['jobs']['test']['steps']
    assert [step['run'] for step in steps if 'run' in step] == ['make test']


def test_an_old_python_is_refused_by_name(tmp_path: Path) -> None:
    code = 'import sys, setuptools\nsys.version_info, sys.version = (3, 10, 13), "3.10.13 (main)"\n'
    setup = (ROOT / 'setup.py').read_text()
    result = subprocess.run(
        [sys.executable, '-c', code + setup], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 1
    assert result.stderr == 'fetch_hand_sim needs Python 3.11 or newer; this is 3.10.13\n'
