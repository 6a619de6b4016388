"""Draw docs/research/effects.png: the effect of every variant with its interval, all studies.

`python tools/study_effects.py`. The effect is the difference of the mean area to the baseline of
the same study and task. The interval holds 95 % of 10,000 bootstrap samples of seeds. The rule of
significance is that of the tables: quartiles that do not touch, and an exact rank-sum test.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from policy_node.training.studies.measures import is_significant
from policy_node.training.studies.report import sum_up_arms
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.store import in_order, read_runs

RESEARCH = Path(__file__).resolve().parent.parent / 'docs' / 'research'
_ENOUGH_SEEDS = 5
# Blue and grey of Okabe and Ito's palette, which colour-blind readers can tell apart.
_CLEAR, _UNCLEAR = '#0072B2', '#999999'

# Width in inches: on a phone of 390 px, 8 points become 8 px.
_WIDTH, _ROW = 5.2, 0.19

Effect = tuple[str, float, float, float, bool]
"""Task and variant, mean difference of the area, the ends of its interval, and significance."""


def effects(study: str) -> list[Effect]:
    """Return the effects of a study's variants that have five seeds beside a baseline of five."""
    areas: dict[tuple[str, str], list[float]] = {}
    runs = in_order(read_runs(RESEARCH / study).values(), STUDIES[study])
    for run in runs:
        areas.setdefault((run['task'], run['arm']), []).append(run['area'])
    rows = {(row['task'], row['arm']): row for row in sum_up_arms(STUDIES[study], runs)}
    baseline = STUDIES[study].arms[0].name
    found = []
    for (task, variant), values in areas.items():
        base = areas.get((task, baseline), [])
        if variant != baseline and min(len(values), len(base)) >= _ENOUGH_SEEDS:
            low, high = interval(values, base)
            name = f'{task}: {variant}'
            clear = is_significant(rows[task, variant], rows[task, baseline], 'area')
            found.append((name, float(np.mean(values) - np.mean(base)), low, high, clear))
    return found


def interval(values: list[float], base: list[float]) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the difference of two means."""
    random = np.random.default_rng(0)
    means = [random.choice(each, (10_000, len(each))).mean(axis=1) for each in (values, base)]
    low, high = np.percentile(means[0] - means[1], [2.5, 97.5])
    return float(low), float(high)


def draw(studies: dict[str, list[Effect]]) -> Figure:
    """Return a forest plot, one panel per study; differences that are not significant are grey."""
    sizes = [len(rows) for rows in studies.values()]
    height = _ROW * (sum(sizes) + 2 * len(sizes)) + 0.5
    figure = Figure(figsize=(_WIDTH, height), layout='constrained')
    panels = figure.subplots(len(sizes), sharex=True, height_ratios=sizes)
    for axes, (study, rows) in zip(panels, studies.items(), strict=True):
        for place, (_, mean, low, high, clear) in enumerate(rows):
            color = _CLEAR if clear else _UNCLEAR
            axes.plot([low, high], [place, place], color=color, linewidth=1.5)
            axes.plot([mean], [place], 'o', color=color, markersize=4)
        axes.axvline(0, color='black', linewidth=0.8)
        axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=8)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        title = f'{study}, compared with {STUDIES[study].arms[0].name}'
        axes.set_title(title, fontsize=9, loc='left')
        axes.grid(axis='x', alpha=0.3)
    panels[-1].set_xlabel('difference of the area, 95 % interval', fontsize=9)
    return figure


def main() -> int:
    """Write the figure; return the exit code."""
    names = [name for name in STUDIES if (RESEARCH / name / 'runs.jsonl').is_file()]
    studies = {name: rows for name in names if (rows := effects(name))}
    draw(studies).savefig(RESEARCH / 'effects.png', dpi=150)
    count = sum(map(len, studies.values()))
    print(f'{count} comparisons in {RESEARCH / "effects.png"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
