"""The actors in this package, found without torch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from msgs_spec.text import did_you_mean

# The best actor of a run of `fetch_hand_sim train`, and the suffixes of policy files.
_BEST_OF_A_RUN = 'best.safetensors'
_SUFFIXES = ('.safetensors', '.onnx', '.zip')


def shipped_actors() -> dict[str, Path]:
    """Return task name -> checkpoint of the actors in this package."""
    folder = Path(__file__).parents[1] / 'actors'
    # `<task>.training.safetensors` contains the critic of an actor.
    files = sorted(folder.glob('*.safetensors'))
    return {path.stem: path for path in files if '.' not in path.stem}


def shipped_name(task: str, kind: str) -> str:
    """Return the name of the shipped policy of a task: the usual one (kind ''), or `robust`."""
    return f'{task}_{kind}' if kind else task


def actor_path(name_or_path: str | Path, others: Sequence[str] = ()) -> Path:
    """Return the file of a shipped actor, or the path if it is a file.

    Args:
        name_or_path: Name of a shipped actor, or a path.
        others: Further names that the caller accepts, for the error.

    Raises:
        ValueError: If neither exists. The message lists the shipped actors; for the folder of a
            run it names its best actor.
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
        # For example a name that is too long, or a folder without permission.
        is_run, reason = False, f' ({error.strerror})'
    if is_run:
        raise ValueError(
            f'{path} is a run, not an actor; its best actor is {path / _BEST_OF_A_RUN}'
        )
    if path.suffix in _SUFFIXES:
        raise ValueError(f'no actor {str(path)!r}: there is no such file{reason}')
    names = ', '.join(shipped) or 'none'
    choices = f', {", ".join(map(repr, others[:-1]))} or {others[-1]!r}' if others else ''
    hint = did_you_mean(str(name_or_path), [*shipped, *others])
    raise ValueError(
        f'no actor {str(name_or_path)!r}{reason}; shipped: {names}; '
        f'or the path of a file{choices}{hint}'
    )
