"""What viewers cost a robot: the rate of `joint_states` without any, with one, with its visitors.

`make bench-view` runs it. Visitors are web sockets that take every picture and draw none; with
`--browser` a headless Chromium draws as well, on the same processors. In lockstep a policy that
rests answers every tick, so ticks per second say what is left of the machine.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from threading import Thread

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'bench'), str(ROOT / 'test')]

import rclpy  # noqa: E402
from bench_rate import Watcher, report  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import ClientConnection, connect  # noqa: E402

from msgs_spec.tasks import TASKS, task_spec  # noqa: E402
from msgs_spec.topics import topic  # noqa: E402
from msgs_spec.transport import keep_discovery_local  # noqa: E402

VISITORS = 3
# Seconds after which a process that was told to end is killed.
_END_TIMEOUT = 20.0


def start(stack: ExitStack, *words: str, stdout: int | None = None) -> subprocess.Popen[str]:
    """Starts a module of this project; it ends with the stack."""
    process = subprocess.Popen([sys.executable, '-m', *words], cwd=ROOT, text=True, stdout=stdout)

    def end() -> None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    stack.callback(end)
    return process


def open_view(stack: ExitStack) -> tuple[subprocess.Popen[str], str]:
    """Starts a viewer; returns its process and the address of its page."""
    process = start(stack, 'fetch_hand_sim.view', '--no-browser', stdout=subprocess.PIPE)
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r'http://([\w.:]+)/', line):
            return process, found[1]
    raise SystemExit('bench_view: the viewer did not start')


def visit(stack: ExitStack, address: str, number: int) -> None:
    """Takes every picture of a page, and confirms it as a page would."""
    socket: ClientConnection = connect(
        f'ws://{address}/state?sid=bench{number}', origin=f'http://{address}', max_size=None
    )

    def take() -> None:
        try:
            for message in socket:
                if isinstance(message, bytes):
                    socket.send('state_ack')
        except ConnectionClosed:
            pass

    Thread(target=take, daemon=True).start()
    stack.callback(socket.close)


def measure(
    watcher: Watcher, label: str, seconds: float, factor: float, without: float = 0.0
) -> float:
    """Watches for a while and prints what was seen; returns ticks per second.

    Args:
        watcher: Hears the robot.
        label: What is measured.
        seconds: How long.
        factor: Real-time factor; 0 in lockstep.
        without: Ticks per second without viewers; 0 if this is that.
    """
    watcher.watch(2.0)
    watcher.times.clear()
    before = watcher.missed
    watcher.watch(seconds)
    rate = len(watcher.times) / seconds
    if factor:
        report(label, watcher.times, watcher.missed - before, factor)
        return rate
    share = f', {100.0 * rate / without:.1f} % of without' if without else ''
    print(f'{label}: {rate:.0f} ticks/s{share}; load average {os.getloadavg()[0]:.1f}', flush=True)
    return rate


def compare(watcher: Watcher, options: argparse.Namespace, factor: float) -> None:
    """Measures without viewers, with one, its visitors, while it is stopped, and without again."""
    seconds = options.seconds
    without = measure(watcher, 'no viewer', seconds, factor)
    with ExitStack() as stack:
        view, address = open_view(stack)
        measure(watcher, 'a viewer that nobody visits', seconds, factor, without)
        for number in range(VISITORS):
            visit(stack, address, number)
        measure(watcher, f'{VISITORS} visitors that do not draw', seconds, factor, without)
        if options.browser and factor:
            from support.browser import Browser

            browser = Browser()
            stack.callback(browser.close)
            browser.open(f'http://{address}/')
            measure(watcher, 'and a Chromium that draws', seconds, factor, without)
        view.send_signal(signal.SIGSTOP)
        measure(watcher, 'a viewer that is stopped', seconds, factor, without)
        view.send_signal(signal.SIGCONT)
    # How much the machine itself has changed meanwhile.
    measure(watcher, 'no viewer any more', seconds, factor, without)


def main() -> None:
    """Compares in real time, then in lockstep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--seconds', type=float, default=30.0, help='per measurement')
    parser.add_argument('--browser', action='store_true', help='let a Chromium draw as well')
    options = parser.parse_args()
    keep_discovery_local()
    for mode, factor in (('realtime', 1.0), ('lockstep', 0.0)):
        rclpy.init()
        print(f'{options.task}, {mode}, {os.cpu_count()} CPUs', flush=True)
        with ExitStack() as stack:
            watcher = Watcher(topic(task_spec(options.task), 'joint_states'))
            # A line for every episode would bury the table.
            quiet = ['--ros-args', '--log-level', 'warn']
            words = [*quiet, '-p', f'task:={options.task}', '-p', f'mode:={mode}']
            start(stack, 'fetch_hand_sim.sim_node', *words)
            if mode == 'lockstep':
                start(stack, 'policy_node.node', *quiet, '-p', 'policy:=resting')
            watcher.wait_for_ticks()
            compare(watcher, options, factor)
        rclpy.shutdown()


if __name__ == '__main__':
    main()
