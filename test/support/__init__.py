"""Helpers of the tests, and where things are."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
ROOT = SUPPORT.parents[1]
PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')


def script_environment() -> dict[str, str]:
    """Return an environment in which a process finds this folder and the packages."""
    paths = os.pathsep.join(str(path) for path in (ROOT, SUPPORT.parent))
    return os.environ | {'PYTHONPATH': paths}


def reset_peak_memory() -> None:
    """Lets `peak_memory` count from now on: earlier tests may have held more."""
    Path('/proc/self/clear_refs').write_text('5')


def peak_memory() -> int:
    """Most memory this process has held since its program or the last reset, bytes.

    Not `ru_maxrss`: that of a process starts at what its parent held when it was forked.
    """
    status = Path('/proc/self/status').read_text()
    (line,) = (line for line in status.splitlines() if line.startswith('VmHWM'))
    return int(line.split()[1]) * 1024


def wait_until(condition: Callable[[], object], what: str, seconds: float = 30.0) -> None:
    """Waits for a condition; fails with `what` was awaited."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f'no {what} within {seconds} s'
        time.sleep(0.02)


def stat_of(process: int) -> list[str]:
    """State, parent, group, session and what follows of a process; empty if it is gone."""
    try:
        return Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    except OSError:
        return []


def is_running(process: int) -> bool:
    return stat_of(process)[:1] not in ([], ['Z'])


def running_processes() -> list[int]:
    return [int(path.name) for path in Path('/proc').glob('[0-9]*') if is_running(int(path.name))]
