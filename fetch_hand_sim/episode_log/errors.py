"""Errors of episode files. Every message is one line of limited length that no terminal obeys."""

from __future__ import annotations

from msgs_spec.text import printable

# Characters of a message: the path at its beginning and the reason at its end are kept.
_LONGEST, _BEGINNING = 1000, 700


def _line(message: str) -> str:
    if len(message) > _LONGEST:
        message = f'{message[:_BEGINNING]} ... {message[_BEGINNING - _LONGEST :]}'
    return printable(message)


class EpisodeLogError(RuntimeError):
    """An episode cannot be written; the message is one line with path and reason."""

    def __init__(self, message: str) -> None:
        super().__init__(_line(message))


class EpisodeExistsError(EpisodeLogError):
    """The name belongs to a finished episode, or to one being written."""


class EpisodeInUseError(EpisodeLogError):
    """Another process writes or recovers the episode, or has just completed it."""


class EpisodeReadError(ValueError):
    """A file is no complete, undamaged episode; the message is one line with path and reason."""

    def __init__(self, message: str) -> None:
        super().__init__(_line(message))
