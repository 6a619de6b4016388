"""Robots that `view` starts: whether it should, beside which others, and how they end with it."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from msgs_spec.tasks import task_spec
from support import is_running, running_processes, stat_of, wait_until
from support.graph import SIM_NODE, VIEW, Start, client, finish, open_view, ros_args

REACH = task_spec('FetchReach')


def children_of(parent: int) -> list[int]:
    return [each for each in running_processes() if stat_of(each)[1:2] == [str(parent)]]


@pytest.mark.parametrize(('number', 'is_loaded'), [(signal.SIGKILL, False), (signal.SIGHUP, True)])
def test_the_nodes_end_with_their_parent(
    start_process: Start, number: signal.Signals, is_loaded: bool
) -> None:
    view, *_ = open_view(start_process, '--task', 'FetchReach')
    nodes = children_of(view.pid)
    assert len(nodes) == 2
    if is_loaded:
        with client(REACH) as connection:
            connection.subscribe('reward')
            connection.spin_until(lambda: connection.received['reward'], 'step')
        # The nodes share a log file, to which each episode would add a line.
        assert '[INFO]' not in Path(f'/proc/{nodes[0]}/fd/1').read_text()
    view.send_signal(number)
    code, output = finish(view)
    assert code == (-signal.SIGKILL if number == signal.SIGKILL else 0), output
    wait_until(lambda: not any(map(is_running, nodes)), 'end of the nodes')


def test_ctrl_c_while_a_robot_is_looked_for_announces_no_page(start_process: Start) -> None:
    view = start_process(*VIEW, '--wait', '60')
    with client(REACH) as connection:
        connection.spin_until(lambda: 'view' in connection.node.get_node_names(), 'viewer')
    view.send_signal(signal.SIGINT)
    assert finish(view) == (0, '')


def test_what_a_running_robot_would_not_do_is_refused(start_process: Start, tmp_path: Path) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    given = ['--task', 'FetchReach', '--policy', 'nosuch', '--episode-dir', str(tmp_path / 'there')]
    with client(REACH) as connection:
        connection.subscribe('episode_status')
        connection.spin_until(lambda: connection.received['episode_status'], 'robot')
    code, output = finish(start_process(*VIEW, *given))
    assert (code, output) == (
        2,
        'view: a robot in / runs already and does FetchReach: --policy and --episode-dir would '
        'change nothing; leave that out, or end the robot first\n',
    )


@pytest.mark.release
def test_of_two_robots_in_their_namespaces_one_publishes_the_clock(start_process: Start) -> None:
    for robot, task, namespace in (
        ('left', 'FetchReach', ('--ros-args', '-r', '__ns:=/left')),
        ('right', 'HandReach', ('--robot', 'right')),
    ):
        *_, said = open_view(start_process, '--task', task, *namespace)
        assert any('/clock comes from another' in line for line in said) == (robot == 'right')
        with client(REACH) as connection:
            connection.subscribe('/diagnostics')
            name = f'/{robot}/sim_node'

            def is_well(name=name, connection=connection):
                reports = connection.reports(name)
                return len(reports) > 2 and connection.values(name)['clock publishers'] != '-'

            connection.spin_until(is_well, f'reports of {name}')
            assert connection.values(name)['commanders'] == f'/{robot}/policy_node'
            assert not connection.node.count_publishers('/episode_status')
            publishers = connection.node.get_publishers_info_by_topic('/clock')
            assert [each.node_namespace for each in publishers] == ['/left']
            for node in ('/left/sim_node', '/right/sim_node'):
                levels = {report.level for report in connection.reports(node)}
                assert DiagnosticStatus.ERROR not in levels
