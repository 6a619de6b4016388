"""Nodes as child processes, for commands that run everything themselves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from typing import IO

from fetch_hand_sim.commands.executables import executable
from node_runtime.command_line import EXIT_SUCCESS, CommandError

_SHUTDOWN_TIMEOUT = 10.0


def open_log(name: str) -> IO[str]:
    """Opens a file for what nodes print, which goes when it is closed.

    Raises:
        CommandError: If there is no folder for temporary files.
    """
    try:
        return tempfile.NamedTemporaryFile('w+', prefix=f'{name}_', suffix='.log')
    except OSError as error:
        raise CommandError(f'no file for what the nodes print: {error.strerror}') from None


def start_node(
    name: str, parameters: Mapping[str, object], output: IO[str], namespace: str = ''
) -> subprocess.Popen[str]:
    """Starts a node in a process group of its own: Ctrl-C reaches only who started it.

    It ends with this process, also where that is killed.

    Args:
        name: Of the executable.
        parameters: Values by name: text, numbers or truth values.
        output: Gets what the node prints.
        namespace: Of the node.

    Raises:
        UnknownExecutableError: If there is none of that name.
    """
    words = []
    for parameter, value in parameters.items():
        # Read as YAML: text without quotes may be a date, a number or a comment.
        words += ['-p', f'{parameter}:={json.dumps(value, ensure_ascii=False)}']
    if namespace:
        words += ['-r', f'__ns:=/{namespace.strip("/")}']
    return subprocess.Popen(
        [*executable(name, parent=os.getpid()), '--ros-args', *words],
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def start_nodes(
    nodes: Mapping[str, Mapping[str, object]], output: IO[str], namespace: str = ''
) -> list[subprocess.Popen[str]]:
    """Starts several nodes, all or none.

    Args:
        nodes: Parameters of each, by the name of its executable.
        output: Gets what they print.
        namespace: Of the nodes.

    Raises:
        UnknownExecutableError: If there is none of a name.
    """
    started: list[subprocess.Popen[str]] = []
    try:
        for name, parameters in nodes.items():
            started.append(start_node(name, parameters, output, namespace))
    except BaseException:
        for process in started:
            stop_node(process)
        raise
    return started


def stop_node(process: subprocess.Popen[str]) -> int:
    """Asks a node to end; returns its exit code, 0 also for one that was still being loaded."""
    if process.poll() is not None:
        return process.returncode
    # Not SIGINT, which is a traceback as long as Python itself starts.
    process.terminate()
    try:
        code = process.wait(_SHUTDOWN_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
    return EXIT_SUCCESS if code == -signal.SIGTERM else code
