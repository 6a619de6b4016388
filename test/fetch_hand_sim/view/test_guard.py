"""The page is for this machine, or for those with the token; others may neither read nor act."""

from __future__ import annotations

import http.client
import logging
import socket
from http.cookies import SimpleCookie
from unittest.mock import MagicMock

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosedOK, InvalidStatus
from websockets.sync.client import connect

from fetch_hand_sim.view.guard import Guard, is_loopback
from fetch_hand_sim.view.page.page import Page
from fetch_hand_sim.view.session import Requests
from fetch_hand_sim.view.web import Address, FrameRate, open_page
from node_runtime.command_line import CommandError

TOKEN = 'a-token'


def status(guard, target, *headers):
    """The status of a rejected request; None if it is served."""
    answer = guard.refusal(target, Headers(headers))
    return answer and answer.status_code


@pytest.mark.parametrize('host', ['localhost:8080', '127.0.0.1:8080', '[::1]:8080', 'LOCALHOST'])
def test_this_machine_is_served(host):
    assert status(Guard(), '/', ('Host', host)) is None
    assert status(Guard(), '/ui?sid=1', ('Host', host), ('Origin', f'http://{host}')) is None


@pytest.mark.parametrize('path', ['/ui', '/state', '/state?sid=1'])
@pytest.mark.parametrize(
    'origin', ['http://evil.example', 'http://localhost:9999', 'null', '', 'http://[', None]
)
@pytest.mark.parametrize('token', [None, TOKEN])
def test_a_web_socket_of_another_site_is_refused(path, origin, token):
    headers = [('Host', 'localhost:8080'), ('Cookie', f'fetch_hand_sim_view_0={TOKEN}')]
    if origin is not None:
        headers.append(('Origin', origin))
    assert status(Guard(token), path, *headers) == 403


LOCAL = ('Host', 'localhost')


@pytest.mark.parametrize(
    ('target', 'headers', 'expected'),
    [
        # Names that point here.
        ('/', [('Host', 'evil.example')], 403),
        ('/', [('Host', '192.168.0.7:8080')], 403),
        ('/', [('Host', 'localhost.evil.example')], 403),
        ('/', [('Host', '')], 403),
        # One host is needed.
        ('/', [], 400),
        ('/', [LOCAL, ('Host', 'evil.example')], 400),
        # A traceback on the terminal of the robot would be a visitor's to make.
        ('//[', [LOCAL], 400),
        ('http://[::1/', [LOCAL], 400),
        ('//a[b]c/?token=a-token', [LOCAL], 400),
        # No files from visitors.
        ('/drop?sid=1', [LOCAL, ('Origin', 'http://localhost')], 403),
    ],
)
def test_without_a_token_only_this_machine_is_served(target, headers, expected):
    assert status(Guard(), target, *headers) == expected
    if expected == 400:
        assert status(Guard(TOKEN), target, *headers) == expected


@pytest.mark.parametrize(
    ('target', 'cookie'),
    [
        ('/', ''),
        ('/?token=wrong', ''),
        ('/?token=\udcff', ''),
        ('/', 'fetch_hand_sim_view_0=wrong'),
        ('/', 'fetch_hand_sim_view_1=a-token'),
        ('/', 'other=a-token'),
    ],
)
def test_without_the_token_no_visitor_is_served(target, cookie):
    assert status(Guard(TOKEN), target, ('Host', 'robot.example'), ('Cookie', cookie)) == 403
    assert Guard(TOKEN).admission(target) is None


def test_the_token_admits_to_one_of_two_pages_of_a_host():
    """Browsers give all ports of a host the same cookies."""
    host, jar = ('Host', 'robot.example'), SimpleCookie()
    guards = [Guard('one', 8080), Guard('two', 8081)]
    for guard in guards:
        assert status(guard, f'/?token={guard.token}', host) is None
        admission = guard.admission(f'/?token={guard.token}')
        assert 'HttpOnly' in admission and 'SameSite=Lax' in admission
        jar.load(admission)
    cookie = '; '.join(f'{name}={morsel.value}' for name, morsel in jar.items())
    assert [status(guard, '/', host, ('Cookie', cookie)) for guard in guards] == [None, None]


