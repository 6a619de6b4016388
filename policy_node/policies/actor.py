"""The actor: normalised observation and goal in, action in [-1, 1] out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from policy_node.policies.goal_features import GoalFeatures
from policy_node.policies.shipped import shipped_actors

# Plappert et al. 2018, appendix B.
INPUT_CLIP = 200.0
NORMALIZED_CLIP = 5.0


@dataclass(frozen=True, slots=True)
class NetworkShape:
    """Sizes of an actor, and of the critic trained with it.

    Attributes:
        observation_size: Length of `observation`.
        goal_size: Length of `desired_goal`.
        action_size: Length of the action.
        hidden_sizes: Width of each hidden layer.
        layer_norm: Whether a LayerNorm precedes each activation.
        goal_features: How observation and goal become inputs; None for both as they are.
    """

    observation_size: int
    goal_size: int
    action_size: int
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    layer_norm: bool = False
    goal_features: GoalFeatures | None = None

    @property
    def feature_size(self) -> int:
        """Length of the network input."""
        if self.goal_features is None:
            return self.observation_size + self.goal_size
        return self.goal_features.size(self.observation_size, self.goal_size)


class MLP(nn.Module):
    """Hidden layers with ReLU and a linear output, Glorot weights and zero biases.

    The initialisation is that of the paper's code (`baselines/her/util.py`). The output layer stays
    float32 under autocast: values near -50 would otherwise be rounded to steps of 0.25.
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
        """Returns (..., output_size), float32."""
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
    """Clips, centres and scales inputs with statistics that belong to the checkpoint.

    `training.normalizer.RunningStatistics` writes `mean` and `std` while training.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer('mean', torch.zeros(size))
        self.register_buffer('std', torch.ones(size))

    def forward(self, values: Tensor) -> Tensor:
        """Returns (..., size) values within +-5 standard deviations of the mean."""
        clipped = values.clamp(-INPUT_CLIP, INPUT_CLIP)
        return ((clipped - self.mean) / self.std).clamp(-NORMALIZED_CLIP, NORMALIZED_CLIP)


class Actor(nn.Module):
    """Deterministic policy: multilayer perceptron with tanh output on normalised inputs."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        self.observation_normalizer = Normalizer(shape.observation_size)
        self.goal_normalizer = Normalizer(shape.goal_size)
        self.network = MLP(shape.feature_size, shape.action_size, shape)

    def features(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Normalised network input (..., feature_size)."""
        normalized = self.observation_normalizer(observation), self.goal_normalizer(goal)
        if self.shape.goal_features is None:
            return torch.cat(normalized, dim=-1)
        return self.shape.goal_features.inputs(observation, goal, *normalized)

    def forward(self, features: Tensor) -> Tensor:
        """Actions (..., action_size) in [-1, 1] for `features`."""
        return torch.tanh(self.network(features))

    @torch.inference_mode()
    def predict(
        self,
        observation: Mapping[str, ArrayLike],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Returns the action for one observation or a batch, as Stable-Baselines3's `predict` does.

        Args:
            observation: `observation` (..., observation_size) and `desired_goal` (..., goal_size)
                in the units of the task; other keys are ignored.
            state: Ignored; there is no recurrent state.
            episode_start: Ignored, likewise.
            deterministic: Ignored: the policy has no noise, as Stable-Baselines3's DDPG.

        Returns:
            Actions (..., action_size) in [-1, 1], float32, and None.

        Raises:
            ValueError: If a part is missing or has the wrong length.
        """
        shape = self.shape
        inputs = [
            self._input(observation, 'observation', shape.observation_size),
            self._input(observation, 'desired_goal', shape.goal_size),
        ]
        action = self(self.features(*inputs))
        return action.cpu().numpy(), None

    def _input(self, observation: Mapping[str, ArrayLike], key: str, size: int) -> Tensor:
        if key not in observation:
            raise ValueError(f'observation has no {key!r}; given: {", ".join(observation)}')
        values = np.asarray(observation[key], dtype=np.float32)
        if values.ndim == 0 or values.shape[-1] != size:
            raise ValueError(f'{key} has shape {values.shape}; allowed: (..., {size})')
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.goal_normalizer.mean.device)


def actor_path(name_or_path: str | Path) -> Path:
    """Returns the checkpoint called `name_or_path`: the name of a shipped actor, or a file.

    Raises:
        ValueError: If there is neither; the message lists the shipped actors.
    """
    shipped = shipped_actors()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path = Path(name_or_path)
    if path.is_file():
        return path
    names = ', '.join(shipped) or 'none'
    raise ValueError(
        f'no actor {str(name_or_path)!r}; shipped: {names}; or the path of a checkpoint'
    )


def load_actor(name_or_path: str | Path, task: str | None = None) -> Actor:
    """Loads an actor, ready to `predict` on the CPU.

    Args:
        name_or_path: Task name of a shipped actor (`FetchReach`), or a checkpoint file.
        task: Refuse a checkpoint of any other task.

    Raises:
        ValueError: If there is no such actor or it does not fit; one line says why.
    """
    from policy_node.policies import checkpoint

    actor, _ = checkpoint.load(actor_path(name_or_path), task)
    return actor
