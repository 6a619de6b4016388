"""The actors that come with the package; looking does not load torch."""

from __future__ import annotations

from pathlib import Path


def shipped_actors() -> dict[str, Path]:
    """Returns task name -> checkpoint of the actors that come with the package."""
    folder = Path(__file__).parents[1] / 'actors'
    # `<task>.training.safetensors` holds the critic of an actor.
    files = sorted(folder.glob('*.safetensors'))
    return {path.stem: path for path in files if '.' not in path.stem}


def actor_path(name_or_path: str | Path) -> Path:
    """Returns the file called `name_or_path`: the name of a shipped actor, or a file.

    Raises:
        ValueError: If there is neither; the message lists the shipped actors.
    """
    shipped = shipped_actors()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path = Path(name_or_path)
    if path.is_file():
        return path
    names = ', '.join(shipped) or 'none'
    raise ValueError(f'no actor {str(name_or_path)!r}; shipped: {names}; or the path of a file')
