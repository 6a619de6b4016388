"""The actors that come with the package; looking does not load torch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from msgs_spec.text import did_you_mean

# What a run of `fetch_hand_sim train` leaves, and how the files of actors end.
_BEST_OF_A_RUN = 'best.safetensors'
_ENDINGS = ('.safetensors', '.onnx', '.zip')


def shipped_actors() -> dict[str, Path]:
    """Returns task name -> checkpoint of the actors that come with the package."""
    folder = Path(__file__).parents[1] / 'actors'
    # `<task>.training.safetensors` holds the critic of an actor.
    files = sorted(folder.glob('*.safetensors'))
    return {path.stem: path for path in files if '.' not in path.stem}


def shipped_name(task: str, kind: str) -> str:
    """Return the name of the shipped policy of a task: the usual one (kind ''), or `robust`."""
    return f'{task}_{kind}' if kind else task


def actor_path(name_or_path: str | Path, besides: Sequence[str] = ()) -> Path:
    """Returns the file called `name_or_path`: the name of a shipped actor, or a file.

    Args:
        name_or_path: The name or the file.
        besides: Names of what is no file and would have been taken as well, for the error.

    Raises:
        ValueError: If there is neither; the message lists the shipped actors, or names the actor
            in a folder that is a run.
    """
    shipped = shipped_actors()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path, reason = Path(os.path.expanduser(name_or_path)), ''
    try:
        if path.is_file():
            return path
        is_run = (path / _BEST_OF_A_RUN).is_file()
    except OSError as error:
        # Raised for a name that is too long, or a folder that may not be entered.
        is_run, reason = False, f' ({error.strerror})'
    if is_run:
        raise ValueError(f'no actor but a run: {path}; its best actor is {path / _BEST_OF_A_RUN}')
    if path.suffix in _ENDINGS:
        raise ValueError(f'no actor {str(path)!r}: there is no such file{reason}')
    names = ', '.join(shipped) or 'none'
    others = f', {", ".join(map(repr, besides[:-1]))} or {besides[-1]!r}' if besides else ''
    hint = did_you_mean(str(name_or_path), [*shipped, *besides])
    raise ValueError(
        f'no actor {str(name_or_path)!r}{reason}; shipped: {names}; '
        f'or the path of a file{others}{hint}'
    )
