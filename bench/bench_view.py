"""Measure the rate of `joint_states` without viewer, with one, and with its visitors.

`make bench-view` runs it. Visitors are web sockets that receive every picture, and one that
never reads; `--browser` adds a headless Chromium on the same CPUs. In lockstep, a resting policy
answers every tick, so ticks per second measure the free CPU time. Because that varies over minutes,
the viewer is stopped (`SIGSTOP`) every other two seconds. `taskset -c 0,1 ...` leaves two CPUs.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import rclpy
from bench_rate import Watcher

from fetch_hand_sim.commands.node_processes import start_nodes, stop_node
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.topics import topic
from node_runtime.ros import keep_discovery_local

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / 'test'))

from support.visitors import DeafVisitor, Visitor  # noqa: E402

VISITORS = 3
# Seconds of a turn with the viewer or without, and before it until either is under way.
_TURN, _SETTLING = 1.6, 0.4


def open_view(stack: ExitStack) -> tuple[subprocess.Popen[str], str]:
    """Starts a viewer; returns its process and the address of its page."""
    words = [sys.executable, '-m', 'fetch_hand_sim.view', '--no-browser']
    process = subprocess.Popen(words, text=True, stdout=subprocess.PIPE)
    stack.callback(stop_node, process)
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r'http://([\w.:]+)/', line):
            return process, found[1]
    raise SystemExit('bench_view: the viewer did not start')


def measure(watcher: Watcher, label: str, seconds: float) -> None:
    """Watches a robot in real time and prints its rate."""
    watcher.start(2.0)
    watcher.watch(seconds)
    watcher.report(label)


def rate(watcher: Watcher, seconds: float) -> float:
    """Ticks per second from now on."""
    watcher.start(_SETTLING)
    began = time.monotonic()
    watcher.watch(seconds)
    return len(watcher.times) / (time.monotonic() - began)


def take_turns(watcher: Watcher, seconds: float) -> None:
    """Measures a robot in lockstep beside a viewer with visitors that runs, and that does not."""
    print(f'no viewer: {rate(watcher, seconds):.0f} ticks/s', flush=True)
    with ExitStack() as stack:
        view, address = open_view(stack)
        for number in range(VISITORS):
            stack.callback(Visitor(address, f'bench{number}').close)
        watcher.watch(2.0)
        turns = np.zeros((max(2, round(seconds / _TURN)), 2))
        for index, turn in enumerate(turns):
            # The order alternates.
            for runs in (0, 1) if index % 2 else (1, 0):
                view.send_signal(signal.SIGCONT if runs else signal.SIGSTOP)
                turn[runs] = rate(watcher, _TURN)
        view.send_signal(signal.SIGCONT)
    without, beside = turns.mean(axis=0)
    ratios = np.log(turns[:, 1] / turns[:, 0])
    error = ratios.std(ddof=1) / np.sqrt(len(ratios))
    print(
        f'{VISITORS} visitors that do not draw: {beside:.0f} ticks/s, {without:.0f} while the '
        f'viewer is stopped; of {len(turns)} pairs of turns {100.0 * np.exp(ratios.mean()):.1f} % '
        f'+- {100.0 * error:.1f} % (standard error)',
        flush=True,
    )
    print(f'no viewer any more: {rate(watcher, seconds):.0f} ticks/s', flush=True)


def compare(watcher: Watcher, seconds: float, with_browser: bool) -> None:
    """Measures without viewers, with one, its visitors, while it is stopped, and without again."""
    measure(watcher, 'no viewer', seconds)
    with ExitStack() as stack:
        view, address = open_view(stack)
        measure(watcher, 'a viewer without visitors', seconds)
        for number in range(VISITORS):
            stack.callback(Visitor(address, f'bench{number}').close)
        measure(watcher, f'{VISITORS} visitors that do not draw', seconds)
        with DeafVisitor(address):
            measure(watcher, 'and one that reads and confirms nothing', seconds)
        view.send_signal(signal.SIGSTOP)
        measure(watcher, 'a viewer that is stopped', seconds)
        view.send_signal(signal.SIGCONT)
        if with_browser:
            from support.browser import Browser

            # Last: it takes the processors that the other rows are to have.
            with closing(Browser()) as browser:
                browser.open(f'http://{address}/')
                measure(watcher, f'{VISITORS} visitors and a Chromium that draws', seconds)
    measure(watcher, 'no viewer any more', seconds)


def main() -> None:
    """Compares in real time, then in lockstep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--seconds', type=float, default=30.0, help='per measurement')
    parser.add_argument('--browser', action='store_true', help='let a Chromium draw as well')
    options = parser.parse_args()
    keep_discovery_local()
    for mode in ('realtime', 'lockstep'):
        rclpy.init()
        processors = len(os.sched_getaffinity(0))
        print(f'{options.task}, {mode}, {processors} processors', flush=True)
        with ExitStack() as stack:
            watcher = Watcher(topic(task_spec(options.task), 'joint_states'))
            # A line for every episode would bury the table.
            quiet = '--log-level', 'warn'
            nodes = {'sim_node': {'task': options.task, 'mode': mode}}
            if mode == 'lockstep':
                nodes['policy_node'] = {'policy': 'resting'}
            for process in start_nodes(nodes, sys.stderr, '', *quiet):
                stack.callback(stop_node, process)
            watcher.wait_for_ticks()
            if mode == 'lockstep':
                take_turns(watcher, options.seconds)
            else:
                compare(watcher, options.seconds, options.browser)
        rclpy.shutdown()


if __name__ == '__main__':
    main()
