"""The health of a simulator node: a table of conditions, for `/diagnostics` and the log."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fetch_hand_sim.sim_node.graph_watch import GraphWatch
from fetch_hand_sim.sim_node.robot import Messages, Robot
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """State of the graph and of the log.

    Attributes:
        commanders: Nodes that publish commands.
        input_problems: One line for each publisher whose messages do not arrive, and for each
            competing commander.
        robots: Nodes that publish the topics of this robot, this one included.
        waiting_elsewhere: One line for each policy that waits in another namespace.
        clock_publishers: Other nodes that publish `/clock`.
        publishes_clock: Whether this node does.
        log: `off`, a directory, or the failure.
        has_log_failed: Whether logging has stopped.
    """

    commanders: Sequence[str] = ()
    input_problems: Sequence[str] = ()
    robots: Sequence[str] = ()
    waiting_elsewhere: Sequence[str] = ()
    clock_publishers: Sequence[str] = ()
    publishes_clock: bool = True
    log: str = 'off'
    has_log_failed: bool = False

    @property
    def command_source(self) -> str:
        """Which nodes should send commands, as the end of a sentence."""
        if self.commanders:
            verb = 'sends' if len(self.commanders) == 1 else 'send'
            return f'{", ".join(self.commanders)} {verb} none'
        return '; '.join(['no node publishes any', *self.waiting_elsewhere])


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """The input of the conditions.

    Attributes:
        grown: Increase of each counter since the last report.
        rate: Ticks per second since then.
        shortfall: Whether that is less than requested, over a whole period of one pace.
    """

    robot: Robot
    around: Surroundings
    grown: Mapping[str, int] = field(default_factory=dict)
    rate: float = 0.0
    shortfall: bool = False

    def count(self, name: str) -> int:
        """Return the increase of a counter."""
        return self.grown.get(name, 0)

    @property
    def next_tick(self) -> str:
        """Name of the next tick."""
        runner = self.robot.runner
        if runner.is_between_episodes:
            return f'the start of episode {runner.episode}'
        return f'tick {runner.current.tick + 1} of episode {runner.episode}'

    @property
    def last_rejection(self) -> str:
        """Why the last command was rejected, as the end of a sentence."""
        reason = self.robot.buffer.last_rejection
        return f'; the last command was rejected: {reason}' if reason else ''

    @property
    def fallback(self) -> str:
        """The reaction of the robot to missing commands."""
        buffer = self.robot.buffer
        return 'repeats the last one' if buffer.has_command and not buffer.timeout else 'holds'


@dataclass(frozen=True, slots=True)
class Condition:
    """Something wrong with a robot.

    Attributes:
        applies: The predicate.
        sentence: Cause and remedy.
        lasts: Whether it stays until the user acts; such conditions are logged when they begin.
    """

    name: str
    level: Level
    applies: Callable[[Situation], object]
    sentence: Callable[[Situation], str]
    lasts: bool = False


WAITING = Condition(
    'waits for a command',
    Level.WARN,
    lambda s: s.robot.misses_commands and s.robot.schedule.waits_for_commands,
    lambda s: (
        f'{s.next_tick} waits for a valid command; {s.around.command_source}' + s.last_rejection
    ),
)
CONDITIONS = (
    Condition(
        'diverged',
        Level.ERROR,
        lambda s: s.count('diverged'),
        lambda s: f'the simulation diverged {s.count("diverged")} times',
    ),
    Condition(
        'ticks missed',
        Level.WARN,
        lambda s: s.count('missed'),
        lambda s: f'{s.count("missed")} ticks missed',
    ),
    Condition(
        'commands late',
        Level.WARN,
        lambda s: s.count('late'),
        lambda s: f'{s.count("late")} late commands: not the answer to the last observation',
    ),
    Condition(
        'too slow',
        Level.WARN,
        lambda s: s.shortfall and not s.count('missed'),
        lambda s: f'{s.rate:.1f} ticks per second instead of {s.robot.schedule.asked_rate:.1f}',
    ),
    Condition(
        'commands rejected',
        Level.WARN,
        lambda s: s.count('rejected'),
        lambda s: f'{s.count("rejected")} commands rejected; {s.robot.buffer.last_rejection}',
    ),
    Condition(
        'commands far out of range',
        Level.WARN,
        lambda s: s.count('far out'),
        lambda s: (
            f'{s.count("far out")} commands clipped from far out of range; '
            + s.robot.buffer.last_far_out
        ),
    ),
    Condition(
        'goals rejected',
        Level.WARN,
        lambda s: s.count('goals rejected'),
        lambda s: (
            f'{s.count("goals rejected")} goals rejected; ' + s.robot.counters.last_goal_rejection
        ),
    ),
    Condition('log failed', Level.ERROR, lambda s: s.around.has_log_failed, lambda s: s.around.log),
    Condition(
        'several robots',
        Level.ERROR,
        lambda s: len(s.around.robots) > 1,
        lambda s: (
            f'{len(s.around.robots)} nodes publish as one robot: '
            f'{", ".join(s.around.robots)}; give each its own namespace: '
            '--ros-args -r __ns:=/robot2'
        ),
        lasts=True,
    ),
    Condition(
        'several clocks',
        Level.ERROR,
        lambda s: (
            len(s.around.robots) < 2 and s.around.publishes_clock and s.around.clock_publishers
        ),
        lambda s: (
            f'/clock is also published by {", ".join(s.around.clock_publishers)}; start all '
            'robots but one with publish_clock:=false'
        ),
        lasts=True,
    ),
    Condition(
        'wrong publishers',
        Level.WARN,
        lambda s: s.around.input_problems,
        lambda s: '; '.join(s.around.input_problems),
        lasts=True,
    ),
    Condition(
        'commands stopped',
        Level.WARN,
        lambda s: s.robot.misses_commands and not s.robot.schedule.waits_for_commands,
        lambda s: f'commands have stopped, the robot {s.fallback}; {s.around.command_source}',
        lasts=True,
    ),
    WAITING,
)


class Health:
    """Turns a robot's counters into reports; rates are over the time between two of them.

    Args:
        robot: The robot.
        name: Fully qualified name of the node.
        now: Seconds of a steady clock.

    Attributes:
        real_time_factor: Simulated seconds per second in the last period.
    """

    def __init__(self, robot: Robot, name: str, now: float) -> None:
        self._robot = robot
        self._name = name
        self._then = now
        self._increases: defaultdict[str, Increase] = defaultdict(Increase)
        self._simulated = Increase()
        self._simulated.since(robot.runner.stamp_ns)
        self._pace_before: tuple[float | None, int] = (None, 0)
        self.real_time_factor = 0.0

    def report(self, around: Surroundings, now: float) -> Report:
        """Close a period and return its report.

        Args:
            around: State of the graph and of the log.
            now: Seconds of the same clock.
        """
        seconds, self._then = max(now - self._then, 1e-9), now
        self.real_time_factor = self._simulated.since(self._robot.runner.stamp_ns) * 1e-9 / seconds
        situation = self._situation(around, seconds)
        task = self._robot.runner.spec.name
        report = Report(
            self._name,
            task,
            self._values(situation),
            f'{task} {self._state()}, {situation.rate:.1f} ticks per second',
        )
        report.problems += [
            (c.level, c.sentence(situation)) for c in CONDITIONS if c.applies(situation)
        ]
        return report

    def _situation(self, around: Surroundings, seconds: float) -> Situation:
        robot = self._robot
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
        asked = robot.schedule.asked_rate if robot.runner.has_started else None
        pace_before, self._pace_before = self._pace_before, (asked, robot.schedule.changes)
        is_one_pace = asked is not None and self._pace_before == pace_before
        # In slow motion a period may end just before a tick.
        shortfall = is_one_pace and rate < (1.0 - _RATE_TOLERANCE) * (asked or 0.0) - 1.0 / seconds
        return Situation(robot=robot, around=around, grown=grown, rate=rate, shortfall=shortfall)

    def _state(self) -> str:
        if self._robot.schedule.is_paused:
            return 'is paused'
        return 'runs' if self._robot.runner.has_started else 'waits for its first command'

    def _values(self, situation: Situation) -> dict[str, str]:
        robot, around = self._robot, situation.around
        counters, buffer, schedule = robot.counters, robot.buffer, robot.schedule
        age, clocks = buffer.age(), list(around.clock_publishers)
        if around.publishes_clock:
            clocks.append(self._name)
        tick_time = counters.tick_time.milliseconds()
        return {
            MODE: schedule.mode,
            PAUSED: str(schedule.is_paused),
            'simulated time (s)': f'{robot.runner.stamp_ns * 1e-9:.3f}',
            RATE: f'{situation.rate:.2f}',
            ASKED_RATE: f'{schedule.asked_rate:.2f}' if schedule.asked_rate else '-',
            'real time factor': f'{self.real_time_factor:.3f}',
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
            'episodes given up': str(counters.given_up),
            PERTURB_LIMIT: f'{robot.perturb_limit:g}',
            'divergences': str(robot.runner.simulation.divergences),
            'log': around.log,
            COMMANDERS: ', '.join(around.commanders) or '-',
            'clock publishers': ', '.join(sorted(clocks)) or '-',
        }


class Reporter:
    """Reports on a robot to `/diagnostics` and to the log of its node.

    Args:
        node: The simulator node.
        robot: The robot.
        watch: The graph, kept up to date by the node.
        directory: Directory of the episode logs; empty for none.
        has_log_failed: Returns whether logging has stopped.
    """

    def __init__(
        self,
        node: Node,
        robot: Robot,
        watch: GraphWatch,
        directory: str,
        has_log_failed: Callable[[], bool],
    ) -> None:
        self._node = node
        self._robot = robot
        self._watch = watch
        self._directory = directory
        self._has_log_failed = has_log_failed
        self._publishes_clock = bool(node.get_parameter('publish_clock').value)
        self._health = Health(robot, node.get_fully_qualified_name(), time.monotonic())
        self._factor_codec = TopicCodec(REAL_TIME_FACTOR)
        self._commanders: Sequence[str] = ()
        self._logged: set[str] = set()
        self._has_logged_far_out = False

    def report(self, now: float) -> Messages:
        """Close a period: return its messages and log what is new.

        Args:
            now: Seconds of `time.monotonic`.
        """
        around = self._surroundings()
        report = self._health.report(around, now)
        self._log_news(around)
        factor = self._factor_codec.encode(0, [self._health.real_time_factor])
        return [(DIAGNOSTICS, encode_reports(report)), (REAL_TIME_FACTOR, factor)]

    def log_waiting(self) -> None:
        """Log the missing command, at most once in `WAITING_PERIOD`."""
        situation = Situation(robot=self._robot, around=self._surroundings())
        self._node.get_logger().warning(WAITING.sentence(situation), **seldom(WAITING_PERIOD))

    def _surroundings(self) -> Surroundings:
        watch, has_failed = self._watch, self._has_log_failed()
        commanders = watch.inputs.commanders
        log = f'logging to {self._directory} has failed' if has_failed else self._directory
        return Surroundings(
            commanders=commanders,
            input_problems=watch.inputs.problems(),
            robots=watch.robots,
            waiting_elsewhere=[] if commanders else watch.waiting_elsewhere(),
            clock_publishers=watch.clock_publishers,
            publishes_clock=self._publishes_clock,
            log=log or 'off',
            has_log_failed=has_failed,
        )

    def _log_news(self, around: Surroundings) -> None:
        """Log changes of the commanders, and each lasting condition once when it begins."""
        logger, buffer = self._node.get_logger(), self._robot.buffer
        if list(around.commanders) != list(self._commanders):
            self._commanders = around.commanders
            logger.info(f'commands come from {", ".join(around.commanders) or "no node any more"}')
        if buffer.far_out and not self._has_logged_far_out:
            self._has_logged_far_out = True
            logger.warning(f'command clipped from far out of range: {buffer.last_far_out}')
        situation = Situation(robot=self._robot, around=around)
        lines = {c.sentence(situation) for c in CONDITIONS if c.lasts and c.applies(situation)}
        for line in sorted(lines - self._logged):
            logger.warning(line)
        self._logged = lines
