"""Sizes that robots, writers and readers agree on: nothing is written that a reader refuses.

The largest episode this project writes by itself has 1,400 messages, 0.4 MB. What a robot receives
is anybody's, so it has an allowance of its own, and a flood on one topic takes nothing from the
others.
"""

from __future__ import annotations

from collections import Counter

from msgs_spec.schemas import MAX_MESSAGE_BYTES

# Messages of a file, and the topics they belong to.
MAX_MESSAGES = 50_000
MAX_TOPICS = 64
# A chunk, and all chunks of a file together, unpacked.
MAX_CHUNK_BYTES = 16 * 2**20
MAX_UNPACKED_BYTES = 16 * 2**20
# Chunks of a file; each has an entry of some 250 bytes in the summary.
MAX_CHUNKS = 10_000
MAX_SUMMARY_BYTES = 4 * 2**20
# Records outside of chunks: each chunk is followed by an index of each of its topics.
MAX_RECORDS = 300_000
# A metadata record, and what a writer takes for it, which YAML may write ten times as long.
MAX_RECORD_BYTES = 2**20
MAX_METADATA_BYTES = 2**16
# Metadata records of a file; a robot writes two, and rosbag2 another.
MAX_METADATA_RECORDS = 16
# All attachments of a file, and the file; a compiled model has 3 MB.
MAX_ATTACHMENT_BYTES = 64 * 2**20
MAX_FILE_BYTES = 128 * 2**20

# What is logged of that a robot receives on one topic in one episode; it listens to four.
MAX_RECEIVED_MESSAGES = MAX_MESSAGES // 10
MAX_RECEIVED_BYTES = MAX_UNPACKED_BYTES // 8


class ReceivedAllowance:
    """Says which received messages of an episode are logged; the others are counted.

    Attributes:
        omitted: Messages that are not logged, by topic.
    """

    def __init__(self) -> None:
        self.omitted: Counter[str] = Counter()
        self._messages: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()

    def takes(
        self, topic: str, size: int, has_room: bool = True, *, is_refused: bool = False
    ) -> bool:
        """Whether a message of `size` bytes is logged; only if the file has room for it.

        Those that the robot refused get half of the allowance at most, so that a flood of them
        takes no room from what decides the episode, and are counted as `<topic> (refused)`.
        """
        share = 2 if is_refused else 1
        if (
            not has_room
            or size > MAX_MESSAGE_BYTES
            or self._messages[topic] >= MAX_RECEIVED_MESSAGES // share
            or self._bytes[topic] + size > MAX_RECEIVED_BYTES // share
        ):
            self.omitted[f'{topic} (refused)' if is_refused else topic] += 1
            return False
        self._messages[topic] += 1
        self._bytes[topic] += size
        return True
