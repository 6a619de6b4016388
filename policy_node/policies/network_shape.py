"""The shape of an actor's network, and the `predict` that all implementations share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policy_node.policies.goal_features import Array, GoalFeatures, Seen, concatenate
from policy_node.policies.policy import (
    Observation,
    observation_and_goal,
    past_after,
    past_before,
)

# Plappert et al. 2018, appendix B.
INPUT_CLIP = 200.0
NORMALIZED_CLIP = 5.0


@dataclass(frozen=True, slots=True)
class NetworkShape:
    """Sizes of an actor, and of the critic trained with it.

    Attributes:
        observation_size: Length of `observation`.
        goal_size: Length of `desired_goal`.
        layer_norm: Whether a LayerNorm precedes each activation.
        goal_features: Inputs made from observation and goal; None for the plain ones.
        past_actions: Number of past actions among the inputs, after the observation.
    """

    observation_size: int
    goal_size: int
    action_size: int
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    layer_norm: bool = False
    goal_features: GoalFeatures | None = None
    past_actions: int = 0

    @property
    def past_size(self) -> int:
        """Total length of the past actions."""
        return self.past_actions * self.action_size

    @property
    def input_size(self) -> int:
        """Length of the observation and the past actions."""
        return self.observation_size + self.past_size

    @property
    def past_start(self) -> int:
        """Index of the first past action among the network inputs."""
        return (
            self.observation_size
            if self.goal_features is None
            else self.feature_size - self.past_size
        )

    @property
    def feature_size(self) -> int:
        """Length of the network input."""
        if self.goal_features is None:
            return self.input_size + self.goal_size
        size = self.goal_features.size(self.observation_size, self.goal_size)
        return size + self.past_size

    def inputs(self, given: Seen, normalized: Seen) -> Array:
        """Return the network inputs (..., feature_size), NumPy or torch.

        Args:
            given: Observation with past actions (..., input_size), and goal (..., goal_size).
            normalized: The same, normalised.
        """
        if self.goal_features is None:
            return concatenate(*normalized)
        (state, goal), (seen, wanted), size = given, normalized, self.observation_size
        inputs = self.goal_features.inputs((state[..., :size], goal), (seen[..., :size], wanted))
        return concatenate(inputs, seen[..., size:]) if self.past_actions else inputs

    @property
    def layer_names(self) -> list[str]:
        """Names of the hidden layers in `Actor`; the LayerNorm of layer i is `norm_names[i]`."""
        stride = 3 if self.layer_norm else 2
        return [f'network.hidden.{stride * i}' for i in range(len(self.hidden_sizes))]

    @property
    def norm_names(self) -> list[str]:
        """Names of the LayerNorms in `Actor`; empty without `layer_norm`."""
        count = len(self.hidden_sizes) if self.layer_norm else 0
        return [f'network.hidden.{3 * i + 1}' for i in range(count)]

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor in the state of an `Actor`, by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        for part, size in (('observation', self.input_size), ('goal', self.goal_size)):
            for statistic in ('mean', 'std'):
                shapes[f'{part}_normalizer.{statistic}'] = (size,)
        inputs = (self.feature_size, *self.hidden_sizes)
        outputs = (*self.hidden_sizes, self.action_size)
        names = (*self.layer_names, 'network.output')
        for name, size, width in zip(names, inputs, outputs, strict=True):
            shapes[f'{name}.weight'], shapes[f'{name}.bias'] = (width, size), (width,)
        for name, width in zip(self.norm_names, self.hidden_sizes, strict=False):
            shapes[f'{name}.weight'] = shapes[f'{name}.bias'] = (width,)
        return shapes


class NetworkPolicy:
    """A deterministic policy of a network; subclasses compute the action."""

    shape: NetworkShape

    def act(self, seen: NDArray[np.float32], goal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (..., action_size) for inputs (..., input_size) and goals."""
        raise NotImplementedError

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the action for one observation or a batch, as Stable-Baselines3's `predict` does.

        Args:
            observation: `observation` (..., observation_size) and `desired_goal` (..., goal_size)
                in the units of the task. One of the two may serve a whole batch. Other keys are
                ignored.
            state: State that the last call returned; None at the start of an episode. Only an
                actor with past actions uses it.
            episode_start: Booleans (...,), True where an episode starts.
            deterministic: Ignored, because the policy has no noise.

        Returns:
            Actions (..., action_size) in [-1, 1], float32, and the state for the next call; None
            for an actor without past actions.

        Raises:
            ValueError: If a part is missing or has a wrong shape.
        """
        shape = self.shape
        seen, goal = observation_and_goal(observation, shape.observation_size, shape.goal_size)
        if not shape.past_actions:
            return self.act(seen, goal), None
        past = past_before(state, episode_start, seen.shape[:-1], shape.past_size)
        action = self.act(np.concatenate([seen, past], axis=-1), goal)
        return action, past_after(past, action)
