"""`fetch_hand_sim demo`, real nodes and all, until somebody has seen enough."""

from __future__ import annotations

import signal
import sys

import pytest

from fetch_hand_sim.episode_log import read_summary


@pytest.mark.parametrize(('number', 'code'), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_demo_logs_episodes_and_stops_in_order(number, code, start_process, tmp_path):
    command = [sys.executable, '-m', 'fetch_hand_sim', 'demo', '--policy', 'resting']
    demo = start_process(*command, '--episodes', '100', cwd=tmp_path)
    assert demo.stdout.readline().split() == [
        'episode',
        'seed',
        'steps',
        'return',
        'success',
        'file',
    ]
    row = demo.stdout.readline().split()
    assert row[:4] == ['0', '0', '50', '-50']
    demo.send_signal(number)
    output, errors = demo.communicate(timeout=30)
    assert (demo.returncode, errors) == (code, 'demo: stopping\n')
    assert 'FetchReach: ' in output and 'episodes succeeded' in output
    paths = sorted((tmp_path / 'episodes').iterdir())
    assert read_summary(paths[0]).is_complete
    # The robot had time to close what it was logging.
    assert not [path for path in paths if path.name.startswith('.')]
