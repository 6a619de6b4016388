"""The actor in NumPy, for running: it loads seconds faster than torch and computes faster.

It computes in float64 with the float32 weights and rounds the action to float32. So the batch size
and the order of sums rarely change more than the last bit. torch computes in float32;
`docs/training.md` has the difference.

It uses one thread. Matrices of this size gain nothing from more, and waiting BLAS threads would
take cores from the simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from msgs_spec.arrays import Array
from policy_node.policies import checkpoint
from policy_node.policies.network_shape import (
    INPUT_CLIP,
    NORMALIZED_CLIP,
    NetworkPolicy,
    NetworkShape,
)
from policy_node.policies.policy import LoadedPolicy

# The default of torch.nn.LayerNorm.
_NORM_EPSILON = 1e-5
# Two overlapping changes of the number of threads would leave it at one.
_ONE_AT_A_TIME = Lock()


class NumpyActor(NetworkPolicy):
    """Deterministic policy: a multilayer perceptron with tanh output on normalised inputs.

    Args:
        tensors: Weights and normalisers by their names in `Actor`.
    """

    def __init__(self, shape: NetworkShape, tensors: Mapping[str, NDArray[np.float32]]) -> None:
        self.shape = shape
        self._values = {name: values.astype(np.float64) for name, values in tensors.items()}

    def act(self, seen: NDArray[np.float32], goal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (..., action_size) in -1 ... 1; `seen` is observation and past actions."""
        # Rounded to float32 first, as in training.
        given = seen.astype(np.float64), goal.astype(np.float64)
        normalized = (
            self._normalize('observation_normalizer', given[0]),
            self._normalize('goal_normalizer', given[1]),
        )
        features = self.shape.inputs(given, normalized)
        with _ONE_AT_A_TIME, _blas().limit(limits=1):
            return np.tanh(self._forward(features)).astype(np.float32)

    def _forward(self, layer: Array) -> Array:
        for name, norm in self.shape.hidden_names():
            layer = self._linear(name, layer)
            if self.shape.layer_norm:
                layer = self._norm(norm, layer)
            layer = np.maximum(layer, 0.0)
        return self._linear('network.output', layer)

    def _normalize(self, name: str, values: Array) -> Array:
        mean, std = self._values[f'{name}.mean'], self._values[f'{name}.std']
        clipped = values.clip(-INPUT_CLIP, INPUT_CLIP)
        return ((clipped - mean) / std).clip(-NORMALIZED_CLIP, NORMALIZED_CLIP)

    def _linear(self, name: str, values: Array) -> Array:
        weight, bias = self._values[f'{name}.weight'], self._values[f'{name}.bias']
        return np.asarray(values @ weight.T + bias)

    def _norm(self, name: str, values: Array) -> Array:
        centred = values - values.mean(axis=-1, keepdims=True)
        variance = np.square(centred).mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt(variance + _NORM_EPSILON)
        return np.asarray(scaled * self._values[f'{name}.weight'] + self._values[f'{name}.bias'])


@cache
def _blas() -> ThreadpoolController:
    """Return a controller of the threads of NumPy's matrix products."""
    return ThreadpoolController().select(user_api='blas')


def load_checkpoint(path: Path) -> LoadedPolicy:
    """Load a checkpoint for running; ValueError if it is invalid or of an unknown version."""
    found = checkpoint.read(path)
    actor = NumpyActor(found.info.shape, found.tensors)
    return checkpoint.loaded_actor(actor, found.info, path, found.sha256)
