"""`fetch_hand_sim <command>`: everything this package does, under one name.

The commands are the executables that `ros2 run fetch_hand_sim` also finds, under shorter names.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import NoReturn

import shtab

from fetch_hand_sim.commands.executables import find_executable
from msgs_spec.text import did_you_mean
from node_runtime.command_line import EXIT_USAGE, CommandParser, run_command, start_command

_NAME = 'fetch_hand_sim'


@dataclass(frozen=True, slots=True)
class Command:
    """One word of the command line.

    Attributes:
        help: What it does.
        executable: The executable it stands for; '' if there is none.
        module: What it runs where there is no executable: the `main` of this module.
        is_node: Whether the executable takes ROS parameters instead of options.
        commands: Commands of its own, by name.
    """

    help: str
    executable: str = ''
    module: str = ''
    is_node: bool = False
    commands: dict[str, Command] = field(default_factory=dict)


COMMANDS = {
    'demo': Command(
        'a robot and its actor in two processes, every episode logged',
        module='fetch_hand_sim.commands.demo',
    ),
    'view': Command('a robot or episodes in the browser', 'view'),
    'sim': Command('the simulated robot, a ROS node', 'sim_node', is_node=True),
    'policy': Command('the actor, a ROS node', 'policy_node', is_node=True),
    'replay': Command('a logged episode as a ROS node', 'replay_node', is_node=True),
    'visualize': Command(
        'URDF, transforms, markers for RViz, a ROS node', 'visualization_node', is_node=True
    ),
    'train': Command('train an actor', 'train_her'),
    'evaluate': Command('success of an actor over many episodes', 'evaluate_policy'),
    'benchmark': Command("the paper's comparison, and studies of arms and seeds", 'benchmark'),
    'export': Command('write an actor as ONNX', 'export_actor'),
    'episodes': Command(
        'logged episodes: list, check, film, recover, export, generate',
        commands={
            'list': Command('what is in a directory', 'list_episodes'),
            'check': Command('run episodes again and compare every bit', 'check_episode'),
            'film': Command('a film or a picture, without a display', 'render_episode'),
            'recover': Command('make bags of what a crash cut off', 'recover_episodes'),
            'export': Command('as Parquet, Minari or LeRobot datasets', 'export_episodes'),
            'generate': Command('log an actor in the batched simulation', 'generate_episodes'),
        },
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command named by the first words with the rest; returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    command, path, rest = _split(given)
    if command is None or command.commands:
        return run_command(_NAME, lambda: _explain(given if rest else [*path, '--help']))
    sys.argv = [command.executable or path[-1], *(ros_arguments(rest) if command.is_node else rest)]
    return run_command(_NAME, lambda: _start(command, path[-1]))


def _explain(words: Sequence[str]) -> int:
    """Help, the version, completion, or an error: the parser says it and exits."""
    try:
        make_parser().parse_args(words)
        return EXIT_USAGE
    finally:
        # Where nobody reads it, that is noticed before the end of the process.
        sys.stdout.flush()


def _split(words: Sequence[str]) -> tuple[Command | None, list[str], list[str]]:
    """Returns the command that the first words name, these words, and those that follow."""
    commands, command, path = COMMANDS, None, []
    for word in words:
        if word not in commands:
            break
        path.append(word)
        command = commands[word]
        commands = command.commands
    return command, path, list(words[len(path) :])


def ros_arguments(words: Sequence[str]) -> list[str]:
    """Returns the arguments of a node; `task:=FetchPush` is enough for `--ros-args -p ...`.

    ROS has its own words after these, with `--ros-args` or without. `__ns:=/left`, which is no
    parameter but a name of ROS, becomes a remapping.
    """
    short = list(itertools.takewhile(lambda word: not word.startswith('-'), words))
    rest = list(words[len(short) :])
    if not short or not all(':=' in word for word in short):
        return list(words)
    given = [part for word in short for part in ('-r' if word.startswith('__') else '-p', word)]
    return ['--ros-args', *given, *(rest[1:] if rest[:1] == ['--ros-args'] else rest)]


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command names: for help, errors and completion."""
    parser = _Parser(prog=_NAME, description=__doc__)
    parser.add_argument('--version', action='version', version=f'{_NAME} {version(_NAME)}')
    shtab.add_argument_to(parser, help='print a script that completes commands in your shell')
    _add_commands(parser, COMMANDS)
    return parser


class _Parser(CommandParser):
    """Says what was probably meant instead of an unknown command."""

    def error(self, message: str) -> NoReturn:
        """Says what is wrong and exits."""
        if "invalid choice: '" in message:
            given = message.split("invalid choice: '")[1].split("'")[0]
            names = self._names()
            hint = did_you_mean(given, names) or f'; allowed: {", ".join(names)}'
            message = f'no command {given!r}{hint}'
        super().error(message)

    def _names(self) -> list[str]:
        command = _split(self.prog.split()[1:])[0]
        return list(command.commands if command else COMMANDS)


def _add_commands(parser: argparse.ArgumentParser, commands: dict[str, Command]) -> None:
    subparsers = parser.add_subparsers(metavar='command', required=True)
    for name, command in commands.items():
        added = subparsers.add_parser(name, help=command.help, description=command.help)
        if command.commands:
            _add_commands(added, command.commands)


def _start(command: Command, name: str) -> int:
    if command.module:
        return start_command(name, command.module)
    code: int = find_executable(command.executable).load()()
    return code


if __name__ == '__main__':
    sys.exit(main())
