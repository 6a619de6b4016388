"""One row of a run's log: what a cycle collected, learnt and cost."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from policy_node.training.evaluation.episodes import EpisodeOutcomes, diagnose
from policy_node.training.evaluation.evaluator import success_rate
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.runs.training_state import Counters


def progress_row(
    counters: Counters,
    train_success: float,
    outcomes: EpisodeOutcomes | None,
    success_rule: str,
    losses: Sequence[Losses],
) -> dict[str, float | None]:
    """Returns columns of `run_log.COLUMNS`, all but speeds; what is None or missing stays empty.

    Args:
        counters: How far the run is.
        train_success: Share of the episodes collected that ended in success.
        outcomes: The evaluation, where one was due.
        success_rule: By which it counts.
        losses: Those of each update.
    """

    def mean(name: str) -> float | None:
        return float(torch.stack([getattr(x, name) for x in losses]).mean()) if losses else None

    return {
        'seconds': counters.seconds,
        'env_steps': counters.env_steps,
        'episodes': counters.episodes,
        'updates': counters.updates,
        'train_success': train_success,
        'narrowing_steps': counters.narrowing_steps,
        **({} if outcomes is None else _evaluated(outcomes, success_rule)),
        'critic_loss': mean('critic'),
        'actor_loss': mean('actor'),
        'mean_value': mean('value'),
        'processor_seconds': counters.processor_seconds,
    }


def _evaluated(outcomes: EpisodeOutcomes, success_rule: str) -> dict[str, float]:
    """Columns of an evaluation: success, and why episodes failed."""
    found = {
        'success': success_rate(outcomes, success_rule),
        'episodes': len(outcomes),
        'touched': float(outcomes.touched.mean()),
        **diagnose(outcomes),
    }
    return {f'eval_{name}': value for name, value in found.items() if name != 'long_way_share'}
