"""Simulate one robot without ROS: ticks, service calls, goals and pushes."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.recorder import EpisodeRecorder
from fetch_hand_sim.episodes.runner import EpisodeRunner, accept_goal, accept_perturbation
from fetch_hand_sim.sim_node.schedule import Messages, TickSchedule
from msgs_spec.codecs import answered_stamp, decode_status
from msgs_spec.schemas import deserialize, require_short, serialize
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import MAX_STEPS, TopicSpec
from node_runtime.diagnostics import Durations

# Seconds within which a policy answers a tick.
_ANSWER_TIME = 0.2
# Seconds without a command after which it counts as missing.
_LONGEST_SILENCE = 1.0


@dataclass(frozen=True, slots=True)
class Answer:
    """The response of a service; `message` describes the effect, or why the call failed."""

    success: bool
    message: str


@dataclass(slots=True)
class Counters:
    """Counts since the start of the robot.

    Attributes:
        ticks: Published ticks, resets included.
        ended_early: Episodes that a reset ended early.
        late_commands: Steps in real time that began without the command for the last tick.
        tick_time: Wall-clock time of ticks: physics, encoding, publishing and logging.
    """

    ticks: int = 0
    episodes: int = 0
    successes: int = 0
    ended_early: int = 0
    late_commands: int = 0
    goals_set: int = 0
    goals_rejected: int = 0
    last_goal_rejection: str = ''
    tick_time: Durations = field(default_factory=Durations)


class Robot:
    """Simulates a robot tick by tick, and executes services and received goals.

    Attributes:
        perturb_limit: Largest force of a push, N; 0 rejects all pushes.
        has_commander: True once the node has waited for a policy, so that commands are expected.
        last_messages: Messages of the last tick, which are repeated for new subscribers.
    """

    def __init__(
        self,
        runner: EpisodeRunner,
        buffer: CommandBuffer,
        schedule: TickSchedule,
        emit: Callable[[Tick, Messages], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.runner = runner
        self.buffer = buffer
        self.schedule = schedule
        self.counters = Counters()
        self.perturb_limit = 0.0
        self.has_commander = False
        self._emit = emit
        self._clock = clock
        self._encoder = TickEncoder(runner.spec)
        self.last_messages: Messages = []
        self._ticked_at = self._resumed_at = -math.inf
        # True if the commands had stopped before the last pause began.
        self._had_stopped = False
        self._reset_due: float | None = None
        self._late_commands = 0

    def wait(self) -> float:
        """Return the seconds until the next tick; infinity if a command or call must come first."""
        now = self._clock()
        has_command = self.buffer.has_fresh_command or not self.runner.has_started
        wait = self.schedule.wait(now, has_command, self.lacks_answer)
        return wait if self._reset_due is None else min(wait, max(0.0, self._reset_due - now))

    @property
    def stands_still(self) -> bool:
        """True if the next tick needs a command or a service call."""
        waits = self.schedule.waits_for_commands and self.runner.has_started
        return self.schedule.is_paused or waits

    @property
    def is_reset_due(self) -> bool:
        """True if a reset, which a service requested in lockstep or a pause, must run now."""
        return self._reset_due is not None and self._reset_due <= self._clock()

    @property
    def misses_commands(self) -> bool:
        """True if an expected command is later than a limit; pauses do not count.

        In lockstep every tick expects a command, within 1 s. In real time commands are expected
        after the first one, within the largest of 1 s, `command_timeout` and two tick periods.
        """
        schedule = self.schedule
        if schedule.is_paused or not self.runner.has_started:
            return False
        now = self._clock()
        if schedule.mode == 'lockstep':
            return now - max(self._ticked_at, self._resumed_at) > _LONGEST_SILENCE
        silence = max(_LONGEST_SILENCE, self.buffer.timeout, 2.0 * schedule.period)
        return min(self.buffer.age() or 0.0, now - self._resumed_at) > silence

    @property
    def lacks_answer(self) -> bool:
        """True if the command computed from the last tick is expected but has not arrived.

        Always False in lockstep, in a pause, between episodes and after commands have stopped. A
        command that names no observation counts as computed from the last tick.
        """
        if self.schedule.mode == 'lockstep' or self.schedule.is_paused:
            return False
        if self.runner.is_between_episodes:
            return False
        if self.buffer.has_fresh_command:
            return self.buffer.answered_stamp not in (None, self.runner.stamp_ns)
        if self.buffer.age() is None:
            return self.has_commander
        return not self.misses_commands

    def tick_when_due(self) -> None:
        """Run the tick that is due and set the next deadline; call it once `wait` returns 0."""
        now, age = self._clock(), self.buffer.age()
        if self.lacks_answer:
            self.schedule.postpone(now)
        elif age is not None:
            self.schedule.postpone(now - age)
        self.schedule.begin(now)
        self.tick()

    def tick(self) -> None:
        """Apply the latest command, simulate one tick, publish and log its messages."""
        began, is_late = self._clock(), self.lacks_answer
        tick = self.runner.advance(self.buffer.take())
        phase = tick.status.phase
        if self.schedule.mode == 'realtime':
            self._late_commands = is_late + (0 if phase == 'reset' else self._late_commands)
            tick = replace(tick, late_commands=self._late_commands)
        messages = self._encoder.encode(tick, latched=phase != 'running')
        self._emit(tick, messages)
        self.last_messages = messages
        self._ticked_at, self._reset_due = self._clock(), None
        if phase == 'reset':
            self.buffer.start_episode(self.runner.resting_command())
        elif phase == 'finished':
            self.counters.episodes += 1
            self.counters.successes += tick.status.is_success
        self.counters.ticks += 1
        self.counters.late_commands += is_late
        self.counters.tick_time.add(self._ticked_at - began)

    # Messages without a tick

    def waiting_status(self) -> Messages:
        """Return the `/clock` and `episode_status` messages to publish before the first tick."""
        stamp_ns = self.runner.stamp_ns
        status = self._encoder.encode_status(stamp_ns, self.runner.waiting_status())
        return [self.clock_message(), status]

    def clock_message(self) -> tuple[TopicSpec, bytes]:
        """Return `/clock` and its message (CDR bytes) with the present simulated time."""
        return self._encoder.encode_clock(self.runner.stamp_ns)

    # Received messages

    def set_goal(self, topic: TopicSpec, message: Any) -> None:
        """Replace the goal from the next tick on; ValueError if invalid or between episodes."""
        try:
            accept_goal(self.runner, topic, message)
        except ValueError as error:
            self.count_rejected_goal(str(error))
            raise
        self.counters.goals_set += 1

    def count_rejected_goal(self, reason: str) -> None:
        """Count a rejected goal and store the reason for diagnostics."""
        self.counters.goals_rejected += 1
        self.counters.last_goal_rejection = reason

    # Services and parameters

    def reset(self, *, to_first_episode: bool = False) -> Answer:
        """End the running episode; the next tick starts the next or (`to_first_episode`) the first.

        In lockstep or a pause, this tick runs without a command. `success` is always True.
        """
        runner = self.runner
        episode, was_running = runner.episode, not runner.is_between_episodes
        if was_running:
            runner.end_episode()
            self.counters.ended_early += 1
        if to_first_episode:
            runner.start_over()
        ends = f'episode {episode} ends' if was_running else 'no episode is running'
        if runner.is_done:
            return Answer(True, f'{ends}; it was the last')
        starts = f'starts episode {runner.episode} with seed {runner.seed}'
        if not self.stands_still:
            return Answer(
                True, f'{ends}; the next tick {starts}; commands and goals count from then on'
            )
        self._reset_due = self._silence_begins()
        return Answer(True, f'{ends}; a tick of its own {starts}')

    def _silence_begins(self) -> float:
        """Return the time, s of the robot's clock, from which a requested reset may run.

        In a pause, or if the command for the last tick has arrived, this is now. Otherwise it is
        0.2 s after that tick. A command that arrived after the reset would count as the answer to
        the reset, and all later commands would be one tick late.
        """
        is_answered = self.schedule.is_paused or self.buffer.has_fresh_command
        return self._clock() if is_answered else self._ticked_at + _ANSWER_TIME

    def pause(self, paused: bool) -> Answer:
        """Pause or resume ticks and simulated time; `success` is always True."""
        if paused == self.schedule.is_paused:
            return Answer(True, 'already paused' if paused else 'already running')
        if paused:
            self._had_stopped = self.misses_commands
        elif not self._had_stopped:
            self._resumed_at = self._clock()
        self.schedule.set_paused(paused, self._clock())
        return Answer(True, f'{"paused" if paused else "running"} at {self._now()}')

    def step(self, ticks: int = 1) -> Answer:
        """Run `ticks` ticks, 1 ... `MAX_STEPS`, now; `success` is False unless all have run.

        In real time the robot must be paused. The episodes may run out before the last tick.
        """
        if self.schedule.mode == 'realtime' and not self.schedule.is_paused:
            return Answer(False, 'a running simulation cannot be stepped; pause it first')
        if not 1 <= ticks <= MAX_STEPS:
            return Answer(False, f'{ticks} ticks given; allowed: 1 ... {MAX_STEPS}')
        for done in range(ticks):
            if self.runner.is_done:
                return Answer(False, f'all episodes are done; {done} of {ticks} ticks ran')
            self.tick()
        return Answer(True, f'{ticks} run, now at {self._now()}')

    def set_real_time_factor(self, factor: float) -> None:
        """Set the simulated seconds per wall-clock second from now on; 0 is as fast as possible."""
        self.schedule.set_real_time_factor(factor, self._clock())

    def _now(self) -> str:
        return f'{self.runner.stamp_ns * 1e-9:.3f} s'


# Received messages


class Receivers:
    """Passes received messages to a robot and to the log; rejected messages only cause a warning.

    The log contains every readable message, also rejected ones. Unreadable and oversized messages
    are dropped.
    """

    def __init__(
        self,
        robot: Robot,
        log: EpisodeRecorder | None,
        on_commander: Callable[[str | None], None],
        warn: Callable[[str, str], None],
    ) -> None:
        self._robot = robot
        self._log = log
        self._on_commander = on_commander
        self._warn = warn
        self._handlers: dict[str, Callable[[TopicSpec, Any], None]] = {
            'commands': lambda spec, message: robot.buffer.accept(
                message.data, answered_stamp(message)
            ),
            'joint_commands': lambda spec, message: robot.buffer.accept_named(
                message.name, message.position
            ),
            'set_goal': robot.set_goal,
            'perturb': lambda spec, message: accept_perturbation(
                robot.runner, spec, message, robot.perturb_limit
            ),
            'policy_status': self._policy_status,
        }

    def callback(self, spec: TopicSpec) -> Callable[[bytes], None]:
        """Return the callback, which takes CDR bytes, for a subscription to the topic `spec`."""
        handle = self._handlers[spec.name]

        def on_message(data: bytes) -> None:
            message = self._read(spec, data)
            if message is None:
                return
            is_rejected = False
            try:
                handle(spec, message)
            except ValueError as error:
                is_rejected = True
                self._warn(spec.name, str(error))
            if self._log is not None:
                # Serialised again, because senders leave the bytes between fields uninitialised.
                data = serialize(spec.type_name, message)
                self._log.record_received(spec, data, is_refused=is_rejected)

        return on_message

    def _read(self, spec: TopicSpec, data: bytes) -> Any:
        """Decode a message; None, with a warning, if it is unreadable or longer than 64 KiB."""
        try:
            require_short(data)
        except ValueError as error:
            return self._drop(spec, 'too long', str(error))
        try:
            return deserialize(spec.type_name, data)
        except ValueError as error:
            return self._drop(spec, 'unreadable', str(error))

    def _drop(self, spec: TopicSpec, reason: str, line: str) -> None:
        if spec.name == 'set_goal':
            self._robot.count_rejected_goal(line)
        elif spec.name.endswith('commands'):
            self._robot.buffer.count_rejection(reason, line)
        self._warn(spec.name, line)

    def _policy_status(self, spec: TopicSpec, message: Any) -> None:
        del spec
        sha256 = decode_status(message).get('checkpoint_sha256') or None
        if sha256 and not re.fullmatch('[0-9a-f]{64}', sha256):
            raise ValueError(f'checkpoint_sha256 {sha256[:40]!r} given; allowed: 64 hex digits')
        self._on_commander(sha256)
