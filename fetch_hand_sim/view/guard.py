"""Who may see the page and who may command from it: rules for every request to the web server.

The viewer that comes with MuJoCo answers anybody, takes models from visitors and lets other sites
read its answers. This is what stands before it.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from fetch_hand_sim.view.attendance import Attendance

_IN_CONTROL = '/ui'
_SOCKETS = frozenset({_IN_CONTROL, '/state'})
# Seconds for a farewell to be confirmed.
_FAREWELL = 3.0
# Carries the token after the first request. Browsers give all ports of a host the same cookies, so
# that the port is in the name.
_COOKIE = 'fetch_hand_sim_view_{port}'
_FORBIDDEN_PATHS = frozenset({'/drop'})
# Let other sites read the answers, or load them.
_OPENING_HEADERS = ('Access-Control-Allow-Origin', 'Cross-Origin-Resource-Policy')
_CLOSING_HEADERS = {
    # A frame of another site could lure clicks onto the page.
    'X-Frame-Options': 'DENY',
    'Content-Security-Policy': "frame-ancestors 'none'",
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff',
}


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's own, reachable from nowhere else."""
    try:
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:
        # A name, also one that begins like such an address.
        return False


def new_token() -> str:
    """Returns a fresh secret for an address."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered."""

    status: int
    reason: str


class Guard:
    """Decides about requests.

    Without a token only addresses of this machine are served, so that a name which an attacker
    points at 127.0.0.1 is not. With a token, whoever has it. A web socket must come from the page
    itself, never from a page of another site.

    Args:
        token: What visitors must show; None for nothing.
        port: That is listened on; two pages of one host know their visitors apart by it.
    """

    def __init__(self, token: str | None = None, port: int = 0) -> None:
        self.token = token
        self._cookie = _COOKIE.format(port=port)

    def refusal(self, target: str, headers: Headers) -> Refusal | None:
        """Returns why a request is refused, or None.

        Args:
            target: Path and query.
            headers: Those of the request.
        """
        try:
            path = urlsplit(target).path
        except ValueError:
            return Refusal(400, 'this is no address')
        if path in _FORBIDDEN_PATHS:
            return Refusal(403, 'this page takes no files')
        hosts = headers.get_all('Host')
        if len(hosts) != 1:
            return Refusal(400, 'one Host header is needed')
        if self.token is None:
            if not is_loopback(_host_name(hosts[0])):
                return Refusal(403, 'this page is served to this machine only')
        elif not self._has_token(target, headers):
            return Refusal(403, 'the address lacks its token')
        if path in _SOCKETS and not _is_same_origin(headers.get_all('Origin'), hosts[0]):
            return Refusal(403, 'only the page itself may connect')
        return None

    def admission(self, target: str) -> str | None:
        """Returns the cookie for whoever came with the token in the address, or None."""
        if self.token is None or not self._matches(parse_qs(urlsplit(target).query).get('token')):
            return None
        # A strict one would be kept from the redirect that a link in a chat leads to. Sockets, with
        # which alone one commands, ask for the page's origin besides.
        return f'{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax'

    def _has_token(self, target: str, headers: Headers) -> bool:
        given = parse_qs(urlsplit(target).query).get('token', [])
        for line in headers.get_all('Cookie'):
            try:
                cookies = SimpleCookie(line)
            except CookieError:
                continue
            if self._cookie in cookies:
                given.append(cookies[self._cookie].value)
        return self._matches(given)

    def _matches(self, given: Sequence[str] | None) -> bool:
        # Bytes that are no text come as lone surrogates.
        words = [each.encode('utf-8', 'surrogatepass') for each in given or ()]
        return any(hmac.compare_digest(each, (self.token or '').encode()) for each in words)


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


def guarded_serve(guard: Guard, attendance: Attendance) -> Callable[..., Any]:
    """Returns `websockets.serve` with a guard before it.

    Args:
        guard: Decides about requests.
        attendance: Hears of all that the page in control sends.
    """

    def guarded(handler: Any, **options: Any) -> Any:
        process_request = options.pop('process_request')
        process_response = options.pop('process_response')

        def check(connection: Any, request: Request) -> Response | None:
            refusal = guard.refusal(request.path, request.headers)
            if refusal is not None:
                return _answer(refusal.status, refusal.reason)
            cookie = guard.admission(request.path)
            if cookie is not None:
                # Away from the address that holds the token, so that nobody copies it by chance.
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
            return changed

        attended = _attended(handler, attendance)
        return serve(attended, process_request=check, process_response=close, **options)

    return guarded


def _attended(handler: Any, attendance: Attendance) -> Callable[[Any], Awaitable[None]]:
    """A handler of web sockets that tells what is heard, and takes leave in time."""

    async def handle(connection: Any) -> None:
        # A browser that hangs confirms no farewell, and whoever takes over would wait for it.
        connection.close_timeout = _FAREWELL
        if urlsplit(connection.request.path).path == _IN_CONTROL:
            _listen(connection, attendance)
        await handler(connection)

    return handle


def _listen(connection: Any, attendance: Attendance) -> None:
    """Notes what a connection receives; iterating over it calls `recv`, too."""
    receive = connection.recv

    async def recv(*arguments: Any, **options: Any) -> Any:
        message = await receive(*arguments, **options)
        attendance.note()
        return message

    connection.recv = recv


def _answer(status: int, text: str, headers: dict[str, str] | None = None) -> Response:
    body = f'{text}\n'.encode()
    fields = {'Content-Type': 'text/plain', 'Content-Length': str(len(body)), **(headers or {})}
    return Response(status, text, Headers(fields), body)
