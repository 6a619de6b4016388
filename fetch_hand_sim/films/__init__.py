"""Pictures and films of episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fetch_hand_sim.films.playing import Film, film_episode

__all__ = ['Film', 'film_episode']


def __getattr__(name: str) -> Any:
    # Commands check their arguments before they load the renderer.
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from importlib import import_module

    return getattr(import_module('fetch_hand_sim.films.playing'), name)
