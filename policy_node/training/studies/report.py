"""Tables and figures of studies, derived from their stored runs."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.datasets.writing import alone_in
from msgs_spec.arrays import Array
from policy_node.policies.files import to_csv, write_files
from policy_node.training.studies.measures import (
    GOOD_SUCCESS,
    Curve,
    area_in_time,
    compared,
    is_significant,
    sum_up,
)
from policy_node.training.studies.store import Run, in_order, read_runs
from policy_node.training.studies.study import Study

# The page of a study keeps its table between these lines.
BEGIN, END = '<!-- table: written by `benchmark` -->', '<!-- end of the table -->'
ARMS, FIGURE, PAGE = 'arms.csv', 'figure.png', 'README.md'
# Fewer seeds support no claim.
_ENOUGH_SEEDS = 5
# Okabe and Ito 2008: safe for colour blindness. Further curves are dashed.
_COLORS = ('#000000', '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#56B4E9', '#E69F00')
# Most curves of one panel.
_MOST_LINES = 5

Bands = Mapping[str, Mapping[str, 'Band']]
"""Bands by task and variant."""


@dataclass(frozen=True, slots=True)
class Band:
    """Median and quartiles of success over seeds at the same environment steps, each (n,)."""

    env_steps: Array
    median: Array
    lower: Array
    upper: Array


def write_study(study: Study, output: Path) -> None:
    """Write tables and figure of a study into its folder `output`; do nothing if it has no runs.

    `arms.csv` holds medians and quartiles. `README.md` keeps what the user wrote around its table.

    Raises:
        ValueError: If a stored run cannot be read.
        OSError: If a file cannot be written; the files of the earlier report stay.
    """
    with alone_in(output):
        runs = in_order(read_runs(output).values(), study)
        if not runs:
            return
        arms = sum_up_arms(study, runs)
        labels = {arm.name: arm.label for arm in study.arms}
        page, table = output / PAGE, format_study(study, arms)
        contents = {
            ARMS: arms_csv(arms),
            FIGURE: draw(_bands(runs), labels),
            PAGE: _with_table(page.read_text() if page.is_file() else '', table),
        }
        write_files({output / name: content for name, content in contents.items()})


def sum_up_arms(study: Study, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the rows of `arms.csv` with medians, quartiles and p-values by task and variant."""
    first = study.arms[0].name
    order = [arm.name for arm in study.arms]
    rows = []
    for of_task in _grouped(runs, 'task').values():
        arms = _grouped(of_task, 'arm')
        names = sorted(arms, key=lambda name: order.index(name) if name in order else len(order))
        # The first variant, usually the baseline, sets the time in which areas are compared.
        seconds = {
            machine: float(np.median([run['processor_seconds'] for run in group]))
            for machine, group in _grouped(arms[names[0]], 'machine').items()
        }
        measured = {name: [_timed(run, seconds) for run in arms[name]] for name in names}
        baseline = measured.get(first, [])
        for name, group in measured.items():
            rows.append(sum_up(group) | compared(group, [] if name == first else baseline))
    return rows


