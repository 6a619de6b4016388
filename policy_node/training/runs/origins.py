"""What a run started from, as the metadata and the JSON of actors tell it."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def steps_behind(run: dict[str, Any]) -> int:
    """Environment steps behind an actor and behind all that its training started from, each once.

    The best and the latest actor of a run are of one run: the later of them counts.

    Args:
        run: `env_steps` and `init_from`, as in the JSON of an actor.
    """
    counted: dict[object, int] = {}
    waiting = [run]
    while waiting:
        part = waiting.pop()
        steps = int(part['env_steps'])
        key = _run_of(part, steps)
        counted[key] = max(counted.get(key, 0), steps)
        waiting += [part['init_from']] if part.get('init_from') else []
        waiting += part.get('mean_of', [])
    return sum(counted.values())


def _run_of(part: dict[str, Any], steps: int) -> object:
    """What is the same for all actors of a run: its folder, where one is named."""
    name = part.get('name', '')
    if name and ',' not in name:
        if name.endswith('.safetensors'):
            return str(Path(name).parent)
        # A run by its folder has no file to tell the sum of.
        if 'sha256' not in part:
            return str(Path(name))
    return (part.get('sha256') or name, steps)
