"""What can go wrong with an episode file. Every message is one line that no terminal obeys."""

from __future__ import annotations

from msgs_spec.text import printable


class EpisodeLogError(RuntimeError):
    """An episode cannot be written; the message is one line with path and reason."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class EpisodeExistsError(EpisodeLogError):
    """The name is taken by a finished episode, or by one being written."""


class EpisodeInUseError(EpisodeLogError):
    """Another process writes or recovers the episode, or has just completed it."""


class EpisodeReadError(ValueError):
    """A file is not a complete, undamaged episode; the message is one line with path and reason."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))
