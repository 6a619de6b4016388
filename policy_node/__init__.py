"""Actors trained with hindsight experience replay, and the ROS node that runs them.

Importing this package is fast, because torch is loaded only with the first actor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from node_runtime.signals import guard_loading

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor
    from policy_node.policies.loading import load_actor, load_policy

__all__ = ['Actor', 'load_actor', 'load_policy']

# Before anything that takes long to import.
guard_loading()


def __getattr__(name: str) -> Any:
    if name in __all__:
        from importlib import import_module

        module = 'actor' if name == 'Actor' else 'loading'
        return getattr(import_module(f'policy_node.policies.{module}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
