"""One robot: what it was told, when it moves, what it answers. Knows nothing of ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import ArrayLike

from fetch_hand_sim.episodes.goals import accept_goal
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.sim_node.command_buffer import CommandBuffer
from fetch_hand_sim.sim_node.schedule import TickSchedule
from msgs_spec.diagnostics import Durations
from msgs_spec.services import MAX_STEPS
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import TopicSpec

Messages = list[tuple[TopicSpec, bytes]]


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
        tick_time: Wall time of a tick: command, physics, encoding, publishing, logging.
    """

    ticks: int = 0
    episodes: int = 0
    successes: int = 0
    given_up: int = 0
    goals_set: int = 0
    goals_rejected: int = 0
    tick_time: Durations = field(default_factory=Durations)


class Robot:
    """Ticks when they are due, and does what services and topics ask for."""

    def __init__(
        self,
        runner: EpisodeRunner,
        buffer: CommandBuffer,
        schedule: TickSchedule,
        emit: Callable[[Tick, Messages], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepares the first episode.

        Args:
            runner: Makes the ticks.
            buffer: Says what they apply.
            schedule: Says when they are due.
            emit: Gets every tick with its messages.
            clock: A steady clock, seconds.
        """
        self.runner = runner
        self.buffer = buffer
        self.schedule = schedule
        self.counters = Counters()
        self._emit = emit
        self._clock = clock
        self._encoder = TickEncoder(runner.spec)
        self._present: Messages = []

    def wait(self) -> float:
        """Seconds until the next tick is due; the first reset needs no command."""
        has_command = self.buffer.has_fresh_command or not self.runner.has_started
        return self.schedule.wait(self._clock(), has_command)

    def tick_when_due(self) -> None:
        """Runs the tick that `wait` says is due."""
        self.schedule.begin(self._clock())
        self.tick()

    def tick(self) -> None:
        """Applies the latest command, advances by one tick and emits it."""
        began = self._clock()
        tick = self.runner.advance(self.buffer.take(began).values)
        phase = tick.status.phase
        messages = self._encoder.encode(tick, latched=phase != 'running')
        self._emit(tick, messages)
        self._present = messages
        if phase == 'reset':
            self.buffer.start_episode(self.runner.resting_command())
        elif phase == 'finished':
            self.counters.episodes += 1
            self.counters.successes += tick.status.is_success
        self.counters.ticks += 1
        self.counters.tick_time.add(self._clock() - began)

    # What the network may ask to hear again

    def present(self) -> Messages:
        """The messages of the present tick once more, for a commander who was not there.

        They carry the same stamp and the same bytes, so whoever has seen them can tell.
        """
        return list(self._present)

    def waiting_status(self) -> Messages:
        """`/clock` and `episode_status` of a robot that has not started."""
        stamp_ns = self.runner.stamp_ns
        status = self._encoder.encode_status(stamp_ns, self.runner.waiting_status())
        return [self.clock_message(), status]

    def clock_message(self) -> tuple[TopicSpec, bytes]:
        """`/clock` of a robot that stands still."""
        return self._encoder.encode_clock(self.runner.stamp_ns)

    # Commands and goals

    def accept_command(self, values: ArrayLike) -> None:
        """Takes a command of all values.

        Raises:
            CommandRejected: If it is not valid.
        """
        self.buffer.accept(values, self._clock())

    def accept_named_command(self, names: Sequence[str], positions: ArrayLike) -> None:
        """Takes a command that names joints.

        Raises:
            CommandRejected: If it is not valid.
        """
        self.buffer.accept_named(names, positions, self._clock())

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
        except ValueError:
            self.counters.goals_rejected += 1
            raise
        self.counters.goals_set += 1

    def command_age(self) -> float | None:
        """Seconds since the last valid command of this episode."""
        return self.buffer.age(self._clock())

    # Services and parameters

    def reset(self) -> Answer:
        """Gives the running episode up."""
        episode = self.runner.episode
        if self.runner.is_between_episodes:
            return Answer(True, f'episode {episode} is about to start anyway')
        self.runner.end_episode()
        self.counters.given_up += 1
        if self.runner.is_done:
            return Answer(True, f'episode {episode} ends; it was the last')
        starts = f'starts episode {self.runner.episode} with seed {self.runner.seed}'
        if self.schedule.is_paused:
            return Answer(True, f'episode {episode} ends; the next step {starts}')
        if self.schedule.waits_for_commands:
            return Answer(True, f'episode {episode} ends; the next command {starts}')
        return Answer(True, f'episode {episode} ends; the next tick {starts}')

    def pause(self, paused: bool) -> Answer:
        """Stops ticks and simulated time, or goes on."""
        if paused == self.schedule.is_paused:
            return Answer(True, 'already paused' if paused else 'already running')
        self.schedule.set_paused(paused, self._clock())
        seconds = self.runner.stamp_ns * 1e-9
        return Answer(True, f'{"paused" if paused else "running"} at {seconds:.3f} s')

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
        return Answer(True, f'{ticks} run, now at {self.runner.stamp_ns * 1e-9:.3f} s')

    def set_real_time_factor(self, factor: float) -> None:
        """Changes the pace from now on."""
        self.schedule.set_real_time_factor(factor, self._clock())
