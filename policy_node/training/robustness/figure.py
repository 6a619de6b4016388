"""Figures of robustness results: the curves of one policy, and the overview of many."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from msgs_spec.disturbances import PRESETS
from msgs_spec.tasks import task_spec
from policy_node.training.robustness.sweeps import KEPT, SWEEPS, Sweep, kept_up_to, sweeps_of

_COLUMNS = 4


def draw(result: Mapping[str, Any]) -> bytes:
    """Return a PNG with success and its 95 % interval over the level of each disturbance.

    `result` is the content of the .json file that `fetch_hand_sim robustness` writes.
    """
    from matplotlib.figure import Figure

    spec, found = task_spec(result['task']), result['points']
    sweeps = sweeps_of(spec)
    rows = -(-(len(sweeps) + 1) // _COLUMNS)
    figure = Figure(figsize=(3.2 * _COLUMNS, 2.5 * rows), layout='constrained')
    panels = list(figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False).ravel())
    undisturbed = found['none 0']
    for axes, sweep in zip(panels, sweeps, strict=False):
        measured = [undisturbed, *(found[f'{sweep.name} {level:g}'] for level in sweep.levels)]
        labels = ['none', *(f'{level:g}' for level in sweep.levels)]
        _panel(axes, labels, measured, undisturbed['success'])
        axes.set_title(f'{sweep.name}, {sweep.unit}', fontsize='small')
    presets = [undisturbed, *(found[f'{name} 1'] for name in PRESETS)]
    last = panels[len(sweeps)]
    _panel(last, ['none', *PRESETS], presets, undisturbed['success'])
    last.set_title('presets', fontsize='small')
    for axes in panels[len(sweeps) + 1 :]:
        axes.set_visible(False)
    figure.suptitle(
        f'{result["policy"]} on {spec.name}: success at the last step, {result["episodes"]} '
        f'episodes a point; dashed: {KEPT:.0%} of the undisturbed success; dotted: dropped',
        fontsize='medium',
    )
    file = io.BytesIO()
    figure.savefig(file, dpi=110)
    return file.getvalue()


def _panel(axes: Any, labels: list[str], measured: list[Any], undisturbed: float) -> None:
    places = range(len(labels))
    bounds = [each['success_interval_95'] for each in measured]
    axes.fill_between(places, [b[0] for b in bounds], [b[1] for b in bounds], alpha=0.2)
    axes.plot(places, [each['success'] for each in measured], 'o-', markersize=3)
    if any(each['dropped'] for each in measured):
        axes.plot(places, [each['dropped'] for each in measured], ':', color='C3')
    axes.axhline(KEPT * undisturbed, linestyle='--', linewidth=0.8, color='gray')
    axes.set_xticks(places, labels, fontsize='small')
    axes.set_ylim(-0.03, 1.03)


def draw_overview(results: Sequence[Mapping[str, Any]]) -> bytes:
    """Return a PNG table: the highest level of each disturbance that each policy withstands.

    Up to that level the policy keeps 90 % of its undisturbed success. `results` are as in `draw`.
    """
    from matplotlib.figure import Figure

    # Narrow enough for a phone, with a palette that colour-blind readers can tell apart.
    figure = Figure(figsize=(5.6, 1.6 + 0.24 * len(results)), layout='constrained')
    axes = figure.subplots()
    cells = [[_cell(result, sweep) for sweep in SWEEPS] for result in results]
    shares = [[share for share, _ in row] for row in cells]
    axes.imshow(shares, cmap='PuOr', vmin=-0.25, vmax=1.25, aspect='auto', alpha=0.6)
    for row, texts in enumerate(cells):
        for column, (_, text) in enumerate(texts):
            short = text.replace('0.', '.').replace(' ', '')
            axes.text(column, row, short, ha='center', va='center', fontsize=7)
    titles = [f'{sweep.name},\n{sweep.unit}' for sweep in SWEEPS]
    axes.set_xticks(range(len(SWEEPS)), titles, fontsize=7, rotation=90)
    axes.xaxis.tick_top()
    names = [each['policy'].removeprefix('HandManipulate') for each in results]
    axes.set_yticks(range(len(results)), names, fontsize=8)
    file = io.BytesIO()
    figure.savefig(file, dpi=150)
    return file.getvalue()


def _cell(result: Mapping[str, Any], sweep: Sweep) -> tuple[float, str]:
    """Return which share of the levels of `sweep` a policy withstands, and the highest as text.

    The text is `< <lowest level>` if even that level is too high. Return NaN and '' if the
    disturbance needs an object and the task has none.
    """
    if sweep not in sweeps_of(task_spec(result['task'])):
        return float('nan'), ''
    success = {key: point['success'] for key, point in result['points'].items()}
    level = kept_up_to(sweep, success, success['none 0'])
    if level is None:
        return 0.0, f'< {sweep.levels[0]:g}'
    return (sweep.levels.index(level) + 1) / len(sweep.levels), f'{level:g}'
