"""A private ROS graph for the whole run, and processes that never outlive their test."""

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

# Low domains are what people set by hand; above 101 the ports of DDS meet Linux' ephemeral ones.
DOMAINS = range(40, 102)


def reserve_domain() -> tuple[int, socket.socket]:
    """Returns a ROS domain nobody else tests in; it is reserved while the socket is open."""
    for domain in DOMAINS:
        lock = socket.socket()
        try:
            lock.bind(('', DOMAIN_LOCK_PORT + domain))
            return domain, lock
        except OSError:
            lock.close()
    raise RuntimeError(f'no free ROS domain among {DOMAINS.start} ... {DOMAINS.stop - 1}')


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds what `make twin` and `make torture` turn up."""
    parser.addoption(
        '--twin-seeds',
        type=int,
        default=2,
        help='seeds per task in the comparison with Gymnasium-Robotics (default: 2)',
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
    """Sets the environment of ROS before any message class is imported; children inherit it."""
    # A shell starts what runs in the background with SIGINT ignored, and children inherit that.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # So does `nohup` with SIGHUP. It stays ignored here; a handler is nothing that is inherited.
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
    """The seeds of the comparison with Gymnasium-Robotics."""
    return range(pytestconfig.getoption('--twin-seeds'))


@pytest.fixture(scope='session')
def hostile_count(pytestconfig: pytest.Config) -> int:
    """How many random messages a hostile test sends."""
    return int(pytestconfig.getoption('--hostile-messages'))


@pytest.fixture(scope='session')
def soak_seconds(pytestconfig: pytest.Config) -> float:
    """How long memory is watched."""
    return float(pytestconfig.getoption('--soak-seconds'))


@pytest.fixture
def ros_environment() -> dict[str, str]:
    """A copy of the environment nodes are started with, for a test to add to."""
    return os.environ | {'PYTHONUNBUFFERED': '1'}


@pytest.fixture
def node() -> Iterator[Node]:
    """A node of this process, in a context of rclpy that ends with the test."""
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
    """Starts processes with text pipes; what still runs after the test is killed with its children.

    Takes the command, then the keyword arguments of `subprocess.Popen`.
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
