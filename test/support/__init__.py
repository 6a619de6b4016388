"""Helpers of the tests, and where things are."""

from __future__ import annotations

import os
from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
ROOT = SUPPORT.parents[1]


def script_environment(environment: dict[str, str] | None = None) -> dict[str, str]:
    """The environment in which a script of this folder finds this folder and the packages."""
    paths = os.pathsep.join(str(path) for path in (ROOT, SUPPORT.parent))
    return dict(os.environ if environment is None else environment) | {'PYTHONPATH': paths}


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
