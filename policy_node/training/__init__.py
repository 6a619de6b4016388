"""DDPG with hindsight experience replay on the batched simulation, and its evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from policy_node.training.train_function import Run, train

__all__ = ['Run', 'train']


def __getattr__(name: str) -> Any:
    # Commands check their arguments before torch is imported.
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from importlib import import_module

    from node_runtime.command_line import UsageError, require_extra

    try:
        require_extra('train')
    except UsageError as error:
        # Name the missing extra.
        raise ModuleNotFoundError(str(error)) from None
    return getattr(import_module('policy_node.training.train_function'), name)
