"""The command line of `view`.

Exit code 0: the user ended the program; 1: no robot or no free port was found, or a node failed;
2: bad usage or an unreadable file.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from msgs_spec.tasks import TASKS
from msgs_spec.topics import NAMESPACE
from node_runtime.command_line import CommandParser, require_extra, run_command

_LOOPBACK = '127.0.0.1'
# ROS allows 245, including the names of topics and services.
_LONGEST_NAMESPACE = 150
_DESCRIPTION = (
    'Show a running robot, or episode files, on a page in the browser. Without arguments: the '
    'running robot. With --task: start simulator and policy if no robot runs. Without --host, '
    'every user of this machine may command the robot.'
)


def _namespace(text: str) -> str:
    """Return a namespace without slashes around it; ArgumentTypeError if it is invalid."""
    inner = text.strip('/')
    if _is_namespace(inner):
        return inner
    meant = re.sub(r'[^\w/]', '_', inner, flags=re.ASCII)
    hint = f'; did you mean {meant!r}?' if _is_namespace(meant) and meant.strip('_/') else ''
    raise argparse.ArgumentTypeError(
        f'{text[:80]!r} given; allowed: letters, digits and _, also several such names with / '
        f'between them, none with a digit first, up to {_LONGEST_NAMESPACE} characters{hint}'
    )


def _is_namespace(text: str) -> bool:
    return len(text) <= _LONGEST_NAMESPACE and NAMESPACE.fullmatch(text) is not None


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse `arguments`, by default `sys.argv`; `ros_arguments` are those from `--ros-args` on."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    cut = words.index('--ros-args') if '--ros-args' in words else len(words)
    parser = CommandParser(prog='view', description=_DESCRIPTION)
    parser.add_argument('path', nargs='?', type=Path, help='an episode or folder to play')
    parser.add_argument('--task', choices=list(TASKS), metavar='TASK', help='one of the tasks')
    parser.add_argument('--robot', type=_namespace, default='', help='namespace of the robot')
    parser.add_argument('--policy', default='', help='policy to start with --task')
    parser.add_argument(
        '--trust', action='store_true', help='allow policies that run code of their own'
    )
    parser.add_argument('--episode-dir', default='', help='log episodes of --task here')
    parser.add_argument('--port', type=int, default=0, help='default: the first free from 8080')
    parser.add_argument(
        '--host', default=_LOOPBACK, help='interface to listen on; default: this machine only'
    )
    parser.add_argument('--read-only', action='store_true', help='the page can watch but not act')
    parser.add_argument(
        '--browser', action=argparse.BooleanOptionalAction, default=True, help='open a browser'
    )
    parser.add_argument(
        '--wait', type=float, default=10.0, help='seconds to wait for a robot; default: 10'
    )
    options = parser.parse_args(words[:cut])
    options.ros_arguments = words[cut:]
    if not 0 <= options.port <= 65535:
        parser.error(f'--port {options.port}; allowed: 0 ... 65535')
    if not options.wait >= 0.0:
        parser.error(f'--wait {options.wait:g}; allowed: 0 and more')
    of_a_robot = _given(options, 'task', 'robot', 'policy', 'trust', 'episode_dir')
    if options.path is not None and of_a_robot:
        parser.error(f'a file and {of_a_robot} exclude each other')
    options.for_a_start = _given(options, 'policy', 'trust', 'episode_dir')
    if options.for_a_start and not options.task:
        parser.error(f'{options.for_a_start}: only together with --task, for the robot it starts')
    return options


def _given(options: argparse.Namespace, *names: str) -> str:
    """Return the options of `names` that are set, like `--task and --policy`; '' if none."""
    return ' and '.join(f'--{name.replace("_", "-")}' for name in names if getattr(options, name))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = parse(arguments)
    if options.path is not None:
        from fetch_hand_sim.view.player import run_files

        return run_command('view', lambda: run_files(options))
    return run_command('view', lambda: _run_live(options))


def _run_live(options: argparse.Namespace) -> int:
    require_extra('ros')
    from fetch_hand_sim.view.live_session import run_live

    return run_live(options)
