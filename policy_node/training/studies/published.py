"""Published success rates that belong beside a benchmark table.

The paper itself gives no numbers, only curves, so what stands for it are re-runs of its code,
configuration and budget by others, and for the best known result whoever has it.
"""

from __future__ import annotations

from dataclasses import dataclass

EXACT = 'exact'
"""Read from a text, log, table or configuration file of the source."""
QUOTED = 'quoted'
"""Quoted second-hand from the source, whose own table was not checked."""
FIGURE = 'figure'
"""Read off a figure, within 0.01 to 0.02."""


@dataclass(frozen=True, slots=True)
class Published:
    """One number.

    Attributes:
        success: Success at the last step, as text.
        kind: `exact`, `quoted` or `figure`.
        source: Who, and after how much training.
    """

    success: str
    kind: str
    source: str

    def __str__(self) -> str:
        return f'{self.success} ({self.kind}; {self.source})'


_REACH = Published('solved', EXACT, 'Plappert et al. 2018, text: by all four arms')
_EBP = 'EBP, arXiv 1810.01363, its HER baseline, 19 CPUs, 5 seeds'
_MRL = 'spitis/mrl, HER + futureactual'
_USHER = 'schrammlb2/USHER_Implementation'

RERUN: dict[tuple[str, str], Published] = {
    **{('FetchReach', arm): _REACH for arm in ('her_sparse', 'her_dense')},
    **{('FetchReach', arm): _REACH for arm in ('ddpg_sparse', 'ddpg_dense')},
    ('FetchPush', 'her_sparse'): Published('about 0.99', QUOTED, "re-run at the paper's budget"),
    ('FetchPush', 'ddpg_sparse'): Published('0.05-0.08', FIGURE, f'{_USHER}, to 24k episodes'),
    ('FetchPickAndPlace', 'her_sparse'): Published('0.9378', QUOTED, _EBP),
    ('FetchSlide', 'her_sparse'): Published('about 0.75', QUOTED, "re-run at the paper's budget"),
    ('FetchSlide', 'ddpg_sparse'): Published('about 0.18', FIGURE, f'{_USHER}, 90k episodes'),
    ('HandManipulateBlockFull', 'her_sparse'): Published('0.2032', QUOTED, _EBP),
    ('HandManipulateEggFull', 'her_sparse'): Published('0.7619', QUOTED, _EBP),
    ('HandManipulatePenRotate', 'her_sparse'): Published('0.2728', QUOTED, _EBP),
}
"""The paper's arms by task and arm, re-run by others at its budget or about it."""

BEST: dict[str, Published] = {
    'FetchReach': Published('1.00', EXACT, 'rl-baselines3-zoo TQC/SAC + HER, 3,000 episodes'),
    'FetchPush': Published('0.994 +- 0.009', EXACT, 'VladPrytula/robotics_series, SAC, v4, 2M'),
    'FetchPickAndPlace': Published('1.000', EXACT, 'VladPrytula/robotics_series, SAC, v4, 5M'),
    'FetchSlide': Published('0.88', FIGURE, f'{_MRL}, 2.5M'),
    'HandReach': Published('about 0.40', QUOTED, 'VDS, 2M'),
    'HandManipulateBlockFull': Published('0.675', FIGURE, f'{_MRL}, 40M'),
    'HandManipulateEggFull': Published('0.93', FIGURE, f'{_MRL}, 40M'),
    'HandManipulatePenRotate': Published('0.3169', QUOTED, 'EBP, arXiv 1810.01363, 38M'),
    'HandManipulatePenFull': Published('0.48', FIGURE, f'{_MRL}, 40M'),
}
"""Best known by task, with any method and budget."""

CEILINGS: dict[str, float] = {
    'HandReach': 0.957,
    'HandManipulatePenRotate': 0.925,
    'HandManipulatePenFull': 0.926,
}
"""Share of goals that can be reached at all, where it was computed (docs/training.md, Ceilings)."""
