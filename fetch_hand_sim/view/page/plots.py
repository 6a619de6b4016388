"""Draw the curves of the page."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from fetch_hand_sim.view.page.command_panel import is_move
from fetch_hand_sim.view.picture import Graphs, Series
from msgs_spec.robots import CommandPart
from msgs_spec.tasks import TaskSpec

_HEIGHT = 140.0
_SECONDS = 8.0
# Space above and below the curves, as a share of their height.
_ROOM = 0.15


def draw_plots(spec: TaskSpec, graphs: Graphs, width: float) -> None:
    """Draw a plot for each curve of `graphs`; a command and its joint share a plot."""
    if graphs.distance is not None:
        curves = {'distance (m)': graphs.distance}
        _plot('##Distance', curves, width, threshold=spec.distance_threshold)
    if graphs.rotation is not None:
        curves = {'rotation (rad)': graphs.rotation}
        _plot('##Rotation', curves, width, threshold=spec.rotation_threshold)
    if graphs.reward is not None:
        _plot('##Reward', {'reward': graphs.reward}, width)
    if graphs.commands is not None and imgui.CollapsingHeader('Commands and joints'):
        for index, part in enumerate(spec.robot.command):
            _plot(
                f'{part.name.removeprefix("robot0:")} ({part.unit})',
                command_curves(part, graphs, index),
                width,
            )


def command_curves(part: CommandPart, graphs: Graphs, index: int) -> dict[str, Series]:
    """Return the curves of the command `index` and of its joint, if it drives one, by label."""
    assert graphs.commands is not None
    command = _column(graphs.commands, index)
    if is_move(part):
        return {'command, from where it is': command}
    curves = {'command': command}
    if graphs.positions is not None:
        is_joint = part.unit == 'rad'
        name = 'joint' if is_joint else 'fingers (1: 0.1 m apart)'
        curves[name] = _column(graphs.positions, index)
    return curves


def value_limits(
    curves: Iterable[Series], threshold: float | None, begin: float, end: float
) -> tuple[float, float]:
    """Return (lower, upper) y limits for the threshold and the curves from `begin` to `end`, s."""
    parts = [each.values[(each.times >= begin) & (each.times <= end)] for each in curves]
    values = np.concatenate([*parts, [] if threshold is None else [threshold]])
    values = values[np.isfinite(values)]
    lower, upper = (values.min(), values.max()) if len(values) else (0.0, 1.0)
    room = _ROOM * ((upper - lower) or 1.0)
    return float(lower - room), float(upper + room)


def _column(series: Series, index: int) -> Series:
    return Series(series.times, series.values[:, index])


def _plot(
    title: str, curves: dict[str, Series], width: float, threshold: float | None = None
) -> None:
    flags = implot.Flags
    options = int(flags.NoMouseText) | int(flags.NoMenus) | int(flags.NoBoxSelect)
    if not implot.BeginPlot(title, imgui.Vec2(width - 20.0, _HEIGHT), options):
        return
    implot.SetupAxes('', '', int(implot.AxisFlags.NoTickLabels))
    legend = implot.LegendFlags
    # Inside, the legend would cover the curves.
    implot.SetupLegend(int(implot.Location.North), int(legend.Outside) | int(legend.Horizontal))
    newest = max((s.times[-1] for s in curves.values() if len(s.times)), default=0.0)
    always = int(implot.Cond.Always)
    implot.SetupAxisLimits(implot.Axis.X1, newest - _SECONDS, newest, always)
    limits = value_limits(curves.values(), threshold, newest - _SECONDS, newest)
    implot.SetupAxisLimits(implot.Axis.Y1, *limits, always)
    if threshold is not None:
        ends = np.array([newest - _SECONDS, newest])
        implot.PlotLine('success below', ends, np.full(2, threshold))
    for name, series in curves.items():
        known = np.isfinite(series.values)
        implot.PlotLine(name, series.times[known], series.values[known])
    implot.EndPlot()
