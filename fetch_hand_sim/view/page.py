"""The page: scene, panels and mouse, as a plugin of MuJoCo's viewer."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.dear_imgui import dear_imgui as imgui
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rendering import make_options
from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.view.goal_drag import Handle, find_handle, moved_goal
from fetch_hand_sim.view.messages import LatestRequest, Picture, Request, SetGoal, ShowScene
from fetch_hand_sim.view.panels import Panels
from fetch_hand_sim.view.ray import Ray, mouse_ray

Array = NDArray[np.float64]


@dataclasses.dataclass(slots=True)
class _Drag:
    """A goal that the mouse holds."""

    handle: Handle
    goal: Array
    started: tuple[float, float]


class Page(plugin.ViewerPlugin):
    """Draws what pictures say and sends what people do."""

    def __init__(self) -> None:
        """Shows nothing yet."""
        self._scene: Scene | None = None
        self._picture: Picture | None = None
        self._panels = Panels(self._send)
        self._drag: _Drag | None = None

    def _send(self, request: Request | LatestRequest) -> None:
        self.viewer.send_to_sim(request)

    # What arrives

    @messages.handler
    def on_viewer_init(self, event: plugin.ViewerInitEvent) -> None:
        """Sets the looks of the page."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        event.viewer.vis_options = make_options()

    @messages.handler
    def on_scene(self, event: ShowScene) -> None:
        """Takes another robot; its model follows."""
        self._scene, self._picture, self._drag = event.scene, None, None

    @messages.handler
    def on_post_model(self, event: messages.PostModelEvent) -> None:
        """Looks at the robot from where it is seen best."""
        del event
        if self._scene is not None:
            self._scene.view.apply(self.viewer.camera)

    @messages.handler
    def on_picture(self, picture: Picture) -> None:
        """Takes what is to be shown."""
        self._picture = picture

    @messages.handler
    def on_theme(self, event: plugin.ThemeEvent) -> None:
        """Follows the visitor's choice of colours."""
        ux.setup_theme(event.theme)

    # What is drawn

    @messages.handler
    def on_update(self, event: messages.UpdateEvent) -> None:
        """Follows the mouse and draws the markers."""
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
        """Draws the panels."""
        del event
        self._panels.draw(self._picture)

    # The mouse

    def _follow_mouse(self) -> None:
        picture, scene = self._picture, self._scene
        io = imgui.GetIO()
        if scene is None or picture is None or picture.frame is None or io.DisplaySize.y <= 0:
            return
        if not picture.facts.may_command or picture.facts.source != 'live':
            return
        ray, place = self._ray(io)
        if self._drag is not None:
            self._move(self._drag, ray, place, io.KeyShift)
            return
        if imgui.IsAnyItemHovered() or imgui.IsWindowHovered(int(imgui.HoveredFlags.AnyWindow)):
            return
        goal = picture.frame.desired_goal
        handle = find_handle(scene.spec, goal, ray)
        if handle is None:
            return
        # Else the browser would turn the camera.
        imgui.SetNextFrameWantCaptureMouse(True)
        imgui.SetMouseCursor(imgui.MouseCursor.Hand)
        imgui.SetTooltip(self._panels.drag_hint(scene.spec))
        if imgui.IsMouseClicked(imgui.MouseButton.Left):
            self._drag = _Drag(handle, goal.copy(), place)

    def _move(self, drag: _Drag, ray: Ray, place: tuple[float, float], is_moving: bool) -> None:
        imgui.SetNextFrameWantCaptureMouse(True)
        if not imgui.IsMouseDown(imgui.MouseButton.Left):
            self._drag = None
            return
        assert self._scene is not None
        delta = np.array(place) - np.array(drag.started)
        if np.abs(delta).max() > 0.0:
            goal = moved_goal(self._scene.spec, drag.goal, drag.handle, ray, not is_moving, delta)
            self._send(SetGoal(goal, is_kept=self._panels.keeps_goal))

    def _ray(self, io: Any) -> tuple[Ray, tuple[float, float]]:
        camera = self.viewer.camera
        place = (io.MousePos.x / io.DisplaySize.x, io.MousePos.y / io.DisplaySize.y)
        view = (np.array(camera.lookat), camera.distance, camera.azimuth, camera.elevation)
        fovy = float(self.viewer.model.vis.global_.fovy)
        return mouse_ray(view, fovy, place, io.DisplaySize.x / io.DisplaySize.y), place
