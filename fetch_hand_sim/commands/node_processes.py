"""Start and stop the nodes of this package as child processes.

Executables are found through entry points, so no code of `policy_node` is imported here.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution, entry_points
from typing import IO

from node_runtime import signals
from node_runtime.command_line import EXIT_SUCCESS, CommandError, UsageError, say

_DISTRIBUTION = 'fetch_hand_sim'
_ACTORS = 'fetch_hand_sim.actors'
_PARENT = signals.__name__
_SHUTDOWN_TIMEOUT = 10.0


def executable(name: str, parent: int | None = None) -> list[str]:
    """Return the command line that runs the executable `name` of this package.

    If `parent` is a process id, the started process terminates when that process does.

    Raises:
        UsageError: If this package runs from its sources and is not installed.
    """
    try:
        point = distribution(_DISTRIBUTION).entry_points.select(group='console_scripts')[name]
    except PackageNotFoundError:
        raise UsageError(f'{_DISTRIBUTION} is not installed: pip install .') from None
    function = f'__import__({point.module!r}, fromlist=["_"]).{point.attr}'
    # Before slow imports.
    first = '' if parent is None else f'import {_PARENT}; {_PARENT}.end_with_parent({parent}); '
    # `-P` keeps modules of the working directory out, as an installed executable does.
    return [sys.executable, '-P', '-c', f'{first}import sys; sys.exit({function}())']


def is_actor_shipped(task: str) -> bool:
    """Return whether an installed package ships an actor for a task.

    Each entry point of the group `fetch_hand_sim.actors` is a function that returns the shipped
    actors of its package by task.
    """
    return any(task in point.load()() for point in entry_points(group=_ACTORS))


def policy_or_default(policy: str, task: str) -> str:
    """Return `policy`; if empty, the shipped actor of a task, or `random` with a printed line."""
    if policy or is_actor_shipped(task):
        return policy or task
    say(f'No actor is shipped for {task} yet: commands are random.')
    return 'random'


def open_log(name: str) -> IO[str]:
    """Open a log file `<name>_*.log`, which is deleted when closed; CommandError if this fails."""
    try:
        return tempfile.NamedTemporaryFile('w+', prefix=f'{name}_', suffix='.log')
    except OSError as error:
        raise CommandError(f'cannot write the output of the nodes: {error.strerror}') from None


def start_node(
    name: str,
    parameters: Mapping[str, object],
    output: IO[str],
    namespace: str = '',
    *arguments: str,
) -> subprocess.Popen[str]:
    """Start the executable `name` as a child process that terminates when this process does.

    `parameters` are ROS parameters by name; `output` receives stdout and stderr; `arguments` are
    further ROS arguments. Ctrl-C in the terminal does not reach the child process.
    """
    words = []
    for parameter, value in parameters.items():
        # ROS reads values as YAML: unquoted text may be a date, a number or a comment.
        words += ['-p', f'{parameter}:={json.dumps(value, ensure_ascii=False)}']
    if namespace:
        words += ['-r', f'__ns:=/{namespace.strip("/")}']
    return subprocess.Popen(
        [*executable(name, parent=os.getpid()), '--ros-args', *words, *arguments],
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def start_nodes(
    nodes: Mapping[str, Mapping[str, object]], output: IO[str], namespace: str = '', *arguments: str
) -> list[subprocess.Popen[str]]:
    """Start several nodes and return their processes; if one cannot start, stop the others.

    `nodes` maps the name of each executable to the ROS parameters of the node.
    """
    started: list[subprocess.Popen[str]] = []
    try:
        for name, parameters in nodes.items():
            started.append(start_node(name, parameters, output, namespace, *arguments))
    except BaseException:
        for process in started:
            stop_node(process)
        raise
    return started


def stop_node(process: subprocess.Popen[str]) -> int:
    """Terminate a node, or kill it after 10 s; return its exit code, 0 if it was still loading."""
    if process.poll() is not None:
        return process.returncode
    # SIGINT would print a traceback while Python starts.
    process.terminate()
    try:
        code = process.wait(_SHUTDOWN_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
    return EXIT_SUCCESS if code == -signal.SIGTERM else code
