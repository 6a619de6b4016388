"""The timeline of an episode file."""

from __future__ import annotations

from collections.abc import Callable

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.messages import (
    ChangeEpisode,
    Facts,
    LatestRequest,
    Request,
    Seek,
    SetPaused,
    SetSpeed,
    StepOnce,
    Timeline,
)

_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)


def draw_timeline(timeline: Timeline, facts: Facts, send: Callable[..., None]) -> None:
    """Draws buttons, the speed and the slider over all frames."""
    buttons: list[tuple[str, Request | LatestRequest]] = [
        ('<< Episode', ChangeEpisode(-1)),
        ('< Step', StepOnce(-1)),
        ('Play' if facts.is_paused else 'Pause', SetPaused(not facts.is_paused)),
        ('Step >', StepOnce(1)),
        ('Episode >>', ChangeEpisode(1)),
    ]
    for label, request in buttons:
        if imgui.Button(label):
            send(request)
        imgui.SameLine()
    imgui.SetNextItemWidth(80.0)
    names = [f'x {speed:g}' for speed in _SPEEDS]
    chosen = _SPEEDS.index(facts.speed) if facts.speed in _SPEEDS else 3
    changed, chosen = imgui.Combo('##speed', chosen, names)
    if changed:
        send(SetSpeed(_SPEEDS[chosen]))
    imgui.SameLine()
    where = f'{timeline.time:.2f} s   {timeline.title} ({timeline.number + 1} of {timeline.count})'
    imgui.Text(where)
    imgui.SetNextItemWidth(-1.0)
    last = timeline.frames - 1
    moved, index = imgui.SliderInt('##timeline', timeline.index, 0, last, 'frame %d')
    if moved:
        send(Seek(index))
