"""Run a simulated robot and its policy in two processes and print a row for each logged episode.

The rows come from the episode files.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fetch_hand_sim.commands.node_processes import (
    open_log,
    policy_or_default,
    start_nodes,
    stop_node,
)
from fetch_hand_sim.episode_log import EpisodeOutcome, EpisodeRecord, read_summary
from msgs_spec.codecs import decode_status
from msgs_spec.parameters import LARGEST_SEED, episode_seed
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.text import one_line
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, topic, topics
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    EXIT_USAGE,
    CommandError,
    CommandParser,
    complain,
    require_extra,
    run_command,
    say,
    whole_number,
)
from node_runtime.diagnostics import Level
from node_runtime.event_loop import EventLoop
from node_runtime.node_main import StopSignals, destroy, find_place_for_logs
from node_runtime.ros import (
    DISCOVERY_TIME,
    count_publishers,
    keep_discovery_local,
    subscribe,
)

_NAME = 'fetch_hand_sim demo'
_START_TIMEOUT = 60.0
# Seconds between two looks into the folder, which may contain thousands of episodes.
_LOOK_PERIOD = 0.5
# Shells add this to the number of the signal that ended a command.
_SIGNALLED = 128
# The name in rmw of a node that is discovered after its endpoints.
_NAMELESS = '_NODE_NAME_UNKNOWN_'
_COLUMNS = '{:>7}  {:>5}  {:>5}  {:>7}  {:<7}  {}'


class Watcher:
    """A ROS node that follows the robot of the demo.

    Attributes:
        has_started: Whether the first episode has started.
        error: First error that a node reported on `/diagnostics`; '' before.
    """

    def __init__(self, spec: TaskSpec) -> None:
        import rclpy

        self.has_started = False
        self.error = ''
        self._spec = spec
        self._node = rclpy.create_node('demo')
        self._loop = EventLoop(self._node)
        subscribe(self._node, topic(spec, 'episode_status'), self._on_status)
        subscribe(self._node, DIAGNOSTICS, self._on_diagnostics)

    def others(self) -> str:
        """Return what else is running and would disturb the demo, such as `a robot`; '' if none."""
        if count_publishers(self._node, 'episode_status'):
            return 'a robot'
        # Policies that wait for a robot read its status and report diagnostics.
        listeners = self._node.get_subscriptions_info_by_topic('episode_status')
        reporters = self._node.get_publishers_info_by_topic(DIAGNOSTICS.name)
        waiting, reporting = (
            {str(each.node_name) for each in endpoints} for endpoints in (listeners, reporters)
        )
        if found := (waiting & reporting) - {_NAMELESS}:
            return min(found)
        # The nodes of this demo have not started yet.
        nodes = self._node.get_node_names_and_namespaces()
        if nodes.count(('demo', '/')) > 1:
            return 'another demo'
        commands = [each.name for each in topics(self._spec) if each.name.endswith('commands')]
        is_commanded = any(count_publishers(self._node, name) for name in commands)
        return 'a publisher of commands' if is_commanded else ''

    def spin(self) -> None:
        """Wait at most 50 ms for a message and handle it."""
        self._loop.wait(0.05)

    def close(self, exit_code: int) -> None:
        """Destroy the ROS node; end this process with `exit_code` if that takes over 10 s."""
        self._loop.close()
        destroy(self._node, exit_code)

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
        except ValueError:
            return
        # A robot with another task is not the one that this demo started.
        if status.task == self._spec.name and status.phase != 'waiting':
            self.has_started = True

    def _on_diagnostics(self, message: Any) -> None:
        errors = [each for each in message.status if each.level == bytes([Level.ERROR])]
        if errors and not self.error:
            self.error = f'{errors[0].name.lstrip("/")}: {one_line(errors[0].message)}'
            complain(_NAME, self.error)


class Demo:
    """Runs a simulator node and a policy node until all episodes are logged."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._spec = task_spec(options.task)
        self._directory = Path(options.episode_dir)
        self._known = self._episodes()
        self._outcomes: list[EpisodeOutcome] = []

    def run(self, stop: StopSignals) -> int:
        """Run the demo; return its exit code."""
        policy = policy_or_default(self._options.policy, self._spec.name)
        exit_code = EXIT_FAILURE
        watcher = Watcher(self._spec)
        try:
            _require_to_be_alone(watcher, stop)
            exit_code = EXIT_SUCCESS if stop else self._play(policy, watcher, stop)
            if exit_code == EXIT_SUCCESS and stop.received:
                exit_code = _SIGNALLED + signal.Signals[stop.received]
            return exit_code
        finally:
            watcher.close(exit_code)

    def _play(self, policy: str, watcher: Watcher, stop: StopSignals) -> int:
        """Run both nodes until the episodes are logged; return 0, or after a failure 1 or 2.

        If a node ends too early, print the output of the nodes; 2 means that a node rejects its
        parameters. `policy` is a value of `--policy`.
        """
        began = time.monotonic()
        with open_log('demo') as output:
            policy_parameters = {
                'task': self._spec.name,
                'policy': policy,
                'trust': self._options.trust,
            }
            nodes = start_nodes(
                {'policy_node': policy_parameters, 'sim_node': self._sim_parameters()}, output
            )
            try:
                self._watch(watcher, nodes, stop)
                if stop:
                    complain(_NAME, 'stopping')
            finally:
                codes = [stop_node(process) for process in reversed(nodes)]
            self._print_new_rows()
            if any(codes) or (len(self._outcomes) < self._options.episodes and not stop):
                print(Path(output.name).read_text())
                say(f'sim_node and policy_node ended with exit codes {codes}')
                return EXIT_USAGE if EXIT_USAGE in codes else EXIT_FAILURE
        self._print_summary(time.monotonic() - began)
        return EXIT_FAILURE if watcher.error else EXIT_SUCCESS

    def _sim_parameters(self) -> dict[str, object]:
        return {
            'task': self._spec.name,
            'episodes': self._options.episodes,
            'seed': self._options.seed,
            'episode_dir': str(self._directory),
            'wait_for_commands': True,
        }

    def _watch(
        self, watcher: Watcher, nodes: Sequence[subprocess.Popen[str]], stop: StopSignals
    ) -> None:
        say(_COLUMNS.format('episode', 'seed', 'steps', 'return', 'success', 'file'))
        now = look_at = time.monotonic()
        deadline = now + _START_TIMEOUT
        while not stop and all(process.poll() is None for process in nodes):
            watcher.spin()
            now = time.monotonic()
            if now >= look_at:
                look_at = now + _LOOK_PERIOD
                self._print_new_rows()
            if not watcher.has_started and now > deadline:
                return

    def _episodes(self) -> set[str]:
        if not self._directory.is_dir():
            return set()
        return {name for name in os.listdir(self._directory) if not name.startswith('.')}

    def _print_new_rows(self) -> None:
        for name in sorted(self._episodes() - self._known):
            self._known.add(name)
            path = self._directory / name
            try:
                summary = read_summary(path)
                record = EpisodeRecord.parse(summary.metadata)
            except ValueError:
                continue
            # Another simulator node may log into the same folder.
            seed = episode_seed(self._options.seed, record.episode)
            if (record.task.name, record.seed) != (self._spec.name, seed):
                continue
            outcome = summary.outcome
            self._outcomes.append(outcome)
            success = 'yes' if outcome.is_success else 'no'
            total = f'{outcome.episode_return or 0.0:g}'
            row = (record.episode, record.seed, outcome.steps or 0, total, success, path)
            say(_COLUMNS.format(*row))

    def _print_summary(self, seconds: float) -> None:
        count = len(self._outcomes)
        successes = sum(outcome.is_success is True for outcome in self._outcomes)
        steps = sum(outcome.steps or 0 for outcome in self._outcomes)
        mean = sum(outcome.episode_return or 0.0 for outcome in self._outcomes) / max(count, 1)
        say(
            f'{self._spec.name}: {successes} of {count} episodes succeeded, mean return '
            f'{mean:.2f}, {steps} steps, {seconds:.1f} s with start-up. Episodes are in '
            f'{self._directory}/'
        )


