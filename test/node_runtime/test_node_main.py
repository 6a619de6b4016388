"""Where ROS puts its logs, and signals that come twice."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import pytest

from node_runtime import node_main
from node_runtime.node_main import StopSignals, find_place_for_logs


@pytest.mark.parametrize(
    ('given', 'is_moved'),
    [
        ({}, True),
        ({'HOME': ''}, True),
        ({'HOME': 'writable'}, False),
        ({'HOME': 'writable/not/there/yet'}, False),
        ({'HOME': '~'}, False),
        ({'HOME': 'locked'}, True),
        ({'HOME': 'locked', 'ROS_HOME': 'elsewhere'}, False),
        ({'ROS_LOG_DIR': 'elsewhere'}, False),
    ],
)
def test_logs_of_ros_go_where_they_can(
    given: dict[str, str], is_moved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ('writable', 'locked'):
        (tmp_path / name).mkdir()
    environment = dict(given)
    monkeypatch.chdir(tmp_path)
    if given.get('HOME') not in (None, '', '~'):
        environment['HOME'] = str(tmp_path / given['HOME'])
    before = dict(environment)
    # Root may write everywhere.
    monkeypatch.setattr(node_main.os, 'access', lambda path, mode: not str(path).endswith('locked'))
    find_place_for_logs(environment)
    added = {'ROS_LOG_DIR': tempfile.gettempdir()} if is_moved else {}
    assert environment == before | added


def test_a_second_signal_differs_from_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10.0]
    monkeypatch.setattr(node_main.time, 'monotonic', lambda: now[0])
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        stop = StopSignals()
        os.kill(os.getpid(), signal.SIGTERM)
        gives_up = stop.watch()
        assert stop.received == 'SIGTERM' and not gives_up()
        now[0] = 10.5
        os.kill(os.getpid(), signal.SIGTERM)
        assert not gives_up()
        now[0] = 12.0
        os.kill(os.getpid(), signal.SIGINT)
        assert gives_up()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
