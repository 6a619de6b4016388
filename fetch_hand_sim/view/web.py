"""Serve the page with MuJoCo's web viewer, on a chosen interface and with access checks."""

from __future__ import annotations

import ctypes
import errno
import http.client
import logging
import os
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

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

from fetch_hand_sim.view.guard import Attendance, Guard, guarded_serve, is_loopback
from msgs_spec.topics import LATEST_TICKS_PER_SECOND
from node_runtime.command_line import CommandError

# Seconds between two frames of an untouched page, for a robot in real time and for a faster one.
FOLLOWING = 1.0 / LATEST_TICKS_PER_SECOND
OVERLOOKING = 1.0 / 12.0
# Seconds after the last touch during which frames come as fast as possible.
_ATTENTION = 0.5
_LOOPBACK = '127.0.0.1'
_EVERYWHERE = ('::', '0.0.0.0')
_PORTS = range(8080, 8100)
# Addresses reserved for documentation, used to look up the route to other hosts.
_OTHER_HOSTS = ((socket.AF_INET, '203.0.113.1'), (socket.AF_INET6, '2001:db8::1'))
_START_TIMEOUT = 10.0
# Option of prctl(2), and the tolerance of timers in nanoseconds; a frame takes 16 ms.
_SET_TIMER_SLACK, _SLACK_NS = 29, 5_000_000


@dataclass(frozen=True, slots=True)
class Address:
    """Interface and port of the page; if `token` is None, only this machine can connect."""

    host: str
    port: int
    token: str | None
    is_read_only: bool = False

    @property
    def url(self) -> str:
        """The address to open in a browser, with the token."""
        host = _outside_host() if self.host in _EVERYWHERE else self.host
        host = f'[{host}]' if ':' in host else host
        query = f'?token={self.token}' if self.token else ''
        return f'http://{host}:{self.port}/{query}'

    @property
    def warning(self) -> str | None:
        """The warning to print if other machines can connect, else None."""
        if self.token is None:
            return None
        can = 'watch' if self.is_read_only else 'watch and command the robot'
        return (
            f'listening on {self.host}: everyone with this address can {can}, and nothing is '
            f'encrypted. ssh -L {self.port}:localhost:{self.port} is safer'
        )


class FrameRate:
    """Decides when the next frame begins. Times are seconds of one steady clock.

    Until 0.5 s after the last input, frames come as fast as possible. Without input they are rare,
    because drawing takes CPU time from the robot.

    Args:
        period: Returns the seconds between two frames without input.
    """

    def __init__(self, period: Callable[[], float] = lambda: FOLLOWING) -> None:
        self.period = period
        self._mouse = (0.0, 0.0)
        self._touched = 0.0
        self._began = 0.0

    def wait_time(self, now: float, mouse: tuple[float, float], is_held: bool) -> float:
        """Return the seconds to wait before the next frame; call it once per frame.

        `mouse` is its position at the time `now`; `is_held` means other input, such as a button.
        """
        if is_held or mouse != self._mouse:
            self._touched = now
        self._mouse = mouse
        wait = 0.0
        if now - self._touched > _ATTENTION:
            wait = max(0.0, self._began + self.period() - now)
        self._began = now + wait
        return wait


class _Viewer(web_viewer.WebViewer):
    """MuJoCo's web viewer with the frame times of `frame_rate`; it ignores dropped files."""

    frame_rate: FrameRate

    def prepare_next_frame(self) -> bool:
        """Wait until the next frame is due and begin it; return False if the page disconnected."""
        io = imgui.GetIO()
        is_held = imgui.IsAnyMouseDown() or io.WantCaptureKeyboard or io.MouseWheel != 0.0
        mouse = (io.MousePos.x, io.MousePos.y)
        time.sleep(self.frame_rate.wait_time(time.monotonic(), mouse, is_held))
        begun: bool = super().prepare_next_frame()
        return begun

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        # As in the base class, but without its message on stdout.
        del event
        self._update_model()

    def get_drop_file(self) -> str:
        """Return '', so that a file dropped on the page is ignored."""
        return ''


def _outside_host() -> str:
    """Return the network address of this machine, or its host name without a network."""
    for family, other in _OTHER_HOSTS:
        # `connect` of a datagram socket only chooses the route; it sends nothing.
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as route:
            route.connect((other, 9))
            own = str(route.getsockname()[0])
            if not is_loopback(own):
                return own
    return socket.gethostname()


