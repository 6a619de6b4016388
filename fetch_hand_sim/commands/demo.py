"""`make demo`: a robot and an actor in two processes, watched from a third.

It starts `sim_node` and `policy_node`, listens to the robot as any other subscriber would, and
prints a row for every episode that it finds logged.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from fetch_hand_sim.commands.node_processes import (
    is_actor_shipped,
    open_log,
    start_nodes,
    stop_node,
)
from fetch_hand_sim.episode_log import (
    Episode,
    EpisodeOutcome,
    EpisodeRecord,
    read_episode,
)
from msgs_spec.codecs import decode_status
from msgs_spec.parameters import LARGEST_SEED
from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.text import printable
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, topic, topics
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    FormerOption,
    complain,
    require_extra,
    run_command,
    whole_number,
)
from node_runtime.node_main import StopSignals, destroy, find_place_for_logs
from node_runtime.ros import (
    DISCOVERY_TIME,
    count_publishers,
    rclpy_profile,
    ros_message_class,
)
from node_runtime.transport import keep_discovery_local

_NAME = 'fetch_hand_sim demo'
_START_TIMEOUT = 60.0
# What shells add to the number of the signal that ended a command.
_SIGNALLED = 128
# What rmw calls the node of an endpoint that is discovered before its node.
_NAMELESS = '_NODE_NAME_UNKNOWN_'
_COLUMNS = '{:>7}  {:>5}  {:>5}  {:>7}  {:<7}  {}'


class Watcher:
    """A plain subscriber that follows an episode's progress.

    Args:
        spec: The task of the robot.
    """

    def __init__(self, spec: TaskSpec) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.status: EpisodeStatus | None = None
        self.ticks = 0
        self._spec = spec
        self._node = rclpy.create_node('demo')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        for name, callback in (('episode_status', self._on_status), ('reward', self._on_reward)):
            source = topic(spec, name)
            self._node.create_subscription(
                ros_message_class(source.type_name), name, callback, rclpy_profile(source.qos)
            )

    def others(self) -> str:
        """Who would take part in what this demo starts, in words; '' for nobody."""
        if count_publishers(self._node, 'episode_status'):
            return 'a robot'
        if waiting := self._waiting_policies():
            return min(waiting)
        # Its nodes are still to come.
        nodes = self._node.get_node_names_and_namespaces()
        if nodes.count(('demo', '/')) > 1:
            return 'another demo'
        commands = [each.name for each in topics(self._spec) if each.name.endswith('commands')]
        is_commanded = any(count_publishers(self._node, name) for name in commands)
        return 'who publishes commands' if is_commanded else ''

    def _waiting_policies(self) -> set[str]:
        """Who waits for a robot, under any name: it commands nobody yet, and reports its health."""
        listeners = self._node.get_subscriptions_info_by_topic('episode_status')
        reporters = self._node.get_publishers_info_by_topic(DIAGNOSTICS.name)
        waiting, reporting = (
            {each.node_name for each in endpoints} for endpoints in (listeners, reporters)
        )
        return {name for name in waiting & reporting if name != _NAMELESS}

    def spin(self) -> None:
        """Serves callbacks for a moment."""
        self._executor.spin_once(timeout_sec=0.05)

    def close(self, exit_code: int) -> None:
        """Leaves the graph; a process that cannot ends with `exit_code`."""
        self._executor.remove_node(self._node)
        destroy(self._node, exit_code)

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
        except ValueError:
            return
        # Whoever says something else there is not the robot that was started here.
        if status.task == self._spec.name:
            self.status, self.ticks = status, status.tick

    def _on_reward(self, message: Any) -> None:
        del message
        self.ticks += 1


class Demo:
    """Runs the two nodes until the episodes are done.

    Args:
        options: Of the command line.
        console: Where it prints.
    """

    def __init__(self, options: argparse.Namespace, console: Console) -> None:
        self._options = options
        self._console = console
        self._spec = task_spec(options.task)
        self._directory = Path(options.episode_dir)
        self._known = set(self._episodes())
        self._outcomes: list[EpisodeOutcome] = []
        self._log: Path | None = None

    def run(self, stop: StopSignals) -> int:
        """Runs the demo and returns the exit code."""
        commander, exit_code = self._policy(), EXIT_FAILURE
        watcher = Watcher(self._spec)
        try:
            _require_to_be_alone(watcher, stop)
            exit_code = EXIT_SUCCESS if stop else self._play(commander, watcher, stop)
            if exit_code == EXIT_SUCCESS and stop.received:
                exit_code = _SIGNALLED + signal.Signals[stop.received]
            return exit_code
        finally:
            watcher.close(exit_code)

    def _play(self, commander: str, watcher: Watcher, stop: StopSignals) -> int:
        """Runs the nodes, prints what they did and returns the exit code."""
        began = time.monotonic()
        # What the nodes print is shown if something goes wrong.
        with open_log('demo') as logs:
            self._log = Path(logs.name)
            policy, sim = start_nodes(
                {'policy_node': {'policy': commander}, 'sim_node': self._sim_parameters()}, logs
            )
            try:
                self._watch(watcher, sim, policy, stop)
                if stop:
                    complain(_NAME, 'stopping')
            finally:
                codes = [stop_node(process) for process in (sim, policy)]
            self._print_new_rows()
            if any(codes) or (len(self._outcomes) < self._options.episodes and not stop):
                self._console.print(Path(logs.name).read_text(), markup=False, highlight=False)
                self._console.print(f'the nodes ended with exit codes {codes}')
                return EXIT_FAILURE
        self._print_summary(time.monotonic() - began)
        return EXIT_SUCCESS

    def _policy(self) -> str:
        if self._options.policy:
            return str(self._options.policy)
        if is_actor_shipped(self._spec.name):
            return self._spec.name
        self._console.print(f'No actor is shipped for {self._spec.name} yet: commands are random.')
        return 'random'

    def _sim_parameters(self) -> dict[str, object]:
        return {
            'task': self._spec.name,
            'episodes': self._options.episodes,
            'seed': self._options.seed,
            'episode_dir': str(self._directory),
            'wait_for_commands': True,
        }

    def _watch(
        self,
        watcher: Watcher,
        sim: subprocess.Popen[str],
        policy: subprocess.Popen[str],
        stop: StopSignals,
    ) -> None:
        columns = (TextColumn('{task.description}'), BarColumn(), TextColumn('{task.fields[note]}'))
        print(_COLUMNS.format('episode', 'seed', 'steps', 'return', 'success', 'file'), flush=True)
        deadline = time.monotonic() + _START_TIMEOUT
        with Progress(*columns, console=self._console, transient=True) as progress:
            bar = progress.add_task('starting', total=self._spec.episode_ticks, note='')
            while sim.poll() is None and policy.poll() is None and not stop:
                watcher.spin()
                _show(progress, bar, watcher)
                self._print_new_rows(progress.console)
                has_started = watcher.status is not None and watcher.status.phase != 'waiting'
                if not has_started and time.monotonic() > deadline:
                    return

    def _episodes(self) -> Iterator[Path]:
        if self._directory.is_dir():
            yield from (p for p in self._directory.iterdir() if not p.name.startswith('.'))

    def _logged(self) -> list[Path]:
        """New episodes that the robot says it logged: others may log in the same directory."""
        found = sorted(set(self._episodes()) - self._known)
        said = self._log.read_bytes() if found and self._log else b''
        # No digit may follow, of a longer seed.
        return [p for p in found if re.search(rb', %b(?!\d)' % re.escape(os.fsencode(p)), said)]

    def _print_new_rows(self, console: Console | None = None) -> None:
        for path in self._logged():
            self._known.add(path)
            try:
                episode = read_episode(path)
                row = _row(episode, path)
            except ValueError:
                # Unreadable, or not of this project.
                continue
            self._outcomes.append(episode.outcome)
            (console or self._console).print(
                printable(row), markup=False, highlight=False, soft_wrap=True
            )

    def _print_summary(self, seconds: float) -> None:
        count = len(self._outcomes)
        successes = sum(outcome.is_success is True for outcome in self._outcomes)
        steps = sum(outcome.steps or 0 for outcome in self._outcomes)
        mean = sum(outcome.episode_return or 0.0 for outcome in self._outcomes) / max(count, 1)
        self._console.print(
            f'{self._spec.name}: {successes} of {count} episodes succeeded, mean return '
            f'{mean:.2f}, {steps} steps, {seconds:.1f} s with start-up. Episodes are in '
            f'{printable(str(self._directory))}/',
            highlight=False,
            soft_wrap=True,
        )


def _require_to_be_alone(watcher: Watcher, stop: StopSignals) -> None:
    """Refuses to start nodes beside those of others, who would play with them or against them.

    Raises:
        CommandError: If there are some.
    """
    end = time.monotonic() + DISCOVERY_TIME
    while not stop and time.monotonic() < end:
        watcher.spin()
        if found := watcher.others():
            raise CommandError(
                f'{found} in / runs already and would take part: end that first, or choose '
                'another ROS_DOMAIN_ID'
            )


def _row(episode: Episode, path: Path) -> str:
    """The line of a logged episode, as its file tells it."""
    record, outcome = EpisodeRecord.parse(episode.metadata), episode.outcome
    success = 'yes' if outcome.is_success else 'no'
    total = f'{outcome.episode_return or 0.0:g}'
    return _COLUMNS.format(record.episode, record.seed, outcome.steps or 0, total, success, path)


def _show(progress: Progress, bar: TaskID, watcher: Watcher) -> None:
    status = watcher.status
    if status is None or status.phase == 'waiting':
        return
    note = f'tick {watcher.ticks}, seed {status.seed}'
    ticks = task_spec(status.task, control_hz=status.control_hz).episode_ticks
    description = f'episode {status.episode}'
    progress.update(bar, description=description, completed=watcher.ticks, total=ticks, note=note)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('--task', default='FetchReach', help='default: %(default)s')
    count, seed = whole_number(1), whole_number(0, LARGEST_SEED)
    parser.add_argument('--episodes', type=count, default=5, help='how many; default: %(default)s')
    parser.add_argument('--seed', type=seed, default=0, help='of the first; default: %(default)s')
    parser.add_argument(
        '--episode-dir',
        type=os.path.expanduser,
        default='episodes',
        help='where they are logged; default: %(default)s',
    )
    parser.add_argument(
        '--policy',
        default='',
        help='a shipped actor, a file, random or resting; default: the shipped actor of the task',
    )
    parser.add_argument('--checkpoint', dest='policy', action=FormerOption, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    try:
        task_spec(options.task)
    except ValueError as error:
        parser.error(str(error))
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the demo; returns the exit code."""
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
        return Demo(options, Console()).run(stop)
    finally:
        rclpy.try_shutdown()
