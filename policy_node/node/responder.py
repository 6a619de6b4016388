"""Turn the bytes of a robot's topics into the bytes of a command, without ROS."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.codecs import CommandCodec, TopicCodec
from msgs_spec.observations import ObservationAssembler
from msgs_spec.robots import command_from_action
from msgs_spec.tasks import task_spec
from msgs_spec.text import one_line
from msgs_spec.tick import EpisodeStatus, Phase
from msgs_spec.topics import topic
from node_runtime.diagnostics import Durations
from policy_node.policies.policy import LoadedPolicy

Vectors = dict[str, NDArray[np.float64]]

# Nanoseconds. A stamp further back means that the simulation was started again.
_LONGEST_DELAY = 1_000_000_000
# Seconds after which a message is never late.
_LATEST = 1.0


class StampJoin:
    """Collect the vectors of several topics until all of them have arrived with the same stamp.

    A stamp with all topics is complete. Earlier incomplete stamps are then dropped, because a
    policy needs the newest state only. A complete stamp more than 1 s before the last one means
    that the simulation was started again. A wrong stamp on one topic never becomes complete.

    Args:
        max_pending: Number of incomplete stamps kept; the oldest is dropped first.
        clock: A steady clock, seconds.

    Attributes:
        dropped: Number of incomplete stamps that were dropped.
    """

    def __init__(
        self,
        topics: Iterable[str],
        max_pending: int = 8,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._topics = frozenset(topics)
        self._max_pending = max_pending
        self._pending: dict[int, Vectors] = {}
        self._last: int | None = None
        self._clock = clock
        self._completed_at = -math.inf
        self.dropped = 0

    def add(self, topic: str, stamp: int, vector: NDArray[np.float64]) -> Vectors | None:
        """Add a vector; return all vectors by topic if it completes `stamp`, ns, otherwise None."""
        if self._last is not None and self._is_late(self._last - stamp):
            return None
        vectors = self._pending.setdefault(stamp, {})
        vectors[topic] = vector
        if vectors.keys() == self._topics:
            self._complete(stamp)
            return vectors
        while len(self._pending) > self._max_pending:
            del self._pending[next(iter(self._pending))]
            self.dropped += 1
        return None

    def forget(self) -> None:
        """Forget all stamps, so that the next one may be earlier."""
        self._last = None
        self._pending.clear()

    def _is_late(self, delay: int) -> bool:
        """Return whether to drop a message that is `delay` ns older than the last complete stamp.

        Drop delay 0, and delays up to 1 s if that stamp became complete less than 1 s of wall-clock
        time ago. Keep newer messages (delay < 0) and, after a restart, messages with larger delays.
        """
        if not 0 < delay <= _LONGEST_DELAY:
            return delay == 0
        return self._clock() - self._completed_at < _LATEST

    def _complete(self, stamp: int) -> None:
        self._last, self._completed_at = stamp, self._clock()
        del self._pending[stamp]
        # Late, or from before a restart of the simulation.
        lost = [other for other in self._pending if not stamp < other <= stamp + _LONGEST_DELAY]
        self.dropped += len(lost)
        for other in lost:
            del self._pending[other]


# Seconds until the policy tries a failed tick again.
_ASK_AGAIN = 1.0


class Responder:
    """Answer the newest complete tick of one robot with one command.

    Call `receive` for each message, then `answer` once all waiting messages are received. If the
    robot is faster than the policy, ticks are skipped; the delay does not grow.

    Args:
        status: An `episode_status` of the robot, for its task, joint names and frequency.
        send: Publishes the CDR bytes of a command; returns False without a subscriber.
        clock: A steady clock, seconds.

    Attributes:
        topics: The topics that the policy needs.
        join: The `StampJoin` of these topics.
        answered: Number of commands sent.
        turned_back: Number of messages with an earlier stamp than the last one of their topic. A
            restarted publisher causes one; two publishers cause many.
        unusable: Number of invalid messages, and of ticks without a valid observation.
        failed: Number of observations for which the policy failed.
        last_failure: Error of the last failure.
        inference: Durations of the policy's calls, from an observation to its command.
        received_at: Time of the last complete observation, seconds of the clock; None before.
        interval: Seconds between the last two complete observations; infinite before.

    Raises:
        ValueError: If the policy was trained at another frequency.
    """

    def __init__(
        self,
        policy: LoadedPolicy,
        status: EpisodeStatus,
        send: Callable[[bytes], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        policy.require_rate(status.control_hz)
        self.policy = policy
        # Memory of the policy.
        self._state: Any = None
        spec = task_spec(status.task, status.joint_prefix)
        self._robot = spec.robot
        self._assembler = ObservationAssembler(spec, status.control_hz)
        self._send = send
        self._clock = clock
        self._commands = CommandCodec(topic(spec, 'commands'))
        self._sources = {
            source.name: TopicCodec(source, requires_frame=True)
            for source in self._assembler.topics
        }
        self._due: Vectors | None = None
        self._due_stamp = 0
        self._asked: Vectors | None = None
        # The last answered tick, whether it began an episode, and stamps of episode ends.
        self._answered: tuple[int, Vectors] | None = None
        self._is_first = True
        self._starts_at = self._ends_at = -1
        self._ask_again_at = 0.0
        self._unsent: bytes | None = None
        self.topics = self._assembler.topics
        self.join = StampJoin((source.name for source in self.topics), clock=clock)
        self._newest: dict[str, int] = {}
        self.answered = 0
        self.turned_back = 0
        self.unusable = 0
        self.failed = 0
        self.last_failure = ''
        self.inference = Durations()
        self.received_at: float | None = None
        self.interval = math.inf

    def receive(self, name: str, data: bytes) -> None:
        """Take a CDR message of the topic `name`; after the last one of a tick, `answer` is due.

        Raises:
            ValueError: If the message is invalid. It is counted and dropped.
        """
        try:
            stamp, vector = self._sources[name].decode(data)
        except ValueError:
            self.unusable += 1
            raise
        self.turned_back += stamp < self._newest.get(name, stamp)
        self._newest[name] = stamp
        vectors = self.join.add(name, stamp, vector)
        if vectors is not None:
            self._due, self._due_stamp = vectors, stamp

    def note_phase(self, phase: Phase, stamp: int) -> None:
        """Note that an episode starts or ends, from an `episode_status` stamped in nanoseconds."""
        if phase == 'finished':
            self._ends_at = stamp
        elif phase == 'reset':
            self._starts_at = stamp
            # Topics are not ordered: the first tick may have been answered before its status came.
            if self._answered is not None and self._answered[0] == stamp and not self._is_first:
                self._state = None
                with contextlib.suppress(ValueError):
                    self._command(self._answered[1])

    @property
    def is_due(self) -> bool:
        """True while `answer` has not yet tried the newest tick with messages of all topics."""
        return self._due is not None

    def answer(self) -> None:
        """Call the policy for the tick that is due and send its command; return if no tick is due.

        If the policy failed, later calls try the same tick again, once a second, until a newer tick
        is due. Otherwise a robot in lockstep would wait for ever.

        Raises:
            ValueError: If the policy fails or the observation is invalid. The error is counted.
        """
        if self._due is not None:
            vectors, self._due, self._asked = self._due, None, None
            self._asked = self._observed(vectors)
            now = self._clock()
            if self.received_at is not None:
                self.interval = now - self.received_at
            self.received_at = now
        elif self._asked is None or self._clock() < self._ask_again_at:
            return
        self._forget_last_episode()
        self._answer(self._asked)
        self._answered, self._asked = (self._due_stamp, self._asked), None

    def send_unsent(self) -> None:
        """Send the last command if it has not been sent, for example for lack of a subscriber."""
        if self._unsent is not None and self._send(self._unsent):
            self._unsent = None
            self.answered += 1

    def forget(self) -> None:
        """Forget all stamps, because the robot was started again."""
        self.join.forget()
        self._due = self._asked = self._unsent = self._answered = None
        self._starts_at = self._ends_at = -1

    def _forget_last_episode(self) -> None:
        """Clear the policy's state if an episode began since the last answered tick."""
        before, now = self._answered[0] if self._answered else -1, self._due_stamp
        self._is_first = before < self._starts_at <= now or before <= self._ends_at < now
        if self._is_first or self._answered is None:
            self._state = None

    def _observed(self, vectors: Vectors) -> Vectors:
        try:
            return self._assembler.assemble(vectors)
        except Exception as error:
            # Formulas of third-party tasks may raise anything.
            self.unusable += 1
            raise ValueError(f'no observation: {one_line(error)}') from None

    def _command(self, observation: Vectors) -> NDArray[np.float64]:
        """Return the policy's action as the values of a message on `commands`, (action size,)."""
        action, self._state = self.policy.predict(observation, self._state)
        command = command_from_action(self._robot, action.astype(np.float64))
        return np.asarray(command, dtype=np.float64)

    def _answer(self, observation: Vectors) -> None:
        began = self._clock()
        try:
            command = self._command(observation)
        except ValueError as error:
            self.failed += 1
            self.last_failure = str(error)
            self._ask_again_at = began + _ASK_AGAIN
            raise
        self.inference.add(self._clock() - began)
        self._unsent = self._commands.encode(self._due_stamp, command)
        self.send_unsent()
