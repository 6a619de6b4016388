"""Connect a page with its source: send pictures to the viewer, and requests back."""

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

Perform = Callable[[Request | LatestRequest], None]


class Source(Protocol):
    """A running robot or an episode file."""

    def picture(self) -> Picture | None:
        """Return what to show if it has changed since the last call."""

    def perform(self, request: Request | LatestRequest) -> None:
        """Perform a request."""


class Requests(plugin.SimPlugin):
    """Passes the requests of the page to a source.

    The viewer's own tools would change the model that is shown. Of their messages, only pulls at
    bodies are passed on; the others are dropped.

    Args:
        perform: Called with each request.
    """

    def __init__(self, perform: Perform) -> None:
        self._perform = perform

    @messages.handler
    def on_request(self, request: Request) -> bool:
        """Pass on a request."""
        self._perform(request)
        return True

    @messages.handler
    def on_latest(self, request: LatestRequest) -> bool:
        """Pass on a request."""
        self._perform(request)
        return True

    @messages.handler
    def on_perturb(self, event: messages.PerturbSnapshot) -> bool:
        """Pass on pulls at bodies."""
        for body, wrench in pulls(self.handle.model, event):
            self._perform(Push(body, wrench))
        return True

    @messages.handler
    def on_state(self, event: messages.StateEvent) -> bool:
        """Drop the event."""
        return True

    @messages.handler
    def on_load(self, event: messages.LoadModelEvent) -> bool:
        """Drop the event."""
        return True

    @messages.handler
    def on_reset(self, event: messages.ResetEvent) -> bool:
        """Drop the event."""
        return True

    @messages.handler
    def on_option(self, event: messages.MjOptionSnapshot) -> bool:
        """Drop the event."""
        return True


class Session:
    """One page and its source."""

    def __init__(self, handle: viewer_handle.ViewerHandle, source: Source) -> None:
        self._handle = handle
        self._source = source
        self._scene: Scene | None = None

    def update(self) -> bool:
        """Show what is new and pass on requests; return whether anything was new.

        Raises:
            Exception: The error that ended the viewer's thread.
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
    """Return the scene of a task.

    Raises:
        CommandError: If the task or its robot is not installed here.
    """
    try:
        return Scene(task)
    except ValueError as error:
        raise CommandError(f'{task} cannot be shown: {one_line(error)}') from None
