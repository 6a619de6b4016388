"""Write an actor as an ONNX file, with normalisation and metadata."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    require_extra,
    run_command,
    say,
)
from policy_node.policies.shipped import actor_path

_NAME = 'fetch_hand_sim export'


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the file; returns the exit code."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('actor', help='name of a shipped actor, or its .safetensors file')
    parser.add_argument('target', type=Path, help='file to write, <name>.onnx')
    options = parser.parse_args(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    for extra in ('actors', 'onnx'):
        require_extra(extra)
    from policy_node.policies.onnx_export import export

    if options.target.suffix != '.onnx':
        raise UsageError(f'target {str(options.target)!r}; allowed: a name that ends in .onnx')
    try:
        difference = export(actor_path(options.actor), options.target)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except OSError as error:
        raise CommandError(str(error)) from None
    say(f'{options.target}: actions within {difference:.1e} of the checkpoint')
    return EXIT_SUCCESS


if __name__ == '__main__':
    sys.exit(main())
