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
        layer_norm: Whether a LayerNorm precedes each activation.
        goal_features: Function for the network inputs; None uses observation and goal unchanged.
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
        """Number of past actions times the action size."""
        return self.past_actions * self.action_size

    @property
    def input_size(self) -> int:
        """Length of observation and past actions together; the goal is not included."""
        return self.observation_size + self.past_size

    @property
    def past_start(self) -> int:
        """Index of the first past action among the network inputs."""
        after = self.goal_size if self.goal_features is None else 0
        return self.feature_size - self.past_size - after

    @property
    def feature_size(self) -> int:
        """Length of the network input."""
        zeros = np.zeros(self.input_size), np.zeros(self.goal_size)
        return len(self.inputs(zeros, zeros))

    def inputs(self, given: Seen, normalized: Seen) -> Array:
        """Return the network inputs (..., feature_size), NumPy or torch.

        Args:
            given: Observation with past actions (..., input_size), and goal (..., goal_size), in
                the units of the task. Only `goal_features` use them.
            normalized: The same two arrays, normalised.
        """
        if self.goal_features is None:
            return concatenate(*normalized)
        (state, goal), (seen, wanted), size = given, normalized, self.observation_size
        inputs = self.goal_features.inputs((state[..., :size], goal), (seen[..., :size], wanted))
        return concatenate(inputs, seen[..., size:]) if self.past_actions else inputs

    def hidden_names(self) -> list[tuple[str, str]]:
        """Return the module names in an `Actor` of each hidden layer and its LayerNorm, in order.

        Without `layer_norm`, ignore the second name of each pair.
        """
        stride = 3 if self.layer_norm else 2
        places = range(0, stride * len(self.hidden_sizes), stride)
        return [(f'network.hidden.{i}', f'network.hidden.{i + 1}') for i in places]

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor in the `state_dict` of an `Actor`, by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        for part, size in (('observation', self.input_size), ('goal', self.goal_size)):
            for statistic in ('mean', 'std'):
                shapes[f'{part}_normalizer.{statistic}'] = (size,)
        size = self.feature_size
        for (name, norm), width in zip(self.hidden_names(), self.hidden_sizes, strict=True):
            shapes[f'{name}.weight'], shapes[f'{name}.bias'] = (width, size), (width,)
            if self.layer_norm:
                shapes[f'{norm}.weight'] = shapes[f'{norm}.bias'] = (width,)
            size = width
        shapes['network.output.weight'] = self.action_size, size
        shapes['network.output.bias'] = (self.action_size,)
        return shapes


class NetworkPolicy:
    """Base class of deterministic policies with a network; subclasses implement `act`."""

    shape: NetworkShape

    def act(self, seen: NDArray[np.float32], goal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (..., action_size) for inputs in the units of the task.

        `seen`, (..., input_size), is the observation with past actions. `goal` is (..., goal_size).
        """
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
                in the units of the task. If only one has batch axes, the other serves the whole
                batch. Other keys are ignored.
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
