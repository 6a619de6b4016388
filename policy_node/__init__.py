"""Actors trained with hindsight experience replay, and the ROS node that runs them.

Importing this package is light: torch is loaded with the first actor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from msgs_spec.loading import guard_loading

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor
    from policy_node.policies.loading import load_actor, load_policy
    from policy_node.training.train import train

__all__ = ['Actor', 'load_actor', 'load_policy', 'train']

# Where they are.
_MODULES = {
    'Actor': 'policies.actor',
    'load_actor': 'policies.loading',
    'load_policy': 'policies.loading',
    'train': 'training.train',
}

# Before anything that takes long to import.
guard_loading()


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from importlib import import_module

    if name == 'train':
        _require_training()
    return getattr(import_module(f'policy_node.{_MODULES[name]}'), name)


def _require_training() -> None:
    """Names the extra that is missing, where Python would name one of its modules."""
    from msgs_spec.command_line import UsageError, require_extra

    try:
        require_extra('train')
    except UsageError as error:
        raise ModuleNotFoundError(str(error)) from None
