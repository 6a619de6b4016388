"""How episodes are written, and what is stored beside the messages."""

from __future__ import annotations

from dataclasses import dataclass

from fetch_hand_sim.episode_log.bag_file import COMPRESSIONS, Compression
from fetch_hand_sim.episode_log.limits import MAX_CHUNK_BYTES


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file stored with the episode.

    Attributes:
        name: File name.
        media_type: MIME type.
        data: Contents.
    """

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class LogSettings:
    """How episodes are written.

    Attributes:
        chunk_size: Bytes of messages per chunk, less than half of what readers take; small chunks
            keep the longest write short.
        compression: Of the chunks: 'none', 'lz4' or 'zstd'.
        flush_period_ns: Simulated time after which messages are handed to the operating system, in
            nanoseconds. The first tick after it does that, so a killed process loses up to a tick
            more: less than a quarter of a second at the lowest rate, 12.5 Hz.
        minimum_free_bytes: No episode is begun with less than this left on the disk.

    Raises:
        ValueError: If a value is out of range.
    """

    chunk_size: int = 128 * 1024
    compression: Compression = 'lz4'
    flush_period_ns: int = 150_000_000
    minimum_free_bytes: int = 64 * 1024 * 1024

    def __post_init__(self) -> None:
        if self.compression not in COMPRESSIONS:
            allowed = ', '.join(COMPRESSIONS)
            raise ValueError(f'unknown compression {self.compression!r}; allowed: {allowed}')
        if self.chunk_size > MAX_CHUNK_BYTES // 2:
            raise ValueError(f'chunk_size {self.chunk_size}; allowed: to {MAX_CHUNK_BYTES // 2}')
        if self.chunk_size < 1 or self.flush_period_ns < 1 or self.minimum_free_bytes < 0:
            raise ValueError(
                f'chunk_size {self.chunk_size} and flush_period_ns {self.flush_period_ns} must be '
                f'positive, minimum_free_bytes {self.minimum_free_bytes} not negative'
            )
