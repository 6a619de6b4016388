"""From the bytes of a robot's topics to the bytes of a command. Knows nothing of ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from msgs_spec.cdr import TopicCodec
from msgs_spec.diagnostics import Durations
from msgs_spec.observations import ObservationAssembler
from msgs_spec.tasks import task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import topic
from policy_node.node.commander import Commander
from policy_node.node.stamp_join import StampJoin


class Responder:
    """Answers each complete tick of one robot with one command.

    Args:
        commander: Who decides.
        status: What the robot said of itself.
        send: Takes the CDR bytes of a command; False if nobody listens yet.
        clock: A steady clock, seconds.

    Attributes:
        commander: Who decides.
        topics: The topics it needs.
        join: Joins them by stamp.
        answered: Commands sent.
        unusable: Messages that could not be read, or held a value that is not finite.
        inference: Wall time from a complete observation to its command.
        received_at: When the last observation was complete, seconds of the clock.
        interval: Seconds between the last two; infinite before.
    """

    def __init__(
        self,
        commander: Commander,
        status: EpisodeStatus,
        send: Callable[[bytes], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.commander = commander
        spec = task_spec(status.task, status.joint_prefix)
        self._assembler = ObservationAssembler(spec, status.control_hz)
        self._send = send
        self._clock = clock
        self._commands = TopicCodec(topic(spec, 'commands'))
        self._sources = {source.name: TopicCodec(source) for source in self._assembler.topics}
        self._unsent: bytes | None = None
        self.topics = self._assembler.topics
        self.join = StampJoin(source.name for source in self.topics)
        self.answered = 0
        self.unusable = 0
        self.inference = Durations()
        self.received_at: float | None = None
        self.interval = math.inf

    def receive(self, name: str, data: bytes) -> None:
        """Takes one message; the one that completes a tick is answered.

        Args:
            name: Its topic.
            data: Its CDR bytes.

        Raises:
            ValueError: If the message cannot be used, in one line; it is counted and dropped.
        """
        try:
            stamp, vector = self._sources[name].decode(data)
            vectors = self.join.add(name, stamp, vector)
            if vectors is not None:
                self._answer(self._assembler.assemble(vectors))
        except ValueError:
            self.unusable += 1
            raise

    def send_unsent(self) -> None:
        """Sends the last command if nobody has heard it yet."""
        if self._unsent is not None and self._send(self._unsent):
            self._unsent = None
            self.answered += 1

    def forget(self) -> None:
        """Starts anew with a robot that did: its stamps begin again."""
        self.join.forget()
        self._unsent = None

    def _answer(self, observation: dict[str, NDArray[np.float64]]) -> None:
        began = self._clock()
        if self.received_at is not None:
            self.interval = began - self.received_at
        self.received_at = began
        command = self.commander.command(observation)
        self.inference.add(self._clock() - began)
        self._unsent = self._commands.encode(0, command)
        self.send_unsent()
