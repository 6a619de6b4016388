"""Run a command of this package.

The nodes and `view` are also executables: `ros2 run fetch_hand_sim sim_node`.
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

from msgs_spec.text import did_you_mean
from node_runtime.command_line import EXIT_USAGE, CommandParser, run_command, start_command

_NAME = 'fetch_hand_sim'


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand, or a group of subcommands such as `episodes`.

    Attributes:
        module: Module with the function `main` that runs the command; '' for a group.
        extras: Optional dependencies (extras of this package) that the module needs.
        is_node: Whether the command takes ROS parameters instead of options.
        commands: Subcommands of a group by name.
    """

    help: str
    module: str = ''
    extras: tuple[str, ...] = ()
    is_node: bool = False
    commands: dict[str, Command] = field(default_factory=dict)


def _node(text: str, module: str) -> Command:
    return Command(f'{text} (ROS node)', module, is_node=True)


_EPISODES = {
    'list': Command('list the episodes in a folder', 'fetch_hand_sim.commands.episodes_list'),
    'check': Command(
        'simulate episodes again and compare every bit', 'fetch_hand_sim.commands.episodes_check'
    ),
    'film': Command(
        'write a film or a picture, without a display', 'fetch_hand_sim.commands.episodes_film'
    ),
    'recover': Command(
        'complete the files of interrupted episodes', 'fetch_hand_sim.commands.episodes_recover'
    ),
    'export': Command(
        'write Parquet, Minari or LeRobot datasets', 'fetch_hand_sim.commands.episodes_export'
    ),
    'generate': Command(
        'log a policy in the batched simulation', 'policy_node.training.generate_episodes'
    ),
}
COMMANDS = {
    'demo': Command(
        'run a robot and its policy, log every episode', 'fetch_hand_sim.commands.demo'
    ),
    'view': Command('show a robot or episodes in the browser', 'fetch_hand_sim.view'),
    'sim': _node('run the simulated robot', 'fetch_hand_sim.sim_node'),
    'policy': _node('command a robot with a policy', 'policy_node.node'),
    'replay': _node('publish a logged episode', 'fetch_hand_sim.replay_node'),
    'visualize': _node('publish URDF, transforms and markers', 'fetch_hand_sim.visualization_node'),
    'train': Command('train a policy', 'policy_node.training.train_her', ('train',)),
    'evaluate': Command(
        'measure the success rate of a policy', 'policy_node.training.evaluate_policy'
    ),
    'robustness': Command(
        'measure success under disturbances', 'policy_node.training.robustness.command', ('train',)
    ),
    'benchmark': Command(
        "run the paper's comparison or a study", 'policy_node.training.studies.command', ('train',)
    ),
    'export': Command(
        'write a policy as ONNX', 'policy_node.policies.export_actor', ('actors', 'onnx')
    ),
    'episodes': Command('work with logged episodes: ' + ', '.join(_EPISODES), commands=_EPISODES),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the subcommand that the first arguments name; return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    command, path, rest = _split(given)
    if command is None or command.commands:
        return run_command(_NAME, lambda: _explain(given if rest else [*path, '--help']))
    name = ' '.join((_NAME, *path))
    sys.argv = [name, *(ros_arguments(rest) if command.is_node else rest)]
    return start_command(name, command.module, *command.extras)


def _explain(words: Sequence[str]) -> int:
    """Parse `words` so that argparse prints help, version, completion or an error, and exits."""
    try:
        make_parser().parse_args(words)
        return EXIT_USAGE
    finally:
        # Detects a closed pipe before the end of the process.
        sys.stdout.flush()


def _split(words: Sequence[str]) -> tuple[Command | None, list[str], list[str]]:
    """Return the subcommand (None if unknown), the words of its name, and its arguments."""
    commands, command, path = COMMANDS, None, []
    for word in words:
        if word not in commands:
            break
        path.append(word)
        command = commands[word]
        commands = command.commands
    return command, path, list(words[len(path) :])


def ros_arguments(words: Sequence[str]) -> list[str]:
    """Expand short ROS parameters: `task:=FetchPush` becomes `--ros-args -p task:=FetchPush`.

    Words that begin with `__`, such as `__ns:=/left`, become remappings (`-r`). Other ROS arguments
    may follow, with or without `--ros-args`. If a word before them lacks `:=`, nothing changes.
    """
    short = list(itertools.takewhile(lambda word: not word.startswith('-'), words))
    rest = list(words[len(short) :])
    if not short or not all(':=' in word for word in short):
        return list(words)
    given = [part for word in short for part in ('-r' if word.startswith('__') else '-p', word)]
    return ['--ros-args', *given, *(rest[1:] if rest[:1] == ['--ros-args'] else rest)]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser for help, version, completion scripts and unknown subcommands."""
    parser = _Parser(prog=_NAME, description=__doc__)
    parser.add_argument('--version', action='version', version=f'{_NAME} {version(_NAME)}')
    shtab.add_argument_to(parser, help='print a script that completes commands in your shell')
    _add_commands(parser, COMMANDS)
    return parser


class _Parser(CommandParser):
    """A parser that suggests a similar name for an unknown subcommand."""

    def error(self, message: str) -> NoReturn:
        """Print the error in one line and exit with code 2."""
        if "invalid choice: '" in message:
            given = message.split("invalid choice: '")[1].split("'")[0]
            command = _split(self.prog.split()[1:])[0]
            names = list(command.commands if command else COMMANDS)
            hint = did_you_mean(given, names) or f'; allowed: {", ".join(names)}'
            message = f'no command {given!r}{hint}'
        super().error(message)


def _add_commands(parser: argparse.ArgumentParser, commands: dict[str, Command]) -> None:
    subparsers = parser.add_subparsers(metavar='command', required=True)
    for name, command in commands.items():
        added = subparsers.add_parser(name, help=command.help, description=command.help)
        if command.commands:
            _add_commands(added, command.commands)


if __name__ == '__main__':
    sys.exit(main())
