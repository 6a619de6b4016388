"""The actor as a torch module, for training; it maps observation and goal to an action."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from policy_node.policies.network_shape import (
    INPUT_CLIP,
    NORMALIZED_CLIP,
    NetworkPolicy,
    NetworkShape,
)


class MLP(nn.Module):
    """Multilayer perceptron: hidden layers with ReLU, linear output, Glorot weights, zero biases.

    The initialisation equals that of the paper's code (`baselines/her/util.py`). The output layer
    stays float32 under autocast, because bfloat16 rounds values near -50 to steps of 0.25.
    """

    def __init__(self, input_size: int, output_size: int, shape: NetworkShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        size = input_size
        for width in shape.hidden_sizes:
            layers.append(_linear(size, width))
            if shape.layer_norm:
                layers.append(nn.LayerNorm(width))
            layers.append(nn.ReLU())
            size = width
        self.hidden = nn.Sequential(*layers)
        self.output = _linear(size, output_size)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs (..., output_size), float32, for inputs (..., size)."""
        hidden = self.hidden(inputs).float()
        with torch.autocast(hidden.device.type, enabled=False):
            output: Tensor = self.output(hidden)
        return output


def _linear(input_size: int, output_size: int) -> nn.Linear:
    layer = nn.Linear(input_size, output_size)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Normalizer(nn.Module):
    """Normalize network inputs with the mean and standard deviation of a checkpoint.

    During training, `policy_node.training.experience.experience.RunningStatistics` sets both.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer('mean', torch.zeros(size))
        self.register_buffer('std', torch.ones(size))

    def forward(self, values: Tensor) -> Tensor:
        """Clip `values` to [-200, 200]; return (values - mean) / std, clipped to [-5, 5]."""
        clipped = values.clamp(-INPUT_CLIP, INPUT_CLIP)
        return ((clipped - self.mean) / self.std).clamp(-NORMALIZED_CLIP, NORMALIZED_CLIP)


class Actor(nn.Module, NetworkPolicy):
    """Deterministic policy: a multilayer perceptron with tanh output on normalised inputs."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        self.observation_normalizer = Normalizer(shape.input_size)
        self.goal_normalizer = Normalizer(shape.goal_size)
        self.network = MLP(shape.feature_size, shape.action_size, shape)

    def features(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return the normalised network input (..., feature_size).

        Args:
            observation: Observation and past actions, (..., input_size).
            goal: Desired goal, (..., goal_size).
        """
        normalized = self.observation_normalizer(observation), self.goal_normalizer(goal)
        inputs: Tensor = self.shape.inputs((observation, goal), normalized)
        return inputs

    def forward(self, features: Tensor) -> Tensor:
        """Return actions (..., action_size) in [-1, 1] for network inputs made by `features`."""
        return torch.tanh(self.network(features))

    @torch.inference_mode()
    def act(self, seen: NDArray[np.float32], goal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions in [-1, 1] for `seen`, (..., input_size), and `goal`, (..., goal_size)."""
        action: Tensor = self(self.features(self._input(seen), self._input(goal)))
        found: NDArray[np.float32] = action.cpu().numpy()
        return found

    def _input(self, values: NDArray[np.float32]) -> Tensor:
        # torch would warn of read-only arrays.
        values = np.require(values, requirements=['C_CONTIGUOUS', 'WRITEABLE'])
        return torch.from_numpy(values).to(self.goal_normalizer.mean.device)
