"""Show a running robot on a page; with `--task`, start a robot and a policy if none runs."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

import rclpy
from rclpy.node import Node

from fetch_hand_sim.commands.node_processes import (
    open_log,
    policy_or_default,
    start_nodes,
    stop_node,
)
from fetch_hand_sim.view.guard import Attendance
from fetch_hand_sim.view.live import LiveRobot
from fetch_hand_sim.view.page.page import Page
from fetch_hand_sim.view.requests import Request
from fetch_hand_sim.view.session import Perform, Requests, Session
from fetch_hand_sim.view.web import FrameRate, announce, open_page
from msgs_spec.tasks import TaskSpec
from node_runtime.command_line import UsageError
from node_runtime.event_loop import EventLoop
from node_runtime.node_main import NodeFailure, StopSignals, destroy, run_node
from node_runtime.ros import DISCOVERY_TIME, count_publishers

NODE_NAME = 'view'
Nodes = Mapping[str, subprocess.Popen[str]]
_FRAME_TIME = 1.0 / 60.0
# Messages between two pictures: a replay at 40 times its speed publishes so many.
_SERVED_FIRST = 1000
_NICENESS = 10
_LAST_LINES = 5
_CLOCK = '/clock'


def run_live(options: argparse.Namespace) -> int:
    """Show a robot until the user ends the program; return the exit code."""
    return run_node(NODE_NAME, lambda stop: _run(options, stop), options.ros_arguments)


def _run(options: argparse.Namespace, stop: StopSignals) -> None:
    with ExitStack() as stack:
        node = rclpy.create_node(NODE_NAME, namespace=options.robot)
        stack.callback(destroy, node)
        robot = LiveRobot(node, may_command=not options.read_only)
        loop = EventLoop(node)
        stack.callback(loop.close)
        attendance = Attendance()
        plugins = [Page(), Requests(attended(robot, attendance))]
        frame_rate = FrameRate(lambda: robot.picture_period)
        handle, address = open_page(
            options.host, options.port, plugins, frame_rate, attendance, options.read_only
        )
        # The page shows the error that ends this block.
        stack.push(handle)
        nodes = stack.enter_context(_nodes(options, node, robot, loop, stop))
        if stop:
            return
        _give_way()
        announce(address, options.browser)
        session = Session(handle, robot.picture)
        while not stop and all(process.poll() is None for process in nodes.values()):
            if attendance.has_left():
                robot.leave()
            is_new = session.update()
            # Do not wait for messages: a robot in lockstep publishes thousands a second.
            time.sleep(frame_rate.period() if is_new else _FRAME_TIME)
            loop.serve_pending(_SERVED_FIRST)


def attended(robot: LiveRobot, attendance: Attendance) -> Perform:
    """Return a function that passes requests to a robot while the page in control is in use.

    It drops requests if this page has been silent for 3 s, because a button held on a hidden or
    disconnected page would repeat its request.
    """

    def perform(request: Request) -> None:
        if attendance.is_there:
            robot.perform(request)

    return perform


@contextmanager
def _nodes(
    options: argparse.Namespace,
    node: Node,
    robot: LiveRobot,
    loop: EventLoop,
    stop: StopSignals,
) -> Iterator[Nodes]:
    """Wait for a robot, or start one with a policy; yield the started processes by node name.

    The mapping is empty if a robot already runs. The end of the context stops the processes.

    Raises:
        NodeFailure: If no fitting robot is found, or a started process has ended.
        UsageError: If a robot already runs, but `--policy` or `--episode-dir` is given.
    """
    end = time.monotonic() + (DISCOVERY_TIME if options.task else options.wait)
    while robot.spec is None and not stop and time.monotonic() < end:
        loop.wait(_FRAME_TIME)
    if robot.spec is not None:
        _check_is_wanted(options, robot.spec, node.get_namespace())
    if robot.spec is not None or stop:
        yield {}
    elif options.task is None:
        raise NodeFailure(_no_robot(node))
    else:
        with open_log('view') as log:
            started = _start(options, node, log)
            try:
                yield started
                if not stop:
                    check_alive(started, log)
            finally:
                for process in started.values():
                    stop_node(process)


def _check_is_wanted(options: argparse.Namespace, spec: TaskSpec, where: str) -> None:
    """Check that the running robot fits the options; `where` is its namespace.

    Raises:
        NodeFailure: If the robot has another task than `options.task`.
        UsageError: If `--policy` or `--episode-dir` is given: the running robot cannot use them.
    """
    if options.task not in (None, spec.name):
        raise NodeFailure(f'a robot in {where} runs already and does {spec.name}')
    if options.for_a_start:
        raise UsageError(
            f'a robot in {where} runs already and does {spec.name}: {options.for_a_start} would '
            'change nothing; leave that out, or end the robot first'
        )


def _no_robot(node: Node) -> str:
    """Return the error message for a namespace without a robot, with hints."""
    suffix = '/episode_status'
    topics = (name for name, _ in node.get_topic_names_and_types() if name.endswith(suffix))
    found = sorted(
        name.removesuffix(suffix) or '/' for name in topics if node.count_publishers(name)
    )
    hint = (
        f'robots found: {", ".join(found)} (--robot chooses)'
        if found
        else ('start sim_node, or both with: view --task FetchReach')
    )
    return f'no robot in namespace {node.get_namespace()}; {hint}'


def _start(options: argparse.Namespace, node: Node, log: IO[str]) -> Nodes:
    policy = policy_or_default(options.policy, options.task)
    settings: dict[str, object] = {'task': options.task, 'wait_for_commands': True}
    if options.episode_dir:
        settings['episode_dir'] = options.episode_dir
    if count_publishers(node, _CLOCK):
        print('/clock comes from another robot: this one does not publish it.', flush=True)
        settings['publish_clock'] = False
    # The namespace may come from `--robot` or from `--ros-args`.
    nodes: dict[str, dict[str, object]] = {
        'policy_node': {'policy': policy, 'trust': options.trust},
        'sim_node': settings,
    }
    # At level info, a line for each episode would fill the disk for days.
    quiet = '--log-level', 'warn'
    return dict(zip(nodes, start_nodes(nodes, log, node.get_namespace(), *quiet), strict=True))


def check_alive(nodes: Nodes, log: IO[str]) -> None:
    """Raise NodeFailure if a started node has ended; its message ends with problems from `log`."""
    for name, process in nodes.items():
        code = process.poll()
        if code is not None:
            lines = Path(log.name).read_text(errors='replace').strip().splitlines()
            problems = [line for line in lines if '[INFO]' not in line][-_LAST_LINES:]
            output = f': {" / ".join(problems)}' if problems else ''
            cause = f'ended with exit code {code}'
            if code < 0:
                cause = f'was killed by {signal.Signals(-code).name}'
            raise NodeFailure(f'{name} {cause}{output}')


def _give_way() -> None:
    """Set the niceness of this process to 10; the nodes it has started keep theirs."""
    # On Linux each thread has a priority, which new threads inherit.
    for thread in os.listdir('/proc/self/task'):
        with suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, int(thread), _NICENESS)
