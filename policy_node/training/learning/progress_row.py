"""One row of a run's log: what a cycle collected, learnt and cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from policy_node.training.evaluation.episodes import EpisodeOutcomes, diagnose
from policy_node.training.evaluation.evaluator import success_rate
from policy_node.training.learning.actor_critic import Losses
from policy_node.training.learning.training_state import Counters


@dataclass(frozen=True, slots=True)
class Speed:
    """What a cycle got done.

    Attributes:
        seconds: Its duration.
        env_steps: Environment steps of all workers.
        samples: Transitions learnt from, of all workers.
    """

    seconds: float
    env_steps: int
    samples: int


def progress_row(
    counters: Counters,
    train_success: float,
    outcomes: EpisodeOutcomes | None,
    success_rule: str,
    losses: Sequence[Losses],
    speed: Speed,
) -> dict[str, float | None]:
    """Returns the columns of `run_log.COLUMNS`; None leaves one empty.

    Args:
        counters: How far the run is.
        train_success: Share of the episodes collected that ended in success.
        outcomes: The evaluation, where one was due.
        success_rule: By which it counts.
        losses: Those of each update.
        speed: What the cycle got done.
    """

    def mean(name: str) -> float | None:
        return float(torch.stack([getattr(x, name) for x in losses]).mean()) if losses else None

    evaluated = None if outcomes is None else success_rate(outcomes, success_rule)
    return {
        'seconds': counters.seconds,
        'env_steps': counters.env_steps,
        'episodes': counters.episodes,
        'updates': counters.updates,
        'train_success': train_success,
        'narrowing_steps': counters.narrowing_steps,
        'eval_success': evaluated,
        'eval_episodes': None if outcomes is None else len(outcomes),
        **_diagnostics(outcomes),
        'critic_loss': mean('critic'),
        'actor_loss': mean('actor'),
        'mean_value': mean('value'),
        'steps_per_second': speed.env_steps / speed.seconds,
        'samples_per_second': speed.samples / speed.seconds,
        'processor_seconds': counters.processor_seconds,
    }


def _diagnostics(outcomes: EpisodeOutcomes | None) -> dict[str, float | None]:
    """Columns that say why evaluated episodes failed."""
    if outcomes is None:
        return {}
    found = {'touched': float(outcomes.touched.mean()), **diagnose(outcomes)}
    return {f'eval_{name}': value for name, value in found.items() if name != 'long_way_share'}