def _require_to_be_alone(watcher: Watcher, stop: StopSignals) -> None:
    """Wait for ROS discovery; raise CommandError if another process would disturb the demo."""
    end = time.monotonic() + DISCOVERY_TIME
    while not stop and time.monotonic() < end:
        watcher.spin()
        if found := watcher.others():
            raise CommandError(
                f'{found} is running in / and would interact with this demo: stop it, or set '
                'another ROS_DOMAIN_ID'
            )


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    add, count, seed = parser.add_argument, whole_number(1), whole_number(0, LARGEST_SEED)
    add('--task', help='default: that of --policy if it is the name of a task, or else FetchReach')
    add('--episodes', type=count, default=5, help='number of episodes; default: %(default)s')
    add('--seed', type=seed, default=0, help='seed of the first episode; default: %(default)s')
    add(
        '--episode-dir',
        type=os.path.expanduser,
        default='episodes',
        help='folder for the episodes; default: %(default)s',
    )
    add(
        '--policy',
        default='',
        help='a shipped actor, a file, module:function, random, resting or robust; default: the '
        'shipped actor of the task',
    )
    add('--trust', action='store_true', help='allow policies that run code of their own')
    options = parser.parse_args(arguments)
    if options.task is None:
        options.task = options.policy if options.policy in TASKS else 'FetchReach'
    try:
        task_spec(options.task)
    except ValueError as error:
        parser.error(str(error))
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return its exit code."""
    options = _parse(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    require_extra('ros')
    import rclpy

    keep_discovery_local()
    find_place_for_logs()
    os.environ.setdefault('RCUTILS_COLORIZED_OUTPUT', '0')
    stop = StopSignals()
    rclpy.init(args=[], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        return Demo(options).run(stop)
    finally:
        rclpy.try_shutdown()
