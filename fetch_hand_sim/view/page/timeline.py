"""The timeline of an episode file."""

from __future__ import annotations

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.time_controls import draw_pause, draw_speed, draw_step
from fetch_hand_sim.view.page.windows import Send
from fetch_hand_sim.view.picture import Facts, Timeline
from fetch_hand_sim.view.requests import ChangeEpisode, Seek


def draw_timeline(timeline: Timeline, facts: Facts, send: Send) -> None:
    """Draws buttons, the speed and the slider over all frames."""
    imgui.BeginDisabled(not facts.may_command)
    if imgui.Button('<< Episode'):
        send(ChangeEpisode(-1))
    imgui.SameLine()
    draw_step('< Step', -1, send)
    imgui.SameLine()
    draw_pause(facts.is_paused, 'Play', send)
    imgui.SameLine()
    draw_step('Step >', 1, send)
    imgui.SameLine()
    if imgui.Button('Episode >>'):
        send(ChangeEpisode(1))
    imgui.SameLine()
    draw_speed(facts.speed, send)
    imgui.SameLine()
    where = f'{timeline.time:.2f} s   {timeline.title} ({timeline.number + 1} of {timeline.count})'
    imgui.Text(where)
    imgui.SetNextItemWidth(-1.0)
    last = timeline.frames - 1
    moved, index = imgui.SliderInt('##timeline', timeline.index, 0, last, 'frame %d')
    if moved:
        send(Seek(index))
    imgui.EndDisabled()
