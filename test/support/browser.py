"""A real headless Chromium, driven over its own protocol."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from contextlib import ExitStack
from io import BytesIO
from threading import Thread
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import connect

from msgs_spec.arrays import Picture

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
SIZE = (960, 640)
# WebGL 2 without a GPU; nothing of its own on the network.
OPTIONS = (
    '--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader '
    '--enable-unsafe-swiftshader --disable-quic --no-first-run --disable-background-networking '
    '--disable-component-update --disable-sync --remote-debugging-port=0'
).split()


def find_browser() -> str | None:
    """Where an installed Chromium is, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


# Seconds without an answer after which a browser counts as broken, on a busy machine without GPU.
_PATIENCE = 180.0
_CONTROL = 2
_KEY_CODES = {'Control': 17, 'ArrowLeft': 37, 'ArrowUp': 38, 'ArrowRight': 39, 'ArrowDown': 40}


def _page_of(port: str) -> str:
    """Waits for the first page of a browser that starts; returns where to drive it."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        with urllib.request.urlopen(f'http://{port}/json') as answer:
            pages = [page for page in json.load(answer) if page['type'] == 'page']
        if pages:
            return str(pages[0]['webSocketDebuggerUrl'])
        time.sleep(0.1)
    raise AssertionError('the browser has no page')


class Browser:
    """One window with one page."""

    def __init__(self) -> None:
        program = find_browser()
        assert program is not None
        self._profile = tempfile.mkdtemp(prefix='chromium_')
        self._process = subprocess.Popen(
            [program, *OPTIONS, f'--user-data-dir={self._profile}', 'about:blank'],
            stderr=subprocess.PIPE,
            text=True,
            # So that a signal reaches all of its processes.
            start_new_session=True,
        )
        assert self._process.stderr is not None
        port = ''
        for line in self._process.stderr:
            if found := re.search(r'ws://([\w.:]+)/', line):
                port = found[1]
                break
        # A full pipe would stop the browser.
        Thread(target=self._process.stderr.read, daemon=True).start()
        self._connections = ExitStack()
        # Drawing without a GPU keeps the page from answering for a while.
        self._socket = self._connections.enter_context(
            connect(
                _page_of(port),
                max_size=None,
                ping_interval=None,
                open_timeout=_PATIENCE,
                # Of a browser that was killed nothing more is to come.
                close_timeout=0.1,
            )
        )
        self._number = 0
        self._modifiers = 0
        self.events: list[dict[str, Any]] = []
        for domain in ('Page', 'Network', 'Runtime'):
            self.call(f'{domain}.enable')
        self.call(
            'Emulation.setDeviceMetricsOverride',
            width=SIZE[0],
            height=SIZE[1],
            deviceScaleFactor=1,
            mobile=False,
        )

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({'id': self._number, 'method': method, 'params': parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=_PATIENCE))
            if message.get('id') == self._number:
                assert 'error' not in message, message
                result: dict[str, Any] = message['result']
                return result
            self.events.append(message)

    def open(self, url: str) -> None:
        """Opens an address and waits until its page is there, if not drawn."""
        start = len(self.events)
        self.call('Page.navigate', url=url)
        while not any(each.get('method') == 'Page.loadEventFired' for each in self.events[start:]):
            self.events.append(json.loads(self._socket.recv(timeout=_PATIENCE)))

    def wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            try:
                self.events.append(json.loads(self._socket.recv(timeout=left)))
            except TimeoutError:
                return

    def run(self, script: str) -> Any:
        result = self.call(
            'Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True
        )
        return result['result'].get('value')

    def wait_for_frames(self, count: int) -> None:
        """Waits until the page was drawn some times, however long that takes."""
        self.run(
            f'new Promise(done => {{ let left = {count}; const next = () => '
            'left-- > 0 ? requestAnimationFrame(next) : done(); next(); })'
        )

    def screenshot(self) -> Picture:
        """Return the pixels of the page, (height, width, 3)."""
        data = base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])
        return np.asarray(Image.open(BytesIO(data)).convert('RGB'))

    def requests(self) -> list[str]:
        """Return the addresses that the page requested."""
        return [
            event['params']['request']['url']
            for event in self.events
            if event.get('method') == 'Network.requestWillBeSent'
        ]

    def move(self, x: float, y: float, pressed: bool = False) -> None:
        button = {'button': 'left', 'buttons': 1} if pressed else {'button': 'none', 'buttons': 0}
        self._mouse('mouseMoved', x, y, 0.1, **button)

    def press(self, x: float, y: float) -> None:
        self._mouse('mousePressed', x, y, 0.25, button='left', buttons=1, clickCount=1)

    def release(self, x: float, y: float) -> None:
        self._mouse('mouseReleased', x, y, 0.25, button='left', buttons=0, clickCount=1)

    def press_key(self, key: str) -> None:
        """Presses a key and holds it: `Control` or one of the arrows."""
        self._key('rawKeyDown', key)

    def release_key(self, key: str) -> None:
        self._key('keyUp', key)

    def _key(self, kind: str, key: str) -> None:
        if key == 'Control':
            self._modifiers = 0 if kind == 'keyUp' else _CONTROL
        self.call(
            'Input.dispatchKeyEvent',
            type=kind,
            key=key,
            code='ControlLeft' if key == 'Control' else key,
            windowsVirtualKeyCode=_KEY_CODES[key],
            modifiers=self._modifiers,
        )
        self.wait(0.25)

    def click(self, x: float, y: float) -> None:
        self.move(x, y)
        self.wait(0.4)
        self.press(x, y)
        self.release(x, y)

    def _mouse(self, kind: str, x: float, y: float, pause: float, **fields: Any) -> None:
        fields |= {'type': kind, 'x': x, 'y': y, 'modifiers': self._modifiers}
        self.call('Input.dispatchMouseEvent', **fields)
        self.wait(pause)

    def close(self) -> None:
        if self._process.poll() is None:
            # Those that are stopped too.
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._connections.close()
        shutil.rmtree(self._profile, ignore_errors=True)
