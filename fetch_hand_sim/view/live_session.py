"""Shows a running robot; starts one where there is none and a task is given."""

from __future__ import annotations

import argparse
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

import rclpy
from rclpy.node import Node

from fetch_hand_sim.commands.executables import is_actor_shipped
from fetch_hand_sim.commands.node_processes import open_log, start_nodes, stop_node
from fetch_hand_sim.view.attendance import Attendance
from fetch_hand_sim.view.frame_rate import FrameRate
from fetch_hand_sim.view.live import LiveRobot
from fetch_hand_sim.view.page.page import Page
from fetch_hand_sim.view.requests import LatestRequest, Request
from fetch_hand_sim.view.session import Requests, Session
from fetch_hand_sim.view.web import announce, open_page
from msgs_spec.tasks import TaskSpec
from node_runtime.command_line import UsageError
from node_runtime.event_loop import EventLoop
from node_runtime.node_main import (
    NodeFailure,
    StopSignals,
    destroy,
    run_node,
)
from node_runtime.ros import DISCOVERY_TIME, count_publishers

NODE_NAME = 'view'
_FRAME_TIME = 1.0 / 60.0
# Messages between two pictures: those of a replay at 40 times its speed, and 30 ms at most.
_SERVED_FIRST = 1000
# The page never takes a processor that the robot wants.
_NICENESS = 10
_LAST_LINES = 5
_CLOCK = '/clock'


def run_live(options: argparse.Namespace) -> int:
    """Runs until the user ends it; returns the exit code."""
    return run_node(NODE_NAME, lambda stop: _run(options, stop), options.ros_arguments)


def _run(options: argparse.Namespace, stop: StopSignals) -> None:
    with ExitStack() as stack:
        node = rclpy.create_node(NODE_NAME, namespace=options.robot)
        stack.callback(destroy, node)
        robot = LiveRobot(node, may_command=not options.read_only)
        loop = EventLoop(node)
        stack.callback(loop.close)
        attendance = Attendance()
        plugins = [Page(), Requests(_attended(robot, attendance))]
        frame_rate = FrameRate(lambda: robot.picture_period)
        handle, address = open_page(options.host, options.port, plugins, frame_rate, attendance)
        stack.callback(handle.close)
        nodes = stack.enter_context(_nodes(options, node, robot, loop, stop))
        if stop:
            return
        _give_way()
        announce(address, options.browser)
        session = Session(handle, robot)
        while not stop and all(process.poll() is None for process in nodes):
            if not attendance.is_there:
                robot.leave()
            _serve(session, frame_rate, loop)


def _attended(
    robot: LiveRobot, attendance: Attendance
) -> Callable[[Request | LatestRequest], None]:
    """Passes on to a robot what is asked for while somebody is at the page.

    The page is drawn, and goes on asking for what was held, as long as it is connected.
    """

    def perform(request: Request | LatestRequest) -> None:
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
) -> Iterator[list[subprocess.Popen[str]]]:
    """Finds a robot, or starts one with its actor and ends both afterwards."""
    patience = DISCOVERY_TIME if options.task else options.wait
    _wait_for_robot(robot, loop, stop, patience)
    if robot.spec is not None:
        _check_is_wanted(options, robot.spec, node.get_namespace())
    if robot.spec is not None or stop:
        yield []
    elif options.task is None:
        raise NodeFailure(_nobody(node))
    else:
        with open_log('view') as log:
            started = _start(options, node, log)
            try:
                yield started
                _check_alive(started, log, stop)
            finally:
                for process in started:
                    stop_node(process)


def _wait_for_robot(robot: LiveRobot, loop: EventLoop, stop: StopSignals, seconds: float) -> None:
    end = time.monotonic() + seconds
    while robot.spec is None and not stop and time.monotonic() < end:
        loop.wait(_FRAME_TIME)


def _check_is_wanted(options: argparse.Namespace, spec: TaskSpec, where: str) -> None:
    """Raises why the robot that runs is not what was asked for."""
    if options.task not in (None, spec.name):
        raise NodeFailure(f'a robot in {where} runs already and does {spec.name}')
    if options.for_a_start:
        raise UsageError(
            f'a robot in {where} runs already and does {spec.name}: {options.for_a_start} would '
            'change nothing; leave that out, or end the robot first'
        )


def _nobody(node: Node) -> str:
    """What to say where no robot answers."""
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


def _start(options: argparse.Namespace, node: Node, log: IO[str]) -> list[subprocess.Popen[str]]:
    policy = options.policy or options.task
    if not options.policy and not is_actor_shipped(options.task):
        print(f'No actor is shipped for {options.task} yet: commands are random.', flush=True)
        policy = 'random'
    settings: dict[str, object] = {'task': options.task, 'wait_for_commands': True}
    if options.episode_dir:
        settings['episode_dir'] = str(Path(options.episode_dir))
    # While a robot was looked for, everybody else was found too.
    if count_publishers(node, _CLOCK):
        print('/clock comes from another robot: this one does not publish it.', flush=True)
        settings['publish_clock'] = False
    # Of `--robot` or of `--ros-args`.
    namespace = node.get_namespace()
    return start_nodes(
        {'policy_node': {'policy': str(policy)}, 'sim_node': settings}, log, namespace
    )


def _check_alive(nodes: list[subprocess.Popen[str]], log: IO[str], stop: StopSignals) -> None:
    """Raises what a node said before it ended by itself."""
    ended = [node for node in nodes if node.poll() is not None]
    if ended and not stop:
        lines = Path(log.name).read_text(errors='replace').strip().splitlines()[-_LAST_LINES:]
        raise NodeFailure(f'a node ended with exit code {ended[0].poll()}: {" / ".join(lines)}')


def _give_way() -> None:
    """Lowers the priority of every thread of this process, but not of the nodes it has started."""
    # Linux has a priority for each thread; those that are started later take after their parents.
    for thread in os.listdir('/proc/self/task'):
        with suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, int(thread), _NICENESS)


def _serve(session: Session, frame_rate: FrameRate, loop: EventLoop) -> None:
    """Shows what is new, and then lets the time of a picture pass."""
    is_new = session.update()
    # Asleep, not waiting for messages: a robot in lockstep sends thousands a second.
    time.sleep(frame_rate.period() if is_new else _FRAME_TIME)
    loop.serve_pending(_SERVED_FIRST)
