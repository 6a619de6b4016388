"""The interface of policies, and two policies without training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Observation = Mapping[str, ArrayLike]


class Policy(Protocol):
    """A policy with the `predict` of Stable-Baselines3."""

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Acts on one observation or on a batch.

        Args:
            observation: `observation` (..., observation size), `achieved_goal` and `desired_goal`
                (..., goal size) in the units of the task.
            state: The state that the last call returned; None at the start of an episode.
            episode_start: Booleans (...,), True where an episode starts.
            deterministic: Without exploration noise.

        Returns:
            Actions (..., action size) in [-1, 1], and the state for the next call; None for a
            policy without memory.
        """
        ...


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """A policy for one task and what is known about it.

    Attributes:
        policy: What acts.
        task: Name of the task.
        description: Who it is, for people.
        control_hz: Action frequency it was trained at, Hz; None where any will do.
        sha256: Fingerprint of its file; empty if it has none.
    """

    policy: Policy
    task: str
    description: str
    control_hz: float | None = None
    sha256: str = ''

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Act as `policy` does; a policy without memory may take only the observation."""
        if state is None and episode_start is None:
            answer: Any = self.policy.predict(observation, deterministic=deterministic)
        else:
            answer = self.policy.predict(observation, state, episode_start, deterministic)
        # A policy of the user's own may return the action alone.
        return answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)


# Apart from other streams of random numbers that a seed stands for.
_OF_ACTIONS = 1


class RandomPolicy:
    """Uniformly random actions, alike for equal seeds."""

    def __init__(self, action_size: int, seed: int = 0) -> None:
        self._action_size = action_size
        self._generator = np.random.default_rng(seed)
        self._of_rows: list[np.random.Generator] = []

    def start(self, seeds: Sequence[int]) -> None:
        """Begins an episode in each row of a batch; equal seeds have equal actions from then on."""
        # Not the numbers that resets draw from the same seeds.
        self._of_rows = [np.random.default_rng((seed, _OF_ACTIONS)) for seed in seeds]

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Returns actions (..., action size) in [-1, 1] for any observation."""
        del state, episode_start, deterministic
        shape = _action_shape(observation, self._action_size)
        if shape == (len(self._of_rows), self._action_size):
            rows = [generator.uniform(-1.0, 1.0, shape[1:]) for generator in self._of_rows]
            return np.array(rows, np.float32), None
        return self._generator.uniform(-1.0, 1.0, shape).astype(np.float32), None


class RestingPolicy:
    """The zero action: the gripper stays, the hand takes the middle of its ranges."""

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return zeros (..., action size) for any observation."""
        del state, episode_start, deterministic
        return np.zeros(_action_shape(observation, self._action_size), np.float32), None


def _action_shape(observation: Observation, action_size: int) -> tuple[int, ...]:
    _require_mapping(observation, 'observation')
    return (*np.shape(observation['observation'])[:-1], action_size)


def _require_mapping(observation: object, key: str) -> None:
    if not isinstance(observation, Mapping):
        given = type(observation).__name__
        raise TypeError(f'an observation is a mapping with {key!r}, not of type {given}')


def observation_part(observation: Observation, key: str, size: int) -> NDArray[np.float32]:
    """Returns one part of an observation (..., size), as actors take it.

    Raises:
        ValueError: If it is missing or has the wrong length.
        TypeError: If the observation is no mapping, as one that was flattened.
    """
    _require_mapping(observation, key)
    if key not in observation:
        raise ValueError(f'observation has no {key!r}; given: {", ".join(observation)}')
    values = np.asarray(observation[key], dtype=np.float32)
    if values.ndim == 0 or values.shape[-1] != size:
        raise ValueError(f'{key} has shape {values.shape}; allowed: (..., {size})')
    return values


def observation_and_goal(
    observation: Observation, observation_size: int, goal_size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns observation and desired goal, (..., size) each, of as many rows.

    One goal for a batch of observations, or one observation for several goals, is repeated.

    Raises:
        ValueError: If a part is missing or has the wrong length, or the batches do not fit.
        TypeError: If the observation is no mapping, as one that was flattened.
    """
    seen = observation_part(observation, 'observation', observation_size)
    goal = observation_part(observation, 'desired_goal', goal_size)
    if seen.shape[:-1] == goal.shape[:-1]:
        return seen, goal
    try:
        leading = np.broadcast_shapes(seen.shape[:-1], goal.shape[:-1])
    except ValueError:
        raise ValueError(
            f'observation has shape {seen.shape}, desired_goal {goal.shape}: allowed are batches '
            'of one size, or a batch and one of the other'
        ) from None
    return (
        np.broadcast_to(seen, (*leading, observation_size)),
        np.broadcast_to(goal, (*leading, goal_size)),
    )
