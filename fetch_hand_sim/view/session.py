"""Keeps a page fed: pictures from a source to the viewer, requests back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from mujoco.studio import messages, plugin, viewer_handle

from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.view.page.body_drag import pulls
from fetch_hand_sim.view.picture import Picture, ShowScene
from fetch_hand_sim.view.requests import LatestRequest, Push, Request
from msgs_spec.text import one_line
from node_runtime.command_line import CommandError


class Source(Protocol):
    """What is shown: a running robot or a file."""

    def picture(self) -> Picture | None:
        """Returns what to show if it has changed since the last call."""

    def perform(self, request: Request | LatestRequest) -> None:
        """Does what the page asks for."""


class Requests(plugin.SimPlugin):
    """Hands what the page asks for to a source.

    What the viewer's own tools send would change a model that is only looked at: pulls at bodies
    are passed on, all else is dropped.

    Args:
        perform: Does what is asked for.
    """

    def __init__(self, perform: Callable[[Request | LatestRequest], None]) -> None:
        self._perform = perform

    @messages.handler
    def on_request(self, request: Request) -> bool:
        """Passes on."""
        self._perform(request)
        return True

    @messages.handler
    def on_latest(self, request: LatestRequest) -> bool:
        """Passes on."""
        self._perform(request)
        return True

    @messages.handler
    def on_state(self, event: messages.StateEvent) -> bool:
        """Drops."""
        return True

    @messages.handler
    def on_perturb(self, event: messages.PerturbSnapshot) -> bool:
        """Passes on who is pulled at, and how hard."""
        for body, wrench in pulls(self.handle.model, event):
            self._perform(Push(body, wrench))
        return True

    @messages.handler
    def on_load(self, event: messages.LoadModelEvent) -> bool:
        """Drops."""
        return True

    @messages.handler
    def on_reset(self, event: messages.ResetEvent) -> bool:
        """Drops."""
        return True

    @messages.handler
    def on_option(self, event: messages.MjOptionSnapshot) -> bool:
        """Drops."""
        return True


class Session:
    """One page and what it shows.

    Args:
        handle: The viewer's.
        source: What there is to see.
    """

    def __init__(self, handle: viewer_handle.ViewerHandle, source: Source) -> None:
        self._handle = handle
        self._source = source
        self._scene: Scene | None = None

    def update(self) -> bool:
        """Shows what is new and does what the page asked for; returns whether there was news.

        Raises:
            Exception: What ended the viewer's thread.
        """
        self._handle.is_running()
        picture = self._source.picture()
        if picture is not None:
            self._show(picture)
        self._handle.sync()
        return picture is not None

    def _show(self, picture: Picture) -> None:
        if self._scene is None or self._scene.spec.name != picture.task:
            self._scene = scene = _scene_of(picture.task)
            self._handle.send_to_viewer(ShowScene(scene))
            self._handle.set_model(scene.model, data=scene.data)
        if picture.frame is not None:
            self._scene.show(picture.frame)
        self._handle.send_to_viewer(picture)


def _scene_of(task: str) -> Scene:
    """The scene of a task.

    Raises:
        CommandError: If it cannot be made, as of a robot whose package is not installed here.
    """
    try:
        return Scene(task)
    except ValueError as error:
        raise CommandError(f'{task} cannot be shown: {one_line(error)}') from None
