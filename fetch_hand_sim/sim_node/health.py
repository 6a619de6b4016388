"""What a robot reports about itself once a second: the facts, and what is wrong among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from fetch_hand_sim.sim_node.robot import Robot
from msgs_spec.diagnostics import Increase, Report

# Where a robot is asked for more than it does by this share, the report warns.
_RATE_TOLERANCE = 0.05


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the graph and the disk say.

    Attributes:
        commanders: Nodes that publish commands.
        problems: What is wrong with them.
        clock_publishers: Nodes that publish `/clock`, this one included.
        publishes_clock: Whether this node does.
        log: `off`, a directory, or what failed.
        has_log_failed: Whether the log has stopped.
    """

    commanders: Sequence[str]
    problems: Sequence[str]
    clock_publishers: Sequence[str]
    publishes_clock: bool
    log: str
    has_log_failed: bool


@dataclass(slots=True)
class _Growth:
    ticks: Increase = field(default_factory=Increase)
    simulated: Increase = field(default_factory=Increase)
    missed: Increase = field(default_factory=Increase)
    rejected: Increase = field(default_factory=Increase)
    goals_rejected: Increase = field(default_factory=Increase)
    diverged: Increase = field(default_factory=Increase)


class Health:
    """Turns a robot's counters into reports; rates are over the time between two of them."""

    def __init__(self, robot: Robot, name: str, now: float) -> None:
        """Starts the first period.

        Args:
            robot: Whose health.
            name: Fully qualified name of the node.
            now: Seconds of a steady clock.
        """
        self._robot = robot
        self._name = name
        self._then = now
        self._growth = _Growth()
        self._growth.simulated.since(robot.runner.stamp_ns)
        self._asked_before: float | None = None
        self.real_time_factor = 0.0

    def report(self, surroundings: Surroundings, now: float) -> Report:
        """Closes a period and reports on it.

        Args:
            surroundings: What the graph and the disk say.
            now: Seconds of the same clock.
        """
        robot, growth = self._robot, self._growth
        seconds, self._then = max(now - self._then, 1e-9), now
        rate = growth.ticks.since(robot.counters.ticks) / seconds
        simulated = growth.simulated.since(robot.runner.stamp_ns) * 1e-9
        self.real_time_factor = simulated / seconds
        task = robot.runner.spec.name
        report = Report(
            self._name,
            task,
            self._values(rate, surroundings),
            f'{task} {self._state()}, {rate:.1f} ticks per second',
        )
        self._judge(report, rate, surroundings.commanders)
        _judge_surroundings(report, surroundings)
        return report

    def _state(self) -> str:
        schedule = self._robot.schedule
        if schedule.is_paused:
            return 'is paused'
        return 'runs' if self._robot.runner.has_started else 'waits for its first command'

    def _values(self, rate: float, surroundings: Surroundings) -> dict[str, str]:
        robot = self._robot
        counters, buffer, schedule = robot.counters, robot.buffer, robot.schedule
        age = robot.command_age()
        tick_time = counters.tick_time.milliseconds()
        return {
            'mode': schedule.mode,
            'paused': str(schedule.is_paused),
            'simulated time (s)': f'{robot.runner.stamp_ns * 1e-9:.3f}',
            'rate (Hz)': f'{rate:.2f}',
            'rate asked (Hz)': f'{schedule.asked_rate:.2f}' if schedule.asked_rate else '-',
            'real time factor': f'{self.real_time_factor:.3f}',
            'ticks': str(counters.ticks),
            'missed ticks': str(schedule.pacer.missed_ticks),
            **{f'tick time {name} (ms)': value for name, value in tick_time.items()},
            'command age (s)': '-' if age is None else f'{age:.3f}',
            'commands accepted': str(buffer.accepted),
            'commands rejected': str(buffer.rejected.total()),
            **{f'rejected: {reason}': str(n) for reason, n in sorted(buffer.rejected.items())},
            'goals set': str(counters.goals_set),
            'goals rejected': str(counters.goals_rejected),
            'episode': str(robot.runner.episode),
            'seed': str(robot.runner.seed),
            'episodes finished': str(counters.episodes),
            'episodes successful': str(counters.successes),
            'episodes given up': str(counters.given_up),
            'divergences': str(robot.runner.simulation.divergences),
            'log': surroundings.log,
            'commanders': ', '.join(surroundings.commanders) or '-',
            'clock publishers': ', '.join(surroundings.clock_publishers) or '-',
        }

    def _judge(self, report: Report, rate: float, commanders: Sequence[str]) -> None:
        robot, growth = self._robot, self._growth
        diverged = growth.diverged.since(robot.runner.simulation.divergences)
        if diverged:
            report.fail(f'MuJoCo lost the state {diverged:.0f} times')
        missed = growth.missed.since(robot.schedule.pacer.missed_ticks)
        asked = robot.schedule.asked_rate if robot.runner.has_started else None
        # Only a whole period at one pace tells.
        asked_before, self._asked_before = self._asked_before, asked
        if missed:
            report.warn(f'{missed:.0f} ticks missed')
        elif asked and asked == asked_before and rate < (1.0 - _RATE_TOLERANCE) * asked:
            report.warn(f'{rate:.1f} ticks per second, not the {asked:.1f} asked for')
        rejected = growth.rejected.since(robot.buffer.rejected.total())
        if rejected:
            report.warn(f'{rejected:.0f} commands rejected; {robot.buffer.last_rejection}')
        goals_rejected = growth.goals_rejected.since(robot.counters.goals_rejected)
        if goals_rejected:
            report.warn(f'{goals_rejected:.0f} goals rejected')
        if robot.schedule.waits_for_commands and not rate:
            report.warn(waiting_line(robot, commanders))


def _judge_surroundings(report: Report, surroundings: Surroundings) -> None:
    if surroundings.has_log_failed:
        report.fail(surroundings.log)
    for problem in clock_problems(surroundings):
        report.fail(problem)
    for problem in surroundings.problems:
        report.warn(problem)


def clock_problems(surroundings: Surroundings) -> list[str]:
    """What to say of several sources of time."""
    clocks = surroundings.clock_publishers
    if len(clocks) < 2 or not surroundings.publishes_clock:
        return []
    return [
        f'/clock has {len(clocks)} publishers: {", ".join(clocks)}; start all robots but one with '
        'publish_clock:=false'
    ]


def waiting_line(robot: Robot, commanders: Sequence[str]) -> str:
    """What a robot in lockstep waits for."""
    tick = robot.runner.tick + 1
    what = f'tick {tick} of episode {robot.runner.episode}'
    if robot.runner.is_between_episodes:
        what = f'the start of episode {robot.runner.episode}'
    who = f'{", ".join(commanders)} sends none' if commanders else 'nobody publishes any'
    text = f'{what} waits for a valid command; {who}'
    rejected = robot.buffer.last_rejection
    return f'{text}; the last one was refused: {rejected}' if rejected else text
