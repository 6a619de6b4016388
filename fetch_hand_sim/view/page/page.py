"""The plugin of `mujoco.studio` that draws the page and handles the mouse."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.simulation.rendering import make_options
from fetch_hand_sim.simulation.scene import Frame, Scene
from fetch_hand_sim.view.page.body_drag import BodyDrag
from fetch_hand_sim.view.page.goal_drag import Handle, drag_hint, find_handle, moved_goal
from fetch_hand_sim.view.page.panels import Panels
from fetch_hand_sim.view.page.ray import MousePlace, Ray, mouse_ray
from fetch_hand_sim.view.picture import Picture, ShowScene
from fetch_hand_sim.view.requests import Request, SetGoal
from msgs_spec.arrays import Array


@dataclasses.dataclass(slots=True)
class _GoalDrag:
    """State of a drag: the grabbed point, and goal and mouse position when it was grabbed."""

    handle: Handle
    goal: Array
    started: MousePlace


class Page(plugin.ViewerPlugin):
    """Draws the scene and the panels, and sends the user's requests by `viewer.send_to_sim`.

    Args:
        episodes: Episode files to choose from.
    """

    def __init__(self, episodes: tuple[Path, ...] = ()) -> None:
        self._scene: Scene | None = None
        self._picture: Picture | None = None
        self._panels = Panels(self._send, episodes)
        self._goal_drag: _GoalDrag | None = None
        self._body_drag: BodyDrag | None = None

    def _send(self, request: Request) -> None:
        self.viewer.send_to_sim(request)

    @messages.handler
    def on_viewer_init(self, event: plugin.ViewerInitEvent) -> None:
        """Set theme and rendering options of the viewer."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        event.viewer.vis_options = make_options()
        self._body_drag = BodyDrag(event.viewer)

    @messages.handler
    def on_scene(self, event: ShowScene) -> None:
        """Store the scene of another task; `PostModelEvent` follows when its model is loaded."""
        self._scene, self._picture, self._goal_drag = event.scene, None, None

    @messages.handler
    def on_post_model(self, event: messages.PostModelEvent) -> None:
        """End a pull at a body and point the camera at the scene of the new model."""
        del event
        if self._body_drag is not None:
            self._body_drag.end()
        if self._scene is not None:
            self._scene.view.apply(self.viewer.camera)

    @messages.handler
    def on_picture(self, picture: Picture) -> None:
        """Store the newest picture, which the next frame draws."""
        self._picture = picture

    @messages.handler
    def on_theme(self, event: plugin.ThemeEvent) -> None:
        """Use the theme that the user has chosen."""
        ux.setup_theme(event.theme)

    @messages.handler
    def on_update(self, event: messages.UpdateEvent) -> None:
        """Handle the mouse and draw the markers of the newest picture, such as goal and trail."""
        del event
        self._follow_mouse()
        picture = self._picture
        markers = []
        if self._scene is not None and picture is not None and picture.frame is not None:
            markers = self._scene.markers(picture.frame, picture.trail)
        geoms = self.viewer.extra_geoms
        while len(geoms) < len(markers):
            geoms.append(mujoco.MjvGeom())
        del geoms[len(markers) :]
        for geom, marker in zip(geoms, markers, strict=True):
            marker.draw(geom)

    @messages.handler
    def on_build_gui(self, event: messages.BuildGuiEvent) -> None:
        """Draw the panels."""
        del event
        self._panels.draw(self._picture)

    def _follow_mouse(self) -> None:
        picture, scene, body_drag = self._picture, self._scene, self._body_drag
        size = imgui.GetIO().DisplaySize
        if scene is None or picture is None or picture.frame is None or size.y <= 0:
            return
        if body_drag is None or not picture.facts.takes_actions:
            return
        mouse = imgui.GetIO().MousePos
        place = MousePlace(mouse.x / size.x, mouse.y / size.y, size.x / size.y)
        if body_drag.is_pulling:
            self._pull(body_drag)
        elif self._goal_drag is not None:
            self._move_goal(scene, self._goal_drag, place)
        elif not (
            imgui.IsAnyItemHovered() or imgui.IsWindowHovered(int(imgui.HoveredFlags.AnyWindow))
        ):
            if not imgui.GetIO().KeyCtrl:
                self._offer_goal(scene, picture.frame, place)
            elif picture.facts.push_limit and imgui.IsMouseClicked(imgui.MouseButton.Left):
                if body_drag.begin(self._ray(place), picture.facts.push_limit):
                    imgui.SetNextFrameWantCaptureMouse(True)

    def _pull(self, drag: BodyDrag) -> None:
        io = imgui.GetIO()
        if not imgui.IsMouseDown(imgui.MouseButton.Left):
            drag.end()
            return
        # Without this the browser turns the camera.
        imgui.SetNextFrameWantCaptureMouse(True)
        delta = (io.MouseDelta.x / io.DisplaySize.x, io.MouseDelta.y / io.DisplaySize.y)
        self.viewer.send_to_sim(drag.move(delta))

    def _offer_goal(self, scene: Scene, frame: Frame, place: MousePlace) -> None:
        handle = find_handle(scene.spec, frame.desired_goal, self._ray(place))
        if handle is None:
            return
        imgui.SetNextFrameWantCaptureMouse(True)
        imgui.SetMouseCursor(imgui.MouseCursor.Hand)
        imgui.SetTooltip(drag_hint(scene.spec))
        if imgui.IsMouseClicked(imgui.MouseButton.Left):
            self._goal_drag = _GoalDrag(handle, frame.desired_goal.copy(), place)

    def _move_goal(self, scene: Scene, drag: _GoalDrag, place: MousePlace) -> None:
        imgui.SetNextFrameWantCaptureMouse(True)
        if not imgui.IsMouseDown(imgui.MouseButton.Left):
            self._goal_drag = None
            return
        delta = np.array([place.x - drag.started.x, place.y - drag.started.y])
        if delta.any():
            is_turning, ray = not imgui.GetIO().KeyShift, self._ray(place)
            goal = moved_goal(scene.spec, drag.goal, drag.handle, ray, is_turning, delta)
            self._send(SetGoal(goal, is_kept=self._panels.goal_panel.keeps_goal))

    def _ray(self, place: MousePlace) -> Ray:
        fovy = float(self.viewer.model.vis.global_.fovy)
        return mouse_ray(self.viewer.camera, fovy, place)
