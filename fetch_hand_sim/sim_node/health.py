"""Report the state and the problems of a simulator node to `/diagnostics` and the log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from fetch_hand_sim.episodes.recorder import EpisodeRecorder
from fetch_hand_sim.sim_node.graph_watch import GraphWatch
from fetch_hand_sim.sim_node.robot import Robot
from fetch_hand_sim.sim_node.schedule import Messages
from msgs_spec.codecs import TopicCodec
from msgs_spec.topics import DIAGNOSTICS, REAL_TIME_FACTOR
from node_runtime.diagnostics import (
    ASKED_RATE,
    COMMANDERS,
    LATE_COMMANDS,
    MISSED_TICKS,
    MODE,
    PAUSED,
    PERTURB_LIMIT,
    RATE,
    Increase,
    Level,
    Report,
    encode_reports,
)
from node_runtime.ros import seldom

if TYPE_CHECKING:
    from rclpy.node import Node

# Seconds between two log lines about a missing command, and before the first one.
WAITING_PERIOD = 5.0
# Share of the requested rate by which a healthy robot may be slower.
_RATE_TOLERANCE = 0.05
Problem = tuple[Level, str]


class Health:
    """Reports on a robot to `/diagnostics` and to the log of its node.

    Rates are measured between two reports. Times are seconds of one steady clock.

    Args:
        node: The simulator node, with the parameters `episode_dir` and `publish_clock`.
        watch: State of the ROS graph, which the node updates.
        recorder: Logs the episodes; None if logging is off.
        now: Present time, at which the first report begins.
    """

    def __init__(
        self,
        node: Node,
        robot: Robot,
        watch: GraphWatch,
        recorder: EpisodeRecorder | None,
        now: float,
    ) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._robot = robot
        self._watch = watch
        self._recorder = recorder
        self._directory = str(node.get_parameter('episode_dir').value)
        self._publishes_clock = bool(node.get_parameter('publish_clock').value)
        self._then = now
        self._increases: defaultdict[str, Increase] = defaultdict(Increase)
        self._simulated = Increase()
        self._simulated.since(robot.runner.stamp_ns)
        self._pace_before: tuple[float | None, int] = (None, 0)
        self._real_time_factor = 0.0
        self._factor_codec = TopicCodec(REAL_TIME_FACTOR)
        self._commanders: list[str] = []
        self._logged: set[str] = set()
        self._has_logged_far_out = False

    @property
    def has_log_failed(self) -> bool:
        """True if an error has stopped logging."""
        return self._recorder is not None and self._recorder.has_failed

    def messages(self, now: float) -> Messages:
        """Return the encoded report and real-time factor since the last call; log new problems."""
        report = self.report(now)
        self._log_news()
        factor = self._factor_codec.encode(0, [self._real_time_factor])
        return [(DIAGNOSTICS, encode_reports(report)), (REAL_TIME_FACTOR, factor)]

    def log_waiting(self) -> None:
        """Log that the robot waits for a command, at most once in `WAITING_PERIOD`."""
        self._node.get_logger().warning(self._waiting(), **seldom(WAITING_PERIOD))

    def report(self, now: float) -> Report:
        """Return the report on the time since the last report."""
        robot, seconds = self._robot, max(now - self._then, 1e-9)
        self._then = now
        self._real_time_factor = self._simulated.since(robot.runner.stamp_ns) * 1e-9 / seconds
        counters = {
            'ticks': robot.counters.ticks,
            'diverged': robot.runner.simulation.divergences,
            'missed': robot.schedule.missed_ticks,
            'late': robot.counters.late_commands,
            'rejected': robot.buffer.rejected.total(),
            'far out': robot.buffer.far_out,
            'goals rejected': robot.counters.goals_rejected,
        }
        grown = {name: round(self._increases[name].since(n)) for name, n in counters.items()}
        rate = grown['ticks'] / seconds
        state = 'runs' if robot.runner.has_started else 'waits for its first command'
        if robot.schedule.is_paused:
            state = 'is paused'
        task = robot.runner.spec.name
        summary = f'{task} {state}, {rate:.1f} ticks per second'
        report = Report(self._name, task, self._values(rate), summary)
        report.problems += [*self._passing_problems(grown, seconds), *self._lasting_problems()]
        if robot.misses_commands and robot.schedule.waits_for_commands:
            report.warn(self._waiting())
        return report

    def _passing_problems(self, grown: Mapping[str, int], seconds: float) -> Iterator[Problem]:
        """Yield problems of the last `seconds`; `grown` is the increase by counter name."""
        robot = self._robot
        schedule, buffer = robot.schedule, robot.buffer
        asked = schedule.asked_rate if robot.runner.has_started else None
        pace_before, self._pace_before = self._pace_before, (asked, schedule.changes)
        if n := grown['diverged']:
            yield Level.ERROR, f'the simulation diverged {n} times'
        if n := grown['missed']:
            yield Level.WARN, f'{n} ticks missed'
        elif asked is not None and self._pace_before == pace_before:
            rate = grown['ticks'] / seconds
            # In slow motion a period may end just before a tick.
            if rate < (1.0 - _RATE_TOLERANCE) * asked - 1.0 / seconds:
                yield Level.WARN, f'{rate:.1f} ticks per second instead of {asked:.1f}'
        if n := grown['late']:
            yield Level.WARN, f'{n} late commands: not the answer to the last observation'
        if n := grown['rejected']:
            yield Level.WARN, f'{n} commands rejected; {buffer.last_rejection}'
        if n := grown['far out']:
            line = f'{n} commands clipped from far out of range; {buffer.last_far_out}'
            yield Level.WARN, line
        if n := grown['goals rejected']:
            yield Level.WARN, f'{n} goals rejected; {robot.counters.last_goal_rejection}'
        if self.has_log_failed:
            yield Level.ERROR, self._log()

    def _lasting_problems(self) -> Iterator[Problem]:
        """Yield problems that last until the user acts, such as two robots in one namespace."""
        watch, buffer = self._watch, self._robot.buffer
        if len(watch.robots) > 1:
            yield (
                Level.ERROR,
                f'{len(watch.robots)} nodes publish as one robot: {", ".join(watch.robots)}; '
                'give each its own namespace: --ros-args -r __ns:=/robot2',
            )
        elif self._publishes_clock and watch.clock_publishers:
            yield (
                Level.ERROR,
                f'/clock is also published by {", ".join(watch.clock_publishers)}; start all '
                'robots but one with publish_clock:=false',
            )
        if problems := watch.inputs.problems():
            yield Level.WARN, '; '.join(problems)
        if self._robot.misses_commands and not self._robot.schedule.waits_for_commands:
            repeats = buffer.has_command and not buffer.timeout
            reaction = 'repeats the last one' if repeats else 'holds'
            source = self._command_source()
            yield Level.WARN, f'commands have stopped, the robot {reaction}; {source}'

    def _waiting(self) -> str:
        """Return a line that names the tick that waits for a command, and likely causes."""
        runner, buffer = self._robot.runner, self._robot.buffer
        tick = f'tick {runner.current.tick + 1} of episode {runner.episode}'
        if runner.is_between_episodes:
            tick = f'the start of episode {runner.episode}'
        last = ''
        if buffer.is_last_rejected:
            last = f'; the last command was rejected: {buffer.last_rejection}'
        return f'{tick} waits for a valid command; {self._command_source()}{last}'

    def _command_source(self) -> str:
        """Return the end of a log line: names of silent commanders, or that no node commands."""
        if names := self._watch.inputs.commanders:
            return f'{", ".join(names)} {"sends" if len(names) == 1 else "send"} none'
        return '; '.join(['no node publishes any', *self._watch.waiting_elsewhere()])

    def _log(self) -> str:
        if self.has_log_failed:
            return f'logging to {self._directory} has failed'
        return self._directory or 'off'

    def _values(self, rate: float) -> dict[str, str]:
        robot, watch = self._robot, self._watch
        counters, buffer, schedule = robot.counters, robot.buffer, robot.schedule
        age, clocks = buffer.age(), list(watch.clock_publishers)
        if self._publishes_clock:
            clocks.append(self._name)
        tick_time = counters.tick_time.milliseconds()
        return {
            MODE: schedule.mode,
            PAUSED: str(schedule.is_paused),
            'simulated time (s)': f'{robot.runner.stamp_ns * 1e-9:.3f}',
            RATE: f'{rate:.2f}',
            ASKED_RATE: f'{schedule.asked_rate:.2f}' if schedule.asked_rate else '-',
            'real time factor': f'{self._real_time_factor:.3f}',
            'ticks': str(counters.ticks),
            MISSED_TICKS: str(schedule.missed_ticks),
            **{f'tick time {name} (ms)': value for name, value in tick_time.items()},
            'command age (s)': '-' if age is None else f'{age:.3f}',
            LATE_COMMANDS: str(counters.late_commands),
            'commands accepted': str(buffer.accepted),
            'commands clipped': str(buffer.clipped),
            'commands far out of range': str(buffer.far_out),
            'commands rejected': str(buffer.rejected.total()),
            **{f'rejected: {reason}': str(n) for reason, n in sorted(buffer.rejected.items())},
            'goals set': str(counters.goals_set),
            'goals rejected': str(counters.goals_rejected),
            'episode': str(robot.runner.episode),
            'seed': str(robot.runner.seed),
            'episodes finished': str(counters.episodes),
            'episodes successful': str(counters.successes),
            'episodes ended early': str(counters.ended_early),
            PERTURB_LIMIT: f'{robot.perturb_limit:g}',
            'divergences': str(robot.runner.simulation.divergences),
            'log': self._log(),
            COMMANDERS: ', '.join(watch.inputs.commanders) or '-',
            'clock publishers': ', '.join(sorted(clocks)) or '-',
        }

    def _log_news(self) -> None:
        """Log new commanders, new lasting problems and the first command far outside its limits."""
        logger, buffer = self._node.get_logger(), self._robot.buffer
        commanders = self._watch.inputs.commanders
        if commanders != self._commanders:
            self._commanders = commanders
            logger.info(f'commands come from {", ".join(commanders) or "no node any more"}')
        if buffer.far_out and not self._has_logged_far_out:
            self._has_logged_far_out = True
            logger.warning(f'command clipped from far out of range: {buffer.last_far_out}')
        lines = {line for _, line in self._lasting_problems()}
        for line in sorted(lines - self._logged):
            logger.warning(line)
        self._logged = lines
