"""Numbers that are not finite end a run before they reach a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import nn

from policy_node.training.experience.replay import Episodes
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.runs.state_checks import first_not_finite
from policy_node.training.runs.training_state import Counters


class TrainingError(RuntimeError):
    """Training cannot go on; the message names the step and the cause."""


def require_finite_episodes(episodes: Episodes, counters: Counters) -> None:
    """Stops on the first episode that holds what is no number.

    Raises:
        TrainingError: If there is one.
    """
    for name in ('observation', 'achieved_goal', 'desired_goal', 'action'):
        if not np.isfinite(getattr(episodes, name)).all():
            raise TrainingError(
                f'{name} is not finite after {counters.env_steps} environment steps'
            )


def require_finite_losses(losses: Sequence[Losses], counters: Counters) -> None:
    """Stops on the first loss, of the newest updates, that is no number.

    Raises:
        TrainingError: If there is one.
    """
    first = counters.updates - len(losses)
    for name in ('critic', 'actor'):
        values = [getattr(loss, name) for loss in losses]
        finite = torch.isfinite(torch.stack(values)).tolist() if values else []
        if not all(finite):
            update = first + finite.index(False) + 1
            raise TrainingError(
                f'{name} loss is {float(values[finite.index(False)])} in update {update}, '
                f'after {counters.env_steps} environment steps'
            )


def require_finite_networks(modules: Mapping[str, nn.Module], counters: Counters) -> None:
    """Stops on networks that a step has ruined, also one down the gradient of a finite loss.

    Raises:
        TrainingError: If there is one.
    """
    for name, module in modules.items():
        if key := first_not_finite(module.state_dict()):
            raise TrainingError(
                f'{name}.{key} is not finite after update {counters.updates}, '
                f'after {counters.env_steps} environment steps'
            )
