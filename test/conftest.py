"""A private ROS graph for each run, and processes that end with their test."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from support.run_guard import DOMAIN_LOCK_PORT, start_guard

if TYPE_CHECKING:
    from rclpy.node import Node

# Users set low domains by hand; ports of domains above 101 overlap Linux' ephemeral ports.
DOMAINS = range(40, 102)


def reserve_domain() -> tuple[int, socket.socket]:
    """Return a free ROS domain, which stays reserved while the socket is open."""
    for domain in DOMAINS:
        lock = socket.socket()
        try:
            lock.bind(('', DOMAIN_LOCK_PORT + domain))
            return domain, lock
        except OSError:
            lock.close()
    raise RuntimeError(f'no free ROS domain among {DOMAINS.start} ... {DOMAINS.stop - 1}')


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that `make twin` and `make torture` raise."""
    parser.addoption(
        '--twin-seeds',
        type=int,
        default=1,
        help='seeds per task in the comparison with Gymnasium-Robotics (default: 1)',
    )
    parser.addoption(
        '--hostile-messages',
        type=int,
        default=2000,
        help='random messages per hostile test; `make torture` sends 100,000 (default: 2000)',
    )
    parser.addoption(
        '--soak-seconds',
        type=float,
        default=6.0,
        help='how long memory is watched at 20x; `make torture` takes an hour (default: 6)',
    )


def pytest_configure(config: pytest.Config) -> None:
    """Set the environment of ROS before message classes are imported; children inherit it."""
    # Shells start background processes with SIGINT ignored, which children inherit.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # So does `nohup` with SIGHUP. Children do not inherit a handler.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)
    domain, lock = reserve_domain()
    log_directory = tempfile.mkdtemp(prefix='ros_log_')
    start_guard(lock, log_directory)
    os.environ.update(
        ROS_DOMAIN_ID=str(domain),
        ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
        # Off by default since Iron: without it a wrong type in a message field passes silently.
        ROS_PYTHON_CHECK_FIELDS='1',
        ROS_LOG_DIR=log_directory,
    )
    for variable in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
        os.environ.pop(variable, None)


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    """Override the hook of ROS's `launch_testing`, which imports every module in its folder's name.

    With that hook, a module that skips itself or fails to import ends the collection of its folder.
    """
    return pytest.Module.from_parent(parent, path=module_path)


@pytest.fixture(scope='session')
def twin_seeds(pytestconfig: pytest.Config) -> range:
    """Seeds of the comparison with Gymnasium-Robotics."""
    return range(pytestconfig.getoption('--twin-seeds'))


@pytest.fixture(scope='session')
def hostile_count(pytestconfig: pytest.Config) -> int:
    """Number of random messages in a hostile test."""
    return int(pytestconfig.getoption('--hostile-messages'))


@pytest.fixture(scope='session')
def soak_seconds(pytestconfig: pytest.Config) -> float:
    """Seconds for which memory is measured."""
    return float(pytestconfig.getoption('--soak-seconds'))


@pytest.fixture
def ros_environment() -> dict[str, str]:
    """A copy of the environment of nodes, which a test may extend."""
    return os.environ | {'PYTHONUNBUFFERED': '1'}


@pytest.fixture
def node() -> Iterator[Node]:
    """A node in this process; its rclpy context ends with the test."""
    import rclpy

    rclpy.init()
    node = rclpy.create_node('tested')
    yield node
    node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def start_process(
    ros_environment: dict[str, str],
) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return a function that starts a process with text pipes, like `subprocess.Popen`.

    After the test, running processes are killed with their children.
    """
    started: list[subprocess.Popen[str]] = []

    def start(*command: object, **options: object) -> subprocess.Popen[str]:
        defaults = {
            'env': ros_environment,
            'stdout': subprocess.PIPE,
            'stderr': subprocess.PIPE,
            'text': True,
            'start_new_session': True,
        }
        process = subprocess.Popen([str(part) for part in command], **(defaults | options))
        started.append(process)
        return process

    yield start
    for process in started:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        process.communicate()
