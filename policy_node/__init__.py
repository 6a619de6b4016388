"""Actors trained with hindsight experience replay, and the ROS node that runs them.

Importing this package is light: torch is loaded with the first actor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor, load_actor

__all__ = ['Actor', 'load_actor']


def __getattr__(name: str) -> Any:
    if name in __all__:
        from policy_node.policies import actor

        return getattr(actor, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
