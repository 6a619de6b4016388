"""Imports go one way, and what a package loads when it is imported."""

from __future__ import annotations

import subprocess
import sys

import pytest

from support import ROOT

SIMULATION = ('fetch_hand_sim', 'mujoco', 'gymnasium')
TRAINING = 'policy_node.training'
# The shells on the ROS graph; all else runs without ROS.
NODES = (
    'fetch_hand_sim.replay_node',
    'fetch_hand_sim.sim_node',
    'fetch_hand_sim.view.live',
    'fetch_hand_sim.view.live_session',
    'fetch_hand_sim.view.robot_requests',
    'fetch_hand_sim.visualization_node.messages',
    'fetch_hand_sim.visualization_node.node',
    'fetch_hand_sim.watch.replay_watch',
    'fetch_hand_sim.watch.robot_watch',
    'policy_node.node',
)
# Imports only what the user has installed.
ADAPTER = 'fetch_hand_sim.gym_envs.stable_baselines3'


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


def test_modules_import_only_what_the_contracts_allow():
    found = _run(
        sys.executable, '-m', 'importlinter.cli', '--no-cache', str(ROOT / '.importlinter')
    )
    assert found.returncode == 0, found.stdout


def _loaded_by(package: str, without: tuple[str, ...]) -> set[str]:
    """Top-level modules of a fresh interpreter that imported a package, but not `without`."""
    files = sorted((ROOT / package).rglob('*.py'))
    parts = [file.relative_to(ROOT).with_suffix('').parts for file in files]
    names = ['.'.join(each[:-1] if each[-1] == '__init__' else each) for each in parts]
    left = [n for n in names if not f'{n}.'.startswith(tuple(f'{each}.' for each in without))]
    modules = [name for name in left if not name.endswith('.__main__')]
    code = (
        'import importlib, sys\n'
        f'for name in {modules!r}: importlib.import_module(name)\n'
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    result = _run(sys.executable, '-c', code)
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


@pytest.mark.parametrize(
    ('package', 'without', 'expected', 'absent'),
    [
        ('msgs_spec', (), (), ('node_runtime', 'policy_node', 'torch', 'rclpy', *SIMULATION)),
        ('fetch_hand_sim', (ADAPTER,), ('msgs_spec', 'mujoco', 'rclpy'), ('policy_node', 'torch')),
        ('fetch_hand_sim', (ADAPTER, *NODES), ('mujoco',), ('rclpy',)),
        ('policy_node', (TRAINING,), ('torch', 'rclpy'), SIMULATION),
        ('policy_node', NODES, ('torch', 'fetch_hand_sim'), ('rclpy',)),
    ],
)
def test_importing_a_package_loads_nothing_of_other_layers(package, without, expected, absent):
    loaded = _loaded_by(package, without)
    assert {package, *expected} <= loaded
    assert loaded.isdisjoint(absent)
