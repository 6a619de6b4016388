"""Processes end in time even if a library holds the interpreter."""

from __future__ import annotations

import os
import subprocess
import sys
import time

# A library that spins: `PyDLL` does not release the lock of the interpreter.
HELD = """
import ctypes, time
from node_runtime.node_main import ends_within
print('done', flush=False)
with ends_within({limit}, {code}):
    ctypes.PyDLL(None).usleep(ctypes.c_uint({microseconds}))
print('left')
"""


def run(limit: float, code: int, held: float) -> tuple[int, str, float]:
    started = time.monotonic()
    program = HELD.format(limit=limit, code=code, microseconds=int(held * 1e6))
    ended = subprocess.run([sys.executable, '-c', program], capture_output=True, timeout=30)
    return ended.returncode, ended.stdout.decode(), time.monotonic() - started


def test_a_blocked_process_ends_with_its_own_exit_code() -> None:
    ended, output, seconds = run(0.3, 130, held=20.0)
    assert (ended, output) == (130, 'done\n')
    assert seconds < 10.0


def test_a_process_continues_after_a_body_in_time() -> None:
    assert run(0.5, 3, held=0.1)[:2] == (0, 'done\nleft\n')


def test_a_closed_output_does_not_stop_the_command() -> None:
    program = HELD.format(limit=5, code=3, microseconds=1000).replace(
        "print('left')", "open('/dev/stderr', 'w').write('left')"
    )
    held = subprocess.Popen(
        [sys.executable, '-c', f'import time; time.sleep(.5)\n{program}'],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'},
    )
    assert held.stdout is not None
    held.stdout.close()
    assert b'left' in held.communicate(timeout=30)[1]
