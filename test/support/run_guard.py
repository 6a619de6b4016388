"""Ends with a test run what the run started, however the run ends; keeps its domain until then.

A run that is killed takes the lock of its ROS domain along, but not its nodes: in the domain of the
next run they would answer its tests. So a process of its own holds the lock, waits for the end of
the run, and kills whatever carries the run's mark in the environment it was started with: nodes,
and what commands such as `demo` start in sessions of their own.

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

# Of `domain_coordinator` (ament_cmake_ros), so its users and these runs avoid each other.
DOMAIN_LOCK_PORT = 32768


def start_guard(lock: socket.socket, log_directory: str) -> None:
    """Starts a guard of this process, which hands the lock on.

    Args:
        lock: Reserves the domain of this run while any process has it open.
        log_directory: ROS_LOG_DIR of all that this run starts, by which it is known; removed.
    """
    # The end to write stays open until this process ends, and no other program inherits it.
    read_end, _ = os.pipe()
    subprocess.Popen(
        [sys.executable, '-S', '-E', __file__, log_directory],
        stdin=read_end,
        # Whoever reads the output of the run shall not wait for its guard.
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
