"""What can go wrong with an episode file."""

from __future__ import annotations


class EpisodeLogError(RuntimeError):
    """An episode cannot be written; the message is one line with path and reason."""


class EpisodeExistsError(EpisodeLogError):
    """The name is taken by a finished episode, or by one being written."""


class EpisodeReadError(ValueError):
    """A file is not a complete, undamaged episode; the message is one line with path and reason."""
