"""Connect a page with its source, a running robot or a file player."""

from __future__ import annotations

from collections.abc import Callable

from mujoco.studio import messages, plugin, viewer_handle

from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.view.page.body_drag import pulls
from fetch_hand_sim.view.picture import Picture, ShowScene
from fetch_hand_sim.view.requests import Push, Request
from msgs_spec.text import one_line
from node_runtime.command_line import CommandError

Perform = Callable[[Request], None]


# Messages of the viewer's own tools, which would change the model that is shown.
_DROPPED = (
    messages.StateEvent,
    messages.LoadModelEvent,
    messages.ResetEvent,
    messages.MjOptionSnapshot,
)


class Requests(plugin.SimPlugin):
    """A viewer plugin that passes each `Request` of the page to the function `perform`.

    A body that the mouse pulls (a perturbation of MuJoCo) becomes a `Push` request.
    """

    def __init__(self, perform: Perform) -> None:
        self._perform = perform

    @messages.handler
    def on_message(self, message: messages.Message) -> bool:
        """Handle a message; return True if the viewer must not handle it as well."""
        match message:
            case Request():
                self._perform(message)
            case messages.PerturbSnapshot():
                for body, wrench in pulls(self.handle.model, message):
                    self._perform(Push(body, wrench))
            case _:
                return isinstance(message, _DROPPED)
        return True


class Session:
    """Sends the state of a robot or file player to the page, and handles messages of the page.

    Args:
        picture: Returns a message with the new state, or None if nothing has changed.
    """

    def __init__(
        self, handle: viewer_handle.ViewerHandle, picture: Callable[[], Picture | None]
    ) -> None:
        self._handle = handle
        self._picture = picture
        self._scene: Scene | None = None

    def update(self) -> bool:
        """Handle messages of the page and send it the new state; return False if nothing changed.

        Raises:
            Exception: The error that ended the thread of the viewer.
        """
        self._handle.is_running()
        picture = self._picture()
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
    """Return the scene of a task; CommandError if the task or its robot is not installed."""
    try:
        return Scene(task)
    except ValueError as error:
        raise CommandError(f'{task} cannot be shown: {one_line(error)}') from None
