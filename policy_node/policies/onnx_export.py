"""Writes a checkpoint as an ONNX file that acts alike; needs torch and its exporter."""

from __future__ import annotations

import logging
import os
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from node_runtime.command_line import CommandError
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.onnx import INPUTS, OUTPUT, OnnxActor

# Largest difference between the actions of both, in [-1, 1]; float32 sums differ in order.
_TOLERANCE = 1e-4
_TRIALS = 100


class _Exported(nn.Module):
    """Observation and goal in, action out."""

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self._actor = actor

    def forward(self, observation: Tensor, desired_goal: Tensor) -> Tensor:
        action: Tensor = self._actor(self._actor.features(observation, desired_goal))
        return action


def export(source: Path, target: Path) -> float:
    """Writes a checkpoint as ONNX; the file is complete and checked, or not there.

    Returns:
        The largest difference between the actions of both on random observations.

    Raises:
        ValueError: If the checkpoint cannot be used.
        CommandError: If actions differ.
        OSError: If it cannot be written.
    """
    actor, info = checkpoint.load(source)
    shape = actor.shape
    if shape.past_actions:
        raise ValueError(f'{source}: an actor with past actions cannot be written as ONNX')
    sizes = (shape.observation_size, shape.goal_size)
    batch = torch.export.Dim('batch')
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        partial = Path(folder) / target.name
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            logging.getLogger('torch.onnx').setLevel(logging.ERROR)
            torch.onnx.export(
                _Exported(actor),
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
            raise CommandError(f'actions of {target} differ by {difference:g}; nothing is written')
        os.replace(partial, target)
    return difference


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
