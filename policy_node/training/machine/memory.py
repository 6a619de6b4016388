"""Whether a replay that fills slowly will fit: nothing refuses memory until it is touched."""

from __future__ import annotations

from pathlib import Path

_MEMINFO = Path('/proc/meminfo')
# What a container may hold and holds (cgroup v2).
_CONTAINER = Path('/sys/fs/cgroup')
_GB = 1e9


def available_memory() -> int | None:
    """Bytes that this process can still take without swapping; None where nothing says so."""
    found = [limit for limit in (_of_the_machine(), _of_the_container()) if limit is not None]
    return min(found, default=None)


def why_too_large(needed: int, available: int | None) -> str:
    """Returns a warning that a replay of so many bytes outgrows the memory, '' if it fits."""
    if available is None or needed <= available:
        return ''
    return (
        f'the replay grows to {needed / _GB:.1f} GB and {available / _GB:.1f} GB are free; '
        'a smaller replay_transitions would fit'
    )


def _of_the_machine() -> int | None:
    try:
        lines = _MEMINFO.read_text().splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith('MemAvailable:'))
        return int(kilobytes) * 1024
    except (OSError, StopIteration, ValueError):
        return None


def _of_the_container() -> int | None:
    try:
        limit = int((_CONTAINER / 'memory.max').read_text())
        return max(limit - int((_CONTAINER / 'memory.current').read_text()), 0)
    except (OSError, ValueError):
        return None
