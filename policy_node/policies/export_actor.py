"""Write an actor as an ONNX file, with normalisation and metadata."""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    require_extra,
    run_command,
    say,
)
from policy_node.policies.files import require_writable
from policy_node.policies.loading import actor_path
from policy_node.policies.onnx import INPUTS, OUTPUT, OnnxActor

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor

_NAME = 'fetch_hand_sim export'
# Largest difference between the actions of both, in [-1, 1]; float32 sums differ in order.
_TOLERANCE = 1e-4
_TRIALS = 100


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `fetch_hand_sim export` and return its exit code."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('actor', help='name of a shipped actor, or its .safetensors file')
    parser.add_argument('target', type=Path, help='file to write, <name>.onnx')
    options = parser.parse_args(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    for extra in ('actors', 'onnx'):
        require_extra(extra)
    if options.target.suffix != '.onnx':
        raise UsageError(f'target {str(options.target)!r}; allowed: a name that ends in .onnx')
    require_writable(options.target)
    try:
        difference = export(actor_path(options.actor), options.target)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except OSError as error:
        raise CommandError(f'{options.target}: {error.strerror or error}') from None
    say(f'{options.target}: actions within {difference:.1e} of the checkpoint')
    return EXIT_SUCCESS


def export(source: Path, target: Path) -> float:
    """Write a checkpoint as an ONNX file; after an error, no file is written.

    Returns:
        The largest difference between actions of checkpoint and ONNX file on random observations.

    Raises:
        ValueError: If the checkpoint is invalid, or its actor takes past actions as input.
        CommandError: If the largest difference exceeds `_TOLERANCE`.
        OSError: If the file cannot be written.
    """
    import onnx
    import torch

    from policy_node.policies import checkpoint

    actor, info = checkpoint.load(source)
    shape = actor.shape
    if shape.past_actions:
        raise ValueError(f'{source}: an actor with past actions cannot be written as ONNX')
    sizes = (shape.observation_size, shape.goal_size)
    batch = torch.export.Dim('batch')
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        partial = Path(folder) / target.name
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            logging.getLogger('torch.onnx').setLevel(logging.ERROR)
            torch.onnx.export(
                _whole_network(actor),
                tuple(torch.zeros(2, size) for size in sizes),
                partial,
                input_names=list(INPUTS),
                output_names=[OUTPUT],
                dynamic_shapes=({0: batch}, {0: batch}),
                external_data=False,
                dynamo=True,
                verbose=False,
            )
        model = onnx.load(partial)
        onnx.helper.set_model_props(model, checkpoint.to_metadata(info))
        onnx.save(model, partial)
        difference = _largest_difference(actor, OnnxActor(partial.read_bytes(), partial))
        if difference > _TOLERANCE:
            raise CommandError(f'actions of {target} differ by {difference:g}; no file is written')
        os.replace(partial, target)
    return difference


def _whole_network(actor: Actor) -> Any:
    """Return a torch module that maps raw observations and goals (batch, size) to actions."""
    from torch import Tensor, nn

    class WholeNetwork(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self._actor = actor

        def forward(self, observation: Tensor, desired_goal: Tensor) -> Tensor:
            action: Tensor = self._actor(self._actor.features(observation, desired_goal))
            return action

    return WholeNetwork()


def _largest_difference(actor: Actor, exported: OnnxActor) -> float:
    generator = np.random.default_rng(0)
    mean = (actor.observation_normalizer.mean.numpy(), actor.goal_normalizer.mean.numpy())
    std = (actor.observation_normalizer.std.numpy(), actor.goal_normalizer.std.numpy())
    differences = []
    for _ in range(_TRIALS):
        vectors = (generator.normal(m, 2.0 * s) for m, s in zip(mean, std, strict=True))
        observation = dict(zip(INPUTS, vectors, strict=True))
        differences.append(exported.predict(observation)[0] - actor.predict(observation)[0])
    return float(np.abs(differences).max())


if __name__ == '__main__':
    sys.exit(main())
