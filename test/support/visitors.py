"""Visitors of the page that are no browsers: one that takes what comes, and one that is deaf."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from threading import Thread
from typing import Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

# Bytes that a deaf visitor's side of a connection takes; Linux makes it a little more.
_SMALL = 2048
_TIMEOUT = 30.0


class Visitor:
    """Takes every picture of a page and confirms it as a page would; draws none.

    Args:
        address: Host and port of the page.
        name: Of its session, another for each visitor.

    Attributes:
        pictures: How many it has taken.
    """

    def __init__(self, address: str, name: str) -> None:
        self.pictures = 0
        self._connections = ExitStack()
        page = self._connections.enter_context(
            connect(
                f'ws://{address}/state?sid={name}',
                origin=f'http://{address}',
                max_size=None,
                open_timeout=_TIMEOUT,
                # Waits for a viewer that is stopped, as a page does.
                ping_interval=None,
            )
        )
        Thread(target=self._take, args=(page,), daemon=True).start()

    def close(self) -> None:
        """Close the connections."""
        self._connections.close()

    def _take(self, page: ClientConnection) -> None:
        try:
            for message in page:
                if isinstance(message, bytes):
                    self.pictures += 1
                    page.send('state_ack')
        except ConnectionClosed:
            pass


class DeafVisitor:
    """A visitor that opens the connections of a page and then reads nothing, like a hung browser.

    Its receive buffers are small, so that writes of the server soon block.
    """

    def __init__(self, address: str) -> None:
        self._connections: list[socket.socket] = []
        upgrade = (
            f'Origin: http://{address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
            'Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n'
        )
        for target, fields, answer in (
            ('/state?sid=deaf', upgrade, 101),
            ('/ui?sid=deaf', upgrade, 101),
            # Larger than any buffer.
            ('/model', '', 200),
        ):
            self._ask(address, f'GET {target} HTTP/1.1\r\nHost: {address}\r\n{fields}\r\n', answer)

    def close(self) -> None:
        """Leaves."""
        for connection in self._connections:
            connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, address: str, request: str, answer: int) -> None:
        host, port = address.rsplit(':', 1)
        connection = socket.socket()
        self._connections.append(connection)
        # Before `connect`, which sends the size to the server.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SMALL)
        connection.settimeout(_TIMEOUT)
        connection.connect((host, int(port)))
        connection.sendall(request.encode())
        line = connection.recv(len('HTTP/1.1 200'), socket.MSG_WAITALL).decode()
        assert line == f'HTTP/1.1 {answer}', f'{request.splitlines()[0]}: {line}'
