"""Curves of the page."""

from __future__ import annotations

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from fetch_hand_sim.view.picture import Graphs, Series
from msgs_spec.tasks import TaskSpec

_HEIGHT = 130.0
_SECONDS = 8.0


def draw_plots(spec: TaskSpec, graphs: Graphs, width: float) -> None:
    """Draws distances with their thresholds, the reward, and commands against joints."""
    if graphs.distance is not None:
        curves = {'distance (m)': graphs.distance}
        _plot('Distance', curves, width, threshold=spec.distance_threshold)
    if graphs.rotation is not None:
        curves = {'rotation (rad)': graphs.rotation}
        _plot('Rotation', curves, width, threshold=spec.rotation_threshold)
    if graphs.reward is not None:
        _plot('Reward', {'reward': graphs.reward}, width)
    if graphs.commands is not None and imgui.CollapsingHeader('Commands and joints'):
        for index, part in enumerate(spec.robot.command):
            curves = {'command': _column(graphs.commands, index)}
            if graphs.positions is not None and not spec.robot.has_gripper_command:
                curves['joint'] = _column(graphs.positions, index)
            _plot(f'{part.name.removeprefix("robot0:")} ({part.unit})', curves, width)


def _column(series: Series, index: int) -> Series:
    return Series(series.times, series.values[:, index])


def _plot(
    title: str, curves: dict[str, Series], width: float, threshold: float | None = None
) -> None:
    flags = implot.Flags
    options = int(flags.NoMouseText) | int(flags.NoMenus) | int(flags.NoBoxSelect)
    if not implot.BeginPlot(title, imgui.Vec2(width - 20.0, _HEIGHT), options):
        return
    axis = implot.AxisFlags
    implot.SetupAxes('', '', int(axis.NoTickLabels), int(axis.AutoFit))
    newest = max((s.times[-1] for s in curves.values() if len(s.times)), default=0.0)
    always = int(implot.Cond.Always)
    implot.SetupAxisLimits(implot.Axis.X1, newest - _SECONDS, newest, always)
    if threshold is not None:
        ends = np.array([newest - _SECONDS, newest])
        implot.PlotLine('success below', ends, np.full(2, threshold))
    for name, series in curves.items():
        known = np.isfinite(series.values)
        implot.PlotLine(name, series.times[known], series.values[known])
    implot.EndPlot()
