"""One robot: what it was told, when it moves, what it answers. Knows nothing of ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fetch_hand_sim.episodes.goals import accept_goal
from fetch_hand_sim.episodes.perturbations import accept_perturbation
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.sim_node.command_buffer import CommandBuffer
from fetch_hand_sim.sim_node.schedule import TickSchedule
from msgs_spec.diagnostics import Durations
from msgs_spec.services import MAX_STEPS
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import TopicSpec

Messages = list[tuple[TopicSpec, bytes]]

# Seconds within which a commander answers a tick.
_ANSWER_TIME = 0.2
# Seconds without a command, where there should be one, that pass without a word.
_LONGEST_SILENCE = 1.0


@dataclass(frozen=True, slots=True)
class Answer:
    """What a service says: whether it did what was asked, and why or why not."""

    success: bool
    message: str


@dataclass(slots=True)
class Counters:
    """What a robot has done since it started.

    Attributes:
        ticks: Ticks published, resets included.
        episodes: Episodes that ran to their end.
        successes: Those of them whose last tick was a success.
        given_up: Episodes ended by a reset.
        goals_set: Goals accepted from outside.
        goals_rejected: Goals refused.
        last_goal_rejection: Why the last of them was.
        tick_time: Wall time of a tick: command, physics, encoding, publishing, logging.
    """

    ticks: int = 0
    episodes: int = 0
    successes: int = 0
    given_up: int = 0
    goals_set: int = 0
    goals_rejected: int = 0
    last_goal_rejection: str = ''
    tick_time: Durations = field(default_factory=Durations)


class Robot:
    """Ticks when they are due, and does what services and topics ask for.

    Args:
        runner: Makes the ticks.
        buffer: Says what they apply.
        schedule: Says when they are due.
        emit: Gets every tick with its messages.
        clock: A steady clock, seconds.

    Attributes:
        runner: As above.
        buffer: As above.
        schedule: As above.
        counters: What the robot has done.
        perturb_limit: Largest force of a push, N; 0 refuses all.
        last_messages: Those of the last tick; whoever hears them again can tell by the stamp.
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
        self._emit = emit
        self._clock = clock
        self._encoder = TickEncoder(runner.spec)
        self.last_messages: Messages = []
        self._ticked_at = self._resumed_at = -math.inf
        self._reset_due: float | None = None

    def wait(self) -> float:
        """Seconds until the next tick is due; the first reset needs no command."""
        now = self._clock()
        has_command = self.buffer.has_fresh_command or not self.runner.has_started
        wait = self.schedule.wait(now, has_command)
        return wait if self._reset_due is None else min(wait, max(0.0, self._reset_due - now))

    @property
    def stands_still(self) -> bool:
        """Whether only a person or a command brings the next tick."""
        waits = self.schedule.waits_for_commands and self.runner.has_started
        return self.schedule.is_paused or waits

    @property
    def is_reset_due(self) -> bool:
        """Whether a tick of its own is due that begins the episode which was asked for."""
        return self._reset_due is not None and self._reset_due <= self._clock()

    @property
    def misses_commands(self) -> bool:
        """Whether a second or more has passed without a command that is due, pauses left out.

        That is one for the next tick in lockstep, and any where there was one before; there
        `command_timeout` and two ticks in slow motion may be longer than a second.
        """
        schedule = self.schedule
        if schedule.is_paused or not self.runner.has_started:
            return False
        now = self._clock()
        if schedule.mode == 'lockstep':
            return now - max(self._ticked_at, self._resumed_at) > _LONGEST_SILENCE
        silence = max(_LONGEST_SILENCE, self.buffer.timeout, 2.0 * schedule.pacer.period)
        return min(self.buffer.age() or 0.0, now - self._resumed_at) > silence

    def tick_when_due(self) -> None:
        """Runs the tick that `wait` says is due."""
        self.schedule.begin(self._clock())
        self.tick()

    def tick(self) -> None:
        """Applies the latest command, advances by one tick and emits it."""
        began = self._clock()
        tick = self.runner.advance(self.buffer.take())
        phase = tick.status.phase
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
        self.counters.tick_time.add(self._ticked_at - began)

    # What a robot that stands still says

    def waiting_status(self) -> Messages:
        """`/clock` and `episode_status` of a robot that has not started."""
        stamp_ns = self.runner.stamp_ns
        status = self._encoder.encode_status(stamp_ns, self.runner.waiting_status())
        return [self.clock_message(), status]

    def clock_message(self) -> tuple[TopicSpec, bytes]:
        """`/clock` of a robot that stands still."""
        return self._encoder.encode_clock(self.runner.stamp_ns)

    def set_goal(self, topic: TopicSpec, message: Any) -> None:
        """Replaces the goal of the running episode from the next tick on.

        Args:
            topic: `set_goal` of the task.
            message: What was received.

        Raises:
            ValueError: If it is refused, see `accept_goal`.
        """
        try:
            accept_goal(self.runner, topic, message)
        except ValueError as error:
            self.count_rejected_goal(str(error))
            raise
        self.counters.goals_set += 1

    def count_rejected_goal(self, reason: str) -> None:
        """Counts a goal that was refused, and keeps why."""
        self.counters.goals_rejected += 1
        self.counters.last_goal_rejection = reason

    def perturb(self, topic: TopicSpec, message: Any) -> None:
        """Pushes a body during the next tick.

        Args:
            topic: `perturb` of the task.
            message: What was received.

        Raises:
            ValueError: If it is refused, see `accept_perturbation`.
        """
        accept_perturbation(self.runner, topic, message, self.perturb_limit)

    # Services and parameters

    def reset(self, *, to_first_episode: bool = False) -> Answer:
        """Gives the running episode up; a robot that stands still begins the next one by itself.

        Args:
            to_first_episode: Whether to begin the whole series again, not only the next episode.
        """
        runner = self.runner
        episode, was_running = runner.episode, not runner.is_between_episodes
        if was_running:
            runner.end_episode()
            self.counters.given_up += 1
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
        self._reset_due = self._time_of_silence()
        return Answer(True, f'{ends}; a tick of its own {starts}')

    def _time_of_silence(self) -> float:
        """When no command is on its way that answers the last tick.

        Such a command would otherwise count for the state after the reset, and its commander be a
        tick behind from then on.
        """
        is_answered = self.schedule.is_paused or self.buffer.has_fresh_command
        return self._clock() if is_answered else self._ticked_at + _ANSWER_TIME

    def pause(self, paused: bool) -> Answer:
        """Stops ticks and simulated time, or goes on."""
        if paused == self.schedule.is_paused:
            return Answer(True, 'already paused' if paused else 'already running')
        self.schedule.set_paused(paused, self._clock())
        self._resumed_at = self._clock()
        return Answer(True, f'{"paused" if paused else "running"} at {self._now()}')

    def step(self, ticks: int = 1) -> Answer:
        """Runs ticks at once."""
        if self.schedule.mode == 'realtime' and not self.schedule.is_paused:
            return Answer(False, 'a running simulation cannot be stepped; pause it first')
        if not 1 <= ticks <= MAX_STEPS:
            return Answer(False, f'{ticks} ticks asked for; allowed: 1 ... {MAX_STEPS}')
        for done in range(ticks):
            if self.runner.is_done:
                return Answer(False, f'all episodes are done; {done} of {ticks} ticks ran')
            self.tick()
        return Answer(True, f'{ticks} run, now at {self._now()}')

    def set_real_time_factor(self, factor: float) -> None:
        """Changes the pace from now on."""
        self.schedule.set_real_time_factor(factor, self._clock())

    def _now(self) -> str:
        return f'{self.runner.stamp_ns * 1e-9:.3f} s'