@pytest.mark.parametrize(
    ('route', 'host'),
    [
        (('192.168.0.7', 40000), '192.168.0.7'),
        (('2001:db8::7', 40000), '[2001:db8::7]'),
        (('127.0.0.1', 40000), 'robot'),
        (OSError('Network is unreachable'), 'robot'),
    ],
)
def test_the_address_is_one_by_which_others_come(monkeypatch, route, host):
    network = MagicMock()
    network.__enter__.return_value.getsockname.side_effect = [route, route]
    monkeypatch.setattr(socket, 'socket', lambda *_: network)
    monkeypatch.setattr(socket, 'gethostname', lambda: 'robot')
    assert Address('0.0.0.0', 8080, TOKEN).url == f'http://{host}:8080/?token={TOKEN}'
    assert Address('10.0.0.1', 8080, TOKEN).url == f'http://10.0.0.1:8080/?token={TOKEN}'


@pytest.mark.parametrize('is_read_only', [True, False])
def test_the_warning_names_what_others_can_do(is_read_only):
    warning = Address('0.0.0.0', 8080, TOKEN, is_read_only).warning
    assert ('command' in warning) != is_read_only


def test_loopback_is_told_from_the_rest():
    assert is_loopback('127.0.0.1') and is_loopback('127.9.9.9') and is_loopback('localhost')
    for name in ('127.evil.example', '127.0.0.1.evil.example', '127.1.evil', ''):
        assert not is_loopback(name)
    assert not is_loopback('0.0.0.0') and not is_loopback('::') and not is_loopback('10.0.0.1')


# The server itself


@pytest.fixture(scope='module')
def address():
    plugins = [Page(), Requests(lambda request: None)]
    handle, address = open_page('127.0.0.1', 0, plugins, FrameRate(), is_read_only=True)
    yield address
    handle.close()


def get(address, path, **headers):
    connection = http.client.HTTPConnection('127.0.0.1', address.port, timeout=10)
    connection.request('GET', path, headers=headers)
    return connection.getresponse()


def test_server_gives_the_page_and_opens_it_to_no_other_site(address):
    assert address.host == '127.0.0.1' and address.token is None and address.warning is None
    for path in ('/', '/model', '/web_client.js'):
        response = get(address, path)
        assert response.status == 200, path
        assert response.getheader('Access-Control-Allow-Origin') is None
        assert response.getheader('X-Frame-Options') == 'DENY'
    assert get(address, '/', Host='evil.example').status == 403
    page = get(address, '/').read().decode()
    assert '<html lang="en">' in page and 'name="viewport"' in page and '</html>' in page
    assert get(address, '/drop').status == 403


def test_a_read_only_page_calls_no_visitor_controlling(address):
    program = get(address, '/web_client.wasm').read()
    assert b'\0Watching\0' in program and b'Controlling' not in program


def test_server_refuses_web_sockets_of_other_sites(address):
    url = f'ws://127.0.0.1:{address.port}/state?sid=x'
    with connect(url, origin=f'http://127.0.0.1:{address.port}') as visitor:
        assert visitor.recv(timeout=10)
    for origin in ('http://evil.example', None):
        with pytest.raises(InvalidStatus):
            connect(url, origin=origin)


@pytest.mark.parametrize(
    ('error', 'is_said'), [(ConnectionClosedOK(None, None), False), (ValueError('x'), True)]
)
def test_a_closed_connection_is_no_error(address, caplog, error, is_said):
    logging.getLogger('asyncio').error('Task exception was never retrieved', exc_info=error)
    assert ('never retrieved' in caplog.text) == is_said


def test_a_taken_port_or_foreign_address_is_one_line(address):
    for host, port, line in (
        ('127.0.0.1', address.port, rf'cannot listen on 127.0.0.1 port {address.port}: '),
        ('203.0.113.1', 0, r'cannot listen on 203\.0\.113\.1: no address of this'),
    ):
        with pytest.raises(CommandError, match=line):
            open_page(host, port, [Page()], FrameRate())
