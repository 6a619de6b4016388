"""Decide which requests the web server answers, and whether the visitor in control is present.

MuJoCo's viewer answers every request, loads models from visitors and lets other sites read its
answers. `guarded_serve` first checks the token, the Host and the Origin of each request.
"""

from __future__ import annotations

import hmac
import math
import time
from collections.abc import Awaitable, Callable, Sequence
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

# Seconds without input after which the visitor counts as absent. A visible page sends input at
# every frame of its browser; a hidden, sleeping or disconnected page sends none.
_SILENCE = 3.0
_IN_CONTROL = '/ui'
_SOCKETS = frozenset({_IN_CONTROL, '/state'})
# Seconds to wait until a visitor confirms the end of a connection.
_CLOSE_TIMEOUT = 3.0
# The cookie with the token. Browsers share cookies between all ports of a host, so the name
# contains the port.
_COOKIE = 'fetch_hand_sim_view_{port}'
_FORBIDDEN_PATHS = frozenset({'/drop'})
# Headers that let other sites read or embed the answers.
_OPENING_HEADERS = ('Access-Control-Allow-Origin', 'Cross-Origin-Resource-Policy')
_CLOSING_HEADERS = {
    # In a frame, another site could provoke clicks.
    'X-Frame-Options': 'DENY',
    'Content-Security-Policy': "frame-ancestors 'none'",
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff',
}
# The viewer's page has no language, and phones shrink a page without viewport.
_PAGE_START = (
    b'<html>\n  <head>',
    b'<html lang="en">\n  <head>\n'
    b'    <meta name="viewport" content="width=device-width, initial-scale=1" />',
)


# The page shows this to its first visitor. A text of equal length keeps the program valid.
_ROLE, _READ_ONLY_ROLE = b'\0Controlling\0', b'\0Watching\0\0\0\0'


class Attendance:
    """Records whether the page in control of the robot is in use; thread-safe.

    Args:
        clock: A steady clock, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._heard = -math.inf
        self._visits = self._known_visits = 0

    @property
    def is_there(self) -> bool:
        """True if the page in control is connected and has sent input within the last 3 s."""
        return self._clock() - self._heard < _SILENCE

    def note(self) -> None:
        """Record that the page in control has sent input."""
        self._heard = self._clock()

    def end_visit(self) -> None:
        """Record that the page in control has disconnected."""
        self._heard = -math.inf
        self._visits += 1

    def has_left(self) -> bool:
        """Return whether the page sent no input for 3 s, or disconnected since the last call."""
        visits, before = self._visits, self._known_visits
        self._known_visits = visits
        return visits != before or not self.is_there


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a host: `localhost` or a loopback address."""
    try:
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:
        # A name, which may begin like an address: 127.0.0.1.evil.example.
        return False


class Guard:
    """Accepts or rejects requests to the page.

    Without a token, the Host header must be `localhost` or a loopback address; other names are
    rejected. With a token, every request needs the token in its address or cookie. Web sockets need
    the Origin of the page.

    Args:
        token: Secret that visitors need; None if only this machine can connect.
        port: Port of the page; it is part of the name of the cookie that stores the token.
    """

    def __init__(self, token: str | None = None, port: int = 0) -> None:
        self.token = token
        self._cookie = _COOKIE.format(port=port)

    def refusal(self, target: str, headers: Headers) -> Response | None:
        """Return the error response to a request for path and query `target`; None if accepted."""
        try:
            path = urlsplit(target).path
        except ValueError:
            return _answer(400, 'this is no address')
        if path in _FORBIDDEN_PATHS:
            return _answer(403, 'this page takes no files')
        hosts = headers.get_all('Host')
        if len(hosts) != 1:
            return _answer(400, 'one Host header is needed')
        if self.token is None:
            if not is_loopback(_host_name(hosts[0])):
                return _answer(403, 'this page is served to this machine only')
        elif not self._has_token(target, headers):
            return _answer(403, 'the address lacks its token')
        if path in _SOCKETS and not _is_same_origin(headers.get_all('Origin'), hosts[0]):
            return _answer(403, 'only the page itself may connect')
        return None

    def admission(self, target: str) -> str | None:
        """Return the `Set-Cookie` header if the address `target` contains the token, else None."""
        if self.token is None or not self._matches(_tokens_in(target)):
            return None
        # Strict cookies are not sent after a link on another site. Only web sockets can command,
        # and they need the page's origin too.
        return f'{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax'

    def _has_token(self, target: str, headers: Headers) -> bool:
        given = _tokens_in(target)
        for line in headers.get_all('Cookie'):
            try:
                cookies = SimpleCookie(line)
            except CookieError:
                continue
            if self._cookie in cookies:
                given.append(cookies[self._cookie].value)
        return self._matches(given)

    def _matches(self, given: Sequence[str]) -> bool:
        # Invalid UTF-8 arrives as lone surrogates.
        words = [each.encode('utf-8', 'surrogatepass') for each in given]
        return any(hmac.compare_digest(each, (self.token or '').encode()) for each in words)


