"""A killed test run leaves no node behind and releases its ROS domain."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from support import ROOT, is_running, script_environment, wait_until
from support.run_guard import DOMAIN_LOCK_PORT, processes_of

# A test that starts a demo, which starts nodes in sessions of their own.
TEST = """
import os, sys, time

def test_for_ever(start_process):
    command = (sys.executable, '-m', 'fetch_hand_sim', 'demo', '--episodes', '100')
    start_process(*command, cwd={folder!r})
    print(os.environ['ROS_DOMAIN_ID'], os.environ['ROS_LOG_DIR'], flush=True)
    time.sleep(600)
"""


def is_reserved(domain: int) -> bool:
    with socket.socket() as lock:
        try:
            lock.bind(('', DOMAIN_LOCK_PORT + domain))
        except OSError:
            return True
    return False


@pytest.mark.release
def test_a_killed_run_takes_its_nodes_along(tmp_path):
    test = tmp_path / 'test_for_ever.py'
    test.write_text(TEST.format(folder=str(tmp_path)))
    command = [sys.executable, '-m', 'pytest', '-s', '-q', '-p', 'conftest', str(test)]
    options = [f'--rootdir={tmp_path}', '-c', os.devnull]
    run = subprocess.Popen(
        command + options,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=script_environment(),
    )
    try:
        words = run.stdout.readline().split()
        domain, log_directory = int(words[0]), words[1]
        # The demo, the robot and its policy.
        wait_until(lambda: len(processes_of(log_directory)) >= 3, 'demo with its nodes')
        started = processes_of(log_directory)
        assert is_reserved(domain)
    finally:
        run.send_signal(signal.SIGKILL)
        run.communicate()
    wait_until(lambda: not any(is_running(process) for process in started), 'end of the nodes')
    wait_until(lambda: not is_reserved(domain), 'free domain')
    wait_until(lambda: not Path(log_directory).exists(), 'end of the folder of logs')
