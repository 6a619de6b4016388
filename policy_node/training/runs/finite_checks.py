"""End a run when a number is not finite, before it is saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import nn

from policy_node.training.experience.replay import Episodes
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.runs.training_state import Counters, first_not_finite


class TrainingError(RuntimeError):
    """Training cannot continue; the message contains the step and the cause."""


def require_finite_episodes(episodes: Episodes, counters: Counters) -> None:
    """Raise `TrainingError` if an episode has a value that is not finite."""
    for name in ('observation', 'achieved_goal', 'desired_goal', 'action'):
        if not np.isfinite(getattr(episodes, name)).all():
            raise TrainingError(
                f'{name} is not finite after {counters.env_steps} environment steps'
            )


def require_finite_losses(losses: Sequence[Losses], counters: Counters) -> None:
    """Raise `TrainingError` if a loss of the newest updates is not finite."""
    first = counters.updates - len(losses)
    for name in ('critic', 'actor'):
        values = [getattr(loss, name) for loss in losses]
        finite = torch.isfinite(torch.stack(values)).tolist() if values else []
        if not all(finite):
            index = finite.index(False)
            raise TrainingError(
                f'{name} loss is {float(values[index])} in update {first + index + 1}, '
                f'after {counters.env_steps} environment steps'
            )


def require_finite_networks(modules: Mapping[str, nn.Module], counters: Counters) -> None:
    """Raise `TrainingError` if a weight is not finite; the loss may still have been finite."""
    for name, module in modules.items():
        if key := first_not_finite(module.state_dict()):
            raise TrainingError(
                f'{name}.{key} is not finite after update {counters.updates}, '
                f'after {counters.env_steps} environment steps'
            )
