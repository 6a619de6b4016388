"""What a robot reports about itself once a second: the facts, and what is wrong among them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from fetch_hand_sim.sim_node.robot import Robot
from msgs_spec.diagnostics import (
    ASKED_RATE,
    COMMANDERS,
    MISSED_TICKS,
    MODE,
    PAUSED,
    PERTURB_LIMIT,
    RATE,
    Increase,
    Level,
    Report,
)

# Where a robot is asked for more than it does by this share, the report warns.
_RATE_TOLERANCE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """What the graph and the disk say.

    Attributes:
        commanders: Nodes that publish commands.
        commander_problems: What is wrong with them.
        robots: Nodes that publish this robot's topics, this one included.
        waiting_elsewhere: Policies that wait for a robot in another namespace.
        clock_publishers: Other nodes that publish `/clock`.
        publishes_clock: Whether this node does.
        log: `off`, a directory, or what failed.
        has_log_failed: Whether the log has stopped.
    """

    commanders: Sequence[str] = ()
    commander_problems: Sequence[str] = ()
    robots: Sequence[str] = ()
    waiting_elsewhere: Sequence[str] = ()
    clock_publishers: Sequence[str] = ()
    publishes_clock: bool = True
    log: str = 'off'
    has_log_failed: bool = False


class Health:
    """Turns a robot's counters into reports; rates are over the time between two of them.

    Args:
        robot: Whose health.
        name: Fully qualified name of the node.
        now: Seconds of a steady clock.

    Attributes:
        real_time_factor: Simulated seconds per second in the last period.
    """

    def __init__(self, robot: Robot, name: str, now: float) -> None:
        self._robot = robot
        self._name = name
        self._then = now
        # How much each counter has grown since the last report, by its name.
        self._growth: defaultdict[str, Increase] = defaultdict(Increase)
        self._growth['simulated'].since(robot.runner.stamp_ns)
        self._pace_before: tuple[float | None, int] = (None, 0)
        self.real_time_factor = 0.0

    def report(self, surroundings: Surroundings, now: float) -> Report:
        """Closes a period and reports on it.

        Args:
            surroundings: What the graph and the disk say.
            now: Seconds of the same clock.
        """
        robot, growth = self._robot, self._growth
        seconds, self._then = max(now - self._then, 1e-9), now
        rate = growth['ticks'].since(robot.counters.ticks) / seconds
        simulated = growth['simulated'].since(robot.runner.stamp_ns) * 1e-9
        self.real_time_factor = simulated / seconds
        task = robot.runner.spec.name
        report = Report(
            self._name,
            task,
            self._values(rate, surroundings),
            f'{task} {self._state()}, {rate:.1f} ticks per second',
        )
        self._judge_period(report, rate, seconds)
        if surroundings.has_log_failed:
            report.fail(surroundings.log)
        report.problems += lasting_problems(robot, surroundings)
        if robot.misses_commands and robot.schedule.waits_for_commands:
            report.warn(waiting_line(robot, surroundings))
        return report

    def _state(self) -> str:
        schedule = self._robot.schedule
        if schedule.is_paused:
            return 'is paused'
        return 'runs' if self._robot.runner.has_started else 'waits for its first command'

    def _values(self, rate: float, surroundings: Surroundings) -> dict[str, str]:
        robot = self._robot
        counters, buffer, schedule = robot.counters, robot.buffer, robot.schedule
        age = buffer.age()
        tick_time = counters.tick_time.milliseconds()
        return {
            MODE: schedule.mode,
            PAUSED: str(schedule.is_paused),
            'simulated time (s)': f'{robot.runner.stamp_ns * 1e-9:.3f}',
            RATE: f'{rate:.2f}',
            ASKED_RATE: f'{schedule.asked_rate:.2f}' if schedule.asked_rate else '-',
            'real time factor': f'{self.real_time_factor:.3f}',
            'ticks': str(counters.ticks),
            MISSED_TICKS: str(schedule.pacer.missed_ticks),
            **{f'tick time {name} (ms)': value for name, value in tick_time.items()},
            'command age (s)': '-' if age is None else f'{age:.3f}',
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
            'log': surroundings.log,
            COMMANDERS: ', '.join(surroundings.commanders) or '-',
            'clock publishers': ', '.join(self._clock_publishers(surroundings)) or '-',
        }

    def _clock_publishers(self, surroundings: Surroundings) -> list[str]:
        own = [self._name] if surroundings.publishes_clock else []
        return sorted([*surroundings.clock_publishers, *own])

    def _judge_period(self, report: Report, rate: float, seconds: float) -> None:
        """Reports what went wrong since the last report."""
        robot, growth = self._robot, self._growth
        diverged = growth['diverged'].since(robot.runner.simulation.divergences)
        if diverged:
            report.fail(f'MuJoCo lost the state {diverged:.0f} times')
        missed = growth['missed'].since(robot.schedule.pacer.missed_ticks)
        asked = robot.schedule.asked_rate if robot.runner.has_started else None
        # Only a whole period at one pace tells.
        pace_before, self._pace_before = self._pace_before, (asked, robot.schedule.changes)
        if missed:
            report.warn(f'{missed:.0f} ticks missed')
        elif asked and self._pace_before == pace_before:
            # In slow motion a period may end just before a tick.
            if rate < (1.0 - _RATE_TOLERANCE) * asked - 1.0 / seconds:
                report.warn(f'{rate:.1f} ticks per second, not the {asked:.1f} asked for')
        rejected = growth['rejected'].since(robot.buffer.rejected.total())
        if rejected:
            report.warn(f'{rejected:.0f} commands rejected; {robot.buffer.last_rejection}')
        far_out = growth['far_out'].since(robot.buffer.far_out)
        if far_out:
            line = f'{far_out:.0f} commands clipped from far out of range'
            report.warn(f'{line}; {robot.buffer.last_far_out}')
        goals_rejected = growth['goals_rejected'].since(robot.counters.goals_rejected)
        if goals_rejected:
            reason = robot.counters.last_goal_rejection
            report.warn(f'{goals_rejected:.0f} goals rejected; {reason}')


def lasting_problems(robot: Robot, surroundings: Surroundings) -> list[tuple[Level, str]]:
    """What is wrong and stays so until somebody does something; the same words all the time."""
    problems: list[tuple[Level, str]] = []
    robots = surroundings.robots
    if len(robots) > 1:
        line = f'{len(robots)} publish as one robot: {", ".join(robots)}; start each in a '
        problems.append((Level.ERROR, f'{line}namespace of its own: --ros-args -r __ns:=/robot2'))
    elif surroundings.clock_publishers and surroundings.publishes_clock:
        line = f'/clock comes from {", ".join(surroundings.clock_publishers)} too; start all '
        problems.append((Level.ERROR, f'{line}robots but one with publish_clock:=false'))
    problems += [(Level.WARN, line) for line in surroundings.commander_problems]
    if robot.misses_commands and not robot.schedule.waits_for_commands:
        repeats = robot.buffer.has_command and not robot.buffer.timeout
        does = 'repeats the last one' if repeats else 'holds'
        who = _who_commands(surroundings)
        problems.append((Level.WARN, f'commands have stopped, the robot {does}; {who}'))
    return problems


def waiting_line(robot: Robot, surroundings: Surroundings) -> str:
    """What a robot that needs a command waits for."""
    runner = robot.runner
    what = f'tick {runner.current.tick + 1} of episode {runner.episode}'
    if runner.is_between_episodes:
        what = f'the start of episode {runner.episode}'
    text = f'{what} waits for a valid command; {_who_commands(surroundings)}'
    rejected = robot.buffer.last_rejection
    return f'{text}; the last one was refused: {rejected}' if rejected else text


def _who_commands(surroundings: Surroundings) -> str:
    if surroundings.commanders:
        verb = 'sends' if len(surroundings.commanders) == 1 else 'send'
        return f'{", ".join(surroundings.commanders)} {verb} none'
    return '; '.join(['nobody publishes any', *surroundings.waiting_elsewhere])