def _tokens_in(target: str) -> list[str]:
    return parse_qs(urlsplit(target).query).get('token', [])


def _host_name(host: str) -> str:
    try:
        return urlsplit(f'//{host}').hostname or ''
    except ValueError:
        return ''


def _is_same_origin(origins: Sequence[str], host: str) -> bool:
    if len(origins) != 1:
        return False
    try:
        return urlsplit(origins[0]).netloc.lower() == host.lower()
    except ValueError:
        return False


def guarded_serve(
    guard: Guard, attendance: Attendance, is_read_only: bool = False
) -> Callable[..., Any]:
    """Return a replacement of `websockets.serve` that checks each request.

    Args:
        guard: Accepts or rejects requests.
        attendance: Records when the visitor in control sends input or disconnects.
        is_read_only: Whether visitors can only watch.
    """

    def guarded(handler: Any, **options: Any) -> Any:
        process_request = options.pop('process_request')
        process_response = options.pop('process_response')

        def check(connection: Any, request: Request) -> Response | None:
            refusal = guard.refusal(request.path, request.headers)
            if refusal is not None:
                return refusal
            cookie = guard.admission(request.path)
            if cookie is not None:
                # Redirect, so that the address with the token is not copied by accident.
                return _answer(303, 'welcome', {'Set-Cookie': cookie, 'Location': '/'})
            answer: Response | None = process_request(connection, request)
            return answer

        def close(connection: Any, request: Request, response: Response) -> Response:
            changed = process_response(connection, request, response) or response
            for name in _OPENING_HEADERS:
                if name in changed.headers:
                    del changed.headers[name]
            for name, value in _CLOSING_HEADERS.items():
                changed.headers[name] = value
            _adapt(changed, is_read_only)
            return changed

        attended = _attended(handler, attendance)
        return serve(attended, process_request=check, process_response=close, **options)

    return guarded


def _adapt(response: Response, is_read_only: bool) -> None:
    """Add the language and the viewport to an HTML page, in place.

    In read-only mode, the viewer's WebAssembly program shows `Watching` instead of `Controlling`.
    """
    content = response.headers.get('Content-Type', '')
    body = bytes(response.body or b'')
    if content.startswith('text/html'):
        response.body = body.replace(*_PAGE_START, 1)
        del response.headers['Content-Length']
        response.headers['Content-Length'] = str(len(response.body))
    elif is_read_only and content == 'application/wasm':
        response.body = body.replace(_ROLE, _READ_ONLY_ROLE)


def _attended(handler: Any, attendance: Attendance) -> Callable[[Any], Awaitable[None]]:
    """Wrap `handler`; `attendance` then records input and disconnection of the page in control."""

    async def handle(connection: Any) -> None:
        # A browser that hangs does not confirm the end, and the next visitor would wait for it.
        connection.close_timeout = _CLOSE_TIMEOUT
        if urlsplit(connection.request.path).path != _IN_CONTROL:
            await handler(connection)
            return
        receive, has_sent = connection.recv, False

        # Iteration over the connection calls `recv` too.
        async def recv(*arguments: Any, **options: Any) -> Any:
            nonlocal has_sent
            message = await receive(*arguments, **options)
            has_sent = True
            attendance.note()
            return message

        connection.recv = recv
        try:
            await handler(connection)
        finally:
            # A second browser is rejected before it sends anything: it was never in control.
            if has_sent:
                attendance.end_visit()

    return handle


def _answer(status: int, text: str, headers: dict[str, str] | None = None) -> Response:
    body = f'{text}\n'.encode()
    fields = {'Content-Type': 'text/plain', 'Content-Length': str(len(body)), **(headers or {})}
    return Response(status, text, Headers(fields), body)
