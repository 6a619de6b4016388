"""Starts MuJoCo's web viewer behind a guard, on a socket of our choice."""

from __future__ import annotations

import ctypes
import http.client
import logging
import os
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from mujoco.studio import (
    endpoints,
    launch_thread,
    messages,
    plugin,
    viewer_handle,
    viewer_protocol,
    web_viewer,
)
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server
from websockets.exceptions import ConnectionClosed

from fetch_hand_sim.view.attendance import Attendance
from fetch_hand_sim.view.frame_rate import FrameRate, Touch
from fetch_hand_sim.view.guard import Guard, guarded_serve, is_loopback, new_token
from node_runtime.command_line import CommandError

_LOOPBACK = '127.0.0.1'
_EVERYWHERE = ('::', '0.0.0.0')
# Addresses of networks that exist in documents alone; nothing is sent there.
_SOMEBODY = ((socket.AF_INET, '203.0.113.1'), (socket.AF_INET6, '2001:db8::1'))
_START_TIMEOUT = 10.0
# Option of prctl(2), and nanoseconds that a timer may be late: little beside a picture's 16 ms.
_SET_TIMER_SLACK, _SLACK_NS = 29, 5_000_000
_bind_public_socket = web_server.bind_public_socket


class CannotServe(CommandError):
    """The page cannot be served; the message is one line that says why."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where the page is.

    Attributes:
        host: Interface that is listened on.
        port: Its port.
        token: What visitors must show; None where only this machine can connect.
    """

    host: str
    port: int
    token: str | None

    @property
    def url(self) -> str:
        """What to open in a browser."""
        host = outside_host() if self.host in _EVERYWHERE else self.host
        host = f'[{host}]' if ':' in host else host
        query = f'?token={self.token}' if self.token else ''
        return f'http://{host}:{self.port}/{query}'

    @property
    def warning(self) -> str | None:
        """What to say where others can connect."""
        if self.token is None:
            return None
        return (
            f'listening on {self.host}: whoever has this address can watch and command the robot, '
            'and nothing is encrypted. Browsers draw the page only over HTTPS or on this machine: '
            f'ssh -L {self.port}:localhost:{self.port} is safer and works everywhere'
        )


class _Viewer(web_viewer.WebViewer):
    """The web viewer without what it tells the terminal, and without files from visitors.

    Attributes:
        frame_rate: How often to build the page; None is as often as it can, 60 times a second.
    """

    frame_rate: FrameRate | None = None

    def prepare_next_frame(self) -> bool:
        """Waits for the next frame and begins it."""
        if self.frame_rate is not None:
            time.sleep(self.frame_rate.wait_time(time.monotonic(), _read_touch()))
        begun: bool = super().prepare_next_frame()
        return begun

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        del event
        self._update_model()

    def get_drop_file(self) -> str:
        """Takes none."""
        return ''


def _read_touch() -> Touch:
    """What mouse and keyboard of the page did in the last frame."""
    io = imgui.GetIO()
    return Touch(
        mouse=(io.MousePos.x, io.MousePos.y),
        wheel=io.MouseWheel,
        is_down=imgui.IsAnyMouseDown(),
        is_typing=io.WantCaptureKeyboard,
    )


def outside_host() -> str:
    """Returns by what others reach this machine: its name, else its address, where it has one."""
    name = socket.getfqdn()
    for each in (name, socket.gethostname()):
        if _leads_outside(each):
            return each
    return _outside_address() or name


def _leads_outside(name: str) -> bool:
    """Whether a name is that of an address which is not this machine's own."""
    try:
        found = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return False
    return any(not is_loopback(str(address[0])) for *_, address in found)


def _outside_address() -> str | None:
    """The address from which this machine would send, if it could."""
    for family, other in _SOMEBODY:
        # `connect` of a datagram socket chooses the route and sends nothing.
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as route:
            route.connect((other, 9))
            own = str(route.getsockname()[0])
            if not is_loopback(own):
                return own
    return None


