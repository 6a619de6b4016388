"""Kill the processes of a test run when the run ends, and hold its ROS domain until then.

Nodes outlive a killed run and would answer the tests of the next run in their domain. A guard
process therefore holds the lock of the domain, waits for the end of the run, and kills every
process whose environment contains the log directory of the run.

    python run_guard.py LOG_DIRECTORY  <a pipe whose other end only the run has
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

# The port of `domain_coordinator` (ament_cmake_ros), so that its users avoid these domains.
DOMAIN_LOCK_PORT = 32768


def start_guard(lock: socket.socket, log_directory: str) -> None:
    """Start a guard of this process.

    Args:
        lock: Socket that reserves the domain of this run while a process has it open.
        log_directory: ROS_LOG_DIR of the processes of this run; the guard removes it.
    """
    # The write end stays open until this process ends; other programs do not inherit it.
    read_end, _ = os.pipe()
    subprocess.Popen(
        [sys.executable, '-S', '-E', __file__, log_directory],
        stdin=read_end,
        # A reader of the run's output must not wait for the guard.
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={},
        start_new_session=True,
        pass_fds=[lock.fileno()],
    )
    os.close(read_end)
    lock.close()


def processes_of(log_directory: str) -> list[int]:
    """The processes that were started with this ROS_LOG_DIR and still run."""
    mark = f'ROS_LOG_DIR={log_directory}'.encode()
    found = []
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            if mark in (entry / 'environ').read_bytes().split(b'\0'):
                found.append(int(entry.name))
        except OSError:
            continue  # It has ended, or is another user's.
    return found


def main() -> None:
    """Waits for the end of the run, then clears up after it."""
    (log_directory,) = sys.argv[1:]
    sys.stdin.buffer.read()
    while left := processes_of(log_directory):
        for process in left:
            try:
                os.kill(process, signal.SIGKILL)
            except OSError:
                continue
        time.sleep(0.05)
    shutil.rmtree(log_directory, ignore_errors=True)


if __name__ == '__main__':
    main()