def arms_csv(arms: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the rows of `sum_up_arms` as the contents of `arms.csv`."""
    return to_csv(list(arms[0]), (list(row.values()) for row in arms))


def _grouped(runs: Sequence[Run], name: str) -> dict[str, list[Run]]:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run[name], []).append(run)
    return groups


def _timed(run: Run, seconds: Mapping[str, float]) -> Run:
    """Return a copy of a run with `area_in_time`, its mean success in the baseline's CPU time.

    Args:
        seconds: Median CPU time of the baseline, s, by machine. If it lacks the machine of
            `run`, `area_in_time` is None.
    """
    known = seconds.get(run['machine'])
    return {**run, 'area_in_time': None if known is None else area_in_time(run, known)}


def _bands(runs: Sequence[Run]) -> dict[str, dict[str, Band]]:
    return {
        task: {arm: aggregate(list(map(Curve.of, group))) for arm, group in arms.items()}
        for task, arms in ((t, _grouped(r, 'arm')) for t, r in _grouped(runs, 'task').items())
    }


def aggregate(curves: Sequence[Curve]) -> Band:
    """Return median and quartiles of success at the steps that all curves cover.

    Resumed runs are evaluated at other steps, so values between evaluations are interpolated.
    """
    first = max(float(curve.env_steps[0]) for curve in curves)
    last = min(float(curve.env_steps[-1]) for curve in curves)
    steps = np.unique(np.concatenate([curve.env_steps for curve in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    values = np.stack([np.interp(steps, curve.env_steps, curve.success) for curve in curves])
    lower, median, upper = np.percentile(values, [25, 50, 75], axis=0)
    return Band(steps, median, lower, upper)


def format_study(study: Study, arms: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table with one line for each row in `arms`, a result of `sum_up_arms`."""
    labels = {arm.name: arm.label for arm in study.arms}
    lines = [
        f'| task | variant | seeds | area | steps to {GOOD_SUCCESS} (reached) | final success '
        '| CPU time, s | area in equal time | samples per s | against the baseline |',
        '| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    for row in arms:
        steps = row[f'steps_to_{GOOD_SUCCESS}_median']
        cells = [
            row['task'],
            f'`{row["arm"]}`: {labels.get(row["arm"], "former variant")}',
            str(row['seeds']),
            _quartiles(row, 'area'),
            f'{steps:,} ({row["reached"]})' if steps != '' else f'censored ({row["reached"]})',
            _quartiles(row, 'final_success'),
            *_times(row),
            _against(study, row, arms),
        ]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def _times(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return cells of CPU time, area in equal time and samples per second; dashes if not timed."""
    if not row['timed']:
        return ('-',) * 3
    some = '' if row['timed'] == row['seeds'] else f', of {row["timed"]}'
    return (
        f'{row["processor_seconds_median"]:.0f}{some}',
        _quartiles(row, 'area_in_time') + some,
        f'{row["samples_per_processor_second_median"]:,.0f}{some}',
    )


def _against(study: Study, row: Mapping[str, Any], arms: Sequence[Mapping[str, Any]]) -> str:
    """Return the table cell with the measures in which a variant is better or worse.

    Only significant differences from the baseline count. With fewer than five seeds, the cell
    contains a note instead. The cell is empty for the baseline, or if the baseline has no runs.
    """
    base = study.arms[0].name
    found = [other for other in arms if (other['task'], other['arm']) == (row['task'], base)]
    if row['arm'] == base or not found:
        return ''
    if min(row['seeds'], found[0]['seeds']) < _ENOUGH_SEEDS:
        return 'fewer than five seeds'
    words = []
    for name, label, runs in (
        ('area', 'area', 'seeds'),
        ('area_in_time', 'area in time', 'timed'),
        ('final_success', 'final', 'seeds'),
    ):
        enough = min(row[runs], found[0][runs]) >= _ENOUGH_SEEDS
        if enough and is_significant(row, found[0], name):
            better = row[f'{name}_median'] > found[0][f'{name}_median']
            words.append(f'{label} {"better" if better else "worse"}')
    return ', '.join(words) or 'no significant difference'


def _quartiles(row: Mapping[str, Any], name: str) -> str:
    values = [row[f'{name}_{part}'] for part in ('median', 'lower', 'upper')]
    return '-' if '' in values else '{:.3f} ({:.3f} ... {:.3f})'.format(*values)


def _with_table(page: str, table: str) -> bytes:
    """Return the text of a page with `table` between the lines `BEGIN` and `END`, as bytes.

    An empty page gets these lines and the table. Another page without the lines stays unchanged.
    """
    text = page or f'{BEGIN}\n{END}\n'
    if BEGIN in text and END in text:
        before, after = text.split(BEGIN)[0], text.split(END, 1)[1]
        text = f'{before}{BEGIN}\n{table}{END}{after}'
    return text.encode()


def draw(bands: Bands, labels: Mapping[str, str]) -> bytes:
    """Return a PNG with the median and the quartiles of each variant.

    A task has one panel for up to five variants. With more variants, each has a panel of its own,
    which also shows the first variant, the baseline.

    Args:
        bands: Median and quartiles by task and variant.
        labels: Label of each variant by name, the baseline first. The order determines the colours.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    top = _top_of_axis(bands)
    shown = [panel for task, arms in bands.items() for panel in _panels(task, arms, labels)]
    is_small = len(shown) > len(bands)
    columns = min(len(shown), 4)
    rows = -(-len(shown) // columns)
    width, height = (3.4, 2.7) if is_small else (4.6, 3.9)
    figure = Figure(figsize=(width * columns + 0.8, height * rows + 0.5), layout='constrained')
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    for axes, (task, title, names) in zip(panels, shown, strict=False):
        for index, (arm, label) in enumerate(labels.items()):
            if arm in names:
                band, color = bands[task][arm], _COLORS[index % len(_COLORS)]
                style = '--' if index >= len(_COLORS) else '-'
                axes.fill_between(band.env_steps, band.lower, band.upper, color=color, alpha=0.2)
                axes.plot(band.env_steps, band.median, style, color=color, label=label)
        axes.set(xlabel='environment steps (40 ms)', ylabel='success at the last step')
        axes.set_ylim(-0.02 * top, 1.02 * top)
        axes.xaxis.set_major_formatter(EngFormatter(sep=''))
        axes.grid(alpha=0.3)
        axes.set_title(title, fontsize='small' if is_small else 'medium')
    _add_legend(figure, list(panels[: len(shown)]), columns)
    file = io.BytesIO()
    figure.savefig(file, dpi=110 if is_small else 130)
    return file.getvalue()


def _panels(
    task: str, arms: Mapping[str, Band], labels: Mapping[str, str]
) -> list[tuple[str, str, list[str]]]:
    """Divide the variants of a task among panels; return each panel's task, title and variants."""
    names = [name for name in labels if name in arms]
    if len(names) <= _MOST_LINES:
        return [(task, task, names)]
    baseline, *others = names
    return [(task, f'{task}: {labels[name]}', [baseline, name]) for name in others]


def _add_legend(figure: Any, panels: Sequence[Any], columns: int) -> None:
    """Add a legend below all panels."""
    named: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= zip(labels, handles, strict=True)
    lines = -(-len(named) // columns)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.2 * lines)
    place = {'loc': 'outside lower center', 'ncols': columns}
    figure.legend(named.values(), named.keys(), fontsize='small', **place)


def _top_of_axis(bands: Bands) -> float:
    """Return the upper limit of the success axis: 1, or less if no upper quartile exceeds 0.4."""
    # Curves without a common step have an empty band.
    tops = [band.upper for arms in bands.values() for band in arms.values() if band.upper.size]
    highest = max((float(upper.max()) for upper in tops), default=0.0)
    return 1.0 if highest > 0.4 else max(1.25 * highest, 0.05)