def open_page(
    host: str,
    port: int,
    plugins: Sequence[plugin.Plugin],
    frame_rate: FrameRate,
    attendance: Attendance | None = None,
    is_read_only: bool = False,
) -> tuple[viewer_handle.ViewerHandle, Address]:
    """Serve the page from a thread, behind a `Guard`; return its viewer handle and address.

    Call it once per process.

    Args:
        host: Interface to listen on.
        port: A port, or 0 for the first free one of 8080 ... 8099.
        attendance: Records whether the page in control is in use.

    Raises:
        CommandError: If the port is taken, the host is no address of this machine, or the server
            does not answer or accepts a foreign Host header.
    """
    listening = _listen(host, port)
    port = listening.getsockname()[1]
    guard = Guard(None if is_loopback(host) else secrets.token_urlsafe(16), port)
    address = Address(host, port, guard.token, is_read_only)
    attendance = attendance or Attendance()
    _replace_server(listening, guarded_serve(guard, attendance, is_read_only))
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


def _replace_server(listening: socket.socket, serve: Callable[..., Any]) -> None:
    """Make MuJoCo's viewer use the socket `listening` and the function `serve`.

    MuJoCo 4.0 has no option for these: the viewer always binds all interfaces, calls
    `websockets.serve` itself and prints its own address.
    """
    web_server.bind_public_socket = lambda *_: listening
    web_server.serve = serve
    web_viewer._print_url_banner = lambda *_: None
    logging.getLogger('WebServer').setLevel(logging.WARNING)
    logging.getLogger('asyncio').addFilter(is_no_farewell)


def _wake_seldom() -> None:
    """Save CPU time: let timers of this thread and its children be up to 5 ms late.

    A thread of the viewer polls 2,000 times a second.
    """
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(_SLACK_NS))


def is_no_farewell(record: logging.LogRecord) -> bool:
    """Return False for the error of a closed connection, so that the log omits the record."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, ConnectionClosed)


def _listen(host: str, port: int) -> socket.socket:
    """Return a listening socket on `port`; 0 takes the first free one of 8080 ... 8099.

    Raises:
        CommandError: If the host is no address of this machine, or no port is free.
    """
    reason = ''
    for each in [port] if port else _PORTS:
        try:
            family = socket.getaddrinfo(host, each, type=socket.SOCK_STREAM)[0][0]
            has_both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
            return socket.create_server((host, each), family=family, dualstack_ipv6=has_both)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            if getattr(error, 'errno', None) not in (errno.EADDRINUSE, errno.EACCES):
                line = f'cannot listen on {host}: no address of this machine ({reason})'
                raise CommandError(line) from None
    wanted = port or f'{_PORTS[0]} ... {_PORTS[-1]}'
    raise CommandError(f'cannot listen on {host} port {wanted}: {reason}')


def _check_guarded(address: Address) -> None:
    """Send a request with a foreign Host header; raise CommandError unless it is rejected."""
    host = _LOOPBACK if address.host in _EVERYWHERE else address.host
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        connection = http.client.HTTPConnection(host, address.port, timeout=_START_TIMEOUT)
        try:
            connection.request('GET', '/', headers={'Host': 'elsewhere.example'})
            status = connection.getresponse().status
        except OSError as error:
            if time.monotonic() > deadline:
                raise CommandError(f'the page does not answer: {error}') from None
            time.sleep(0.05)
            continue
        finally:
            connection.close()
        if status != 403:
            raise CommandError(
                f'mujoco.studio does not use the guard (status {status}). '
                'Install the version of mujoco that setup.py names.'
            )
        return


def announce(address: Address, wants_browser: bool) -> None:
    """Print the address; open it in a browser if `wants_browser` and a display exists."""
    if address.warning:
        print(f'Warning: {address.warning}', flush=True)
    print(f'The page is at {address.url} (Ctrl-C ends)', flush=True)
    if wants_browser and _has_display():
        open_browser(address.url)


def _has_display() -> bool:
    if not sys.platform.startswith('linux'):
        return True
    return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def open_browser(url: str, browser: Callable[[str], bool] = webbrowser.open) -> threading.Thread:
    """Open an address in a browser from the returned thread; print a line if none is found."""

    def open_it() -> None:
        if not browser(url):
            print('No browser was found: open the address in one', flush=True)

    thread = threading.Thread(target=open_it, daemon=True)
    thread.start()
    return thread