def open_page(
    host: str,
    port: int,
    plugins: Sequence[plugin.Plugin],
    frame_rate: FrameRate | None = None,
    attendance: Attendance | None = None,
) -> tuple[viewer_handle.ViewerHandle, Address]:
    """Binds, serves the page from a thread and checks that the guard stands; once per process.

    Args:
        host: Interface to listen on.
        port: A port, or 0 for the first free one from 8080.
        plugins: Of the page and of the robot's side.
        frame_rate: How often to build the page; None is 60 times a second.
        attendance: Hears of the page in control.

    Raises:
        CannotServe: If the port is taken or the host is not ours.
    """
    needs_token = not is_loopback(host)
    listening = _bind(host, port)
    guard = Guard(new_token() if needs_token else None, listening.getsockname()[1])
    address = Address(host, listening.getsockname()[1], guard.token)
    # The two places where the viewer meets the network; it offers no option for either.
    web_server.bind_public_socket = lambda *_: listening
    web_server.serve = guarded_serve(guard, attendance or Attendance())
    web_viewer._print_url_banner = lambda *_: None
    logging.getLogger('WebServer').setLevel(logging.WARNING)
    logging.getLogger('asyncio').addFilter(is_no_farewell)
    viewer_plugins, sim_plugins = plugin.split_plugins(plugins)

    def run(endpoint: endpoints.ViewerEndpoint) -> None:
        _wake_seldom()
        config = viewer_protocol.ViewerConfig(title='fetch_hand_sim', gfx='web')
        viewer = _Viewer(config, endpoint, plugins=viewer_plugins)
        viewer.frame_rate = frame_rate
        viewer_protocol.run_viewer_loop(viewer)

    handle = launch_thread.launch_thread(run, sim_plugins=sim_plugins)
    try:
        _check_guarded(address)
    except BaseException:
        handle.close()
        raise
    return handle, address


def _wake_seldom() -> None:
    """Lets timers of this thread, and of those that it starts, be a little late.

    One of the viewer's looks for news 2,000 times a second, which on two processors costs a robot
    in lockstep beside it some of its ticks.
    """
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(_SLACK_NS))


def is_no_farewell(record: logging.LogRecord) -> bool:
    """Whether a line of the log is about more than a visitor who has left."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, ConnectionClosed)


def _bind(host: str, port: int) -> socket.socket:
    _require_own(host)
    try:
        listening: socket.socket = _bind_public_socket(host, port)
        # At once, so that nobody else can take the port before the server is up.
        listening.listen()
    except (RuntimeError, OSError, OverflowError) as error:
        line = str(error).split('.')[0]
        raise CannotServe(f'cannot listen on {host} port {port or "8080 ..."}: {line}') from None
    return listening


def _require_own(host: str) -> None:
    """Refuses what is no address of this machine; the viewer's helper calls every failure a port.

    Raises:
        CannotServe: If nothing can be bound to it.
    """
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(place)
    except (OSError, UnicodeError) as error:
        why = getattr(error, 'strerror', None) or error
        line = f'cannot listen on {host}: no address of this machine ({why})'
        raise CannotServe(line) from None


def _check_guarded(address: Address) -> None:
    """Asks as a foreign site would; a server that answers must not run."""
    host = _LOOPBACK if address.host in _EVERYWHERE else address.host
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        connection = http.client.HTTPConnection(host, address.port, timeout=_START_TIMEOUT)
        try:
            connection.request('GET', '/', headers={'Host': 'elsewhere.example'})
            status = connection.getresponse().status
        except OSError as error:
            if time.monotonic() > deadline:
                raise CannotServe(f'the page does not answer: {error}') from None
            time.sleep(0.05)
            continue
        finally:
            connection.close()
        if status != 403:
            raise CannotServe(
                f'mujoco.studio serves past the guard (status {status}); this version of mujoco '
                'is not supported'
            )
        return


def announce(address: Address, wants_browser: bool) -> None:
    """Prints the address and opens it where a browser could show itself."""
    if address.warning:
        print(f'Warning: {address.warning}', flush=True)
    # Once: a name server may be slow to answer.
    url = address.url
    print(f'The page is at {url} (Ctrl-C ends)', flush=True)
    if wants_browser and has_display():
        open_browser(url)


def has_display() -> bool:
    """Whether a browser could show itself."""
    if not sys.platform.startswith('linux'):
        return True
    return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def open_browser(url: str, browser: Callable[[str], bool] = webbrowser.open) -> threading.Thread:
    """Opens a page without waiting for the browser; says so where there is none."""

    def open_it() -> None:
        if not browser(url):
            print('No browser was found: open the address in one', flush=True)

    thread = threading.Thread(target=open_it, daemon=True)
    thread.start()
    return thread
