"""The actors that come with the package; looking does not load torch."""

from __future__ import annotations

from pathlib import Path


def shipped_actors() -> dict[str, Path]:
    """Returns task name -> checkpoint of the actors that come with the package."""
    folder = Path(__file__).parents[1] / 'actors'
    # `<task>.training.safetensors` holds the critic of an actor.
    files = sorted(folder.glob('*.safetensors'))
    return {path.stem: path for path in files if '.' not in path.stem}
