"""The interface of policies, `LoadedPolicy` with checked actions, and two untrained policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.tasks import TASKS
from msgs_spec.text import one_line

Observation = Mapping[str, ArrayLike]


class Policy(Protocol):
    """Interface of policies: a method `predict` as in Stable-Baselines3."""

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return actions for one observation or a batch.

        Args:
            observation: `observation` (..., observation size), `achieved_goal` and `desired_goal`
                (..., goal size) in the units of the task.
            state: State that the last call returned; None at the start of an episode.
            episode_start: Booleans (...,), True where an episode starts.
            deterministic: Whether to act without exploration noise.

        Returns:
            Actions (..., action size) in [-1, 1], and the state for the next call; None for a
            policy without memory.
        """
        ...


class PolicyError(ValueError):
    """Raised if a policy fails or returns an invalid action; the message is one line."""


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """A policy for one task, whose actions are checked.

    Attributes:
        policy: The policy itself, unchecked.
        description: Format and file name, for logs and errors.
        control_hz: Action frequency of its training, Hz; None if any frequency is allowed.
        sha256: SHA-256 of its file, or of its concatenated files; empty without a file.
        is_bounded: Whether actions outside [-1, 1] raise PolicyError; if not, they are returned.
    """

    policy: Policy
    task: str
    description: str
    control_hz: float | None = None
    sha256: str = ''
    is_bounded: bool = False

    def require_rate(self, control_hz: float) -> None:
        """Raise ValueError if the policy was trained at another frequency than `control_hz`, Hz."""
        if self.control_hz not in (None, control_hz):
            raise ValueError(
                f'{self.description} was trained at {self.control_hz:g} Hz; the robot runs at '
                f'{control_hz:g} Hz'
            )

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return actions and state as `Policy.predict` does.

        A policy without memory may take only `observation` and `deterministic`, and may return
        only the action.

        Raises:
            PolicyError: If the policy fails, or returns anything but finite numbers of the right
                shape; if `is_bounded`, also outside [-1, 1].
        """
        shape: tuple[int, ...] = ()
        try:
            shape = _action_shape(observation, TASKS[self.task].robot.action_size)
            if state is None and episode_start is None:
                answer: Any = self.policy.predict(observation, deterministic=deterministic)
            else:
                answer = self.policy.predict(observation, state, episode_start, deterministic)
            if not (isinstance(answer, tuple) and len(answer) == 2):
                answer = answer, None
            action = np.asarray(answer[0])
            is_finite = action.dtype.kind in 'iuf' and bool(np.isfinite(action).all())
        except Exception as error:
            # Libraries raise their own types, for single observations or for all.
            problem = f'{type(error).__name__}: {one_line(error)}'
            batch = f' for a batch of {shape[0]} observations' if len(shape) > 1 else ''
            raise PolicyError(f'{self.description} fails{batch}: {problem}') from None
        if action.shape != shape or not is_finite:
            raise PolicyError(
                f'{self.description} returned {one_line(action, 100)} of shape {action.shape}; '
                f'allowed: finite numbers, shape {shape}'
                f'{", one row per observation" if len(shape) > 1 else ""}'
            )
        if self.is_bounded and (np.abs(action) > 1.0).any():
            raise PolicyError(
                f'{self.description} returned {np.abs(action).max():g}; allowed: -1 ... 1'
            )
        return action, answer[1]


class MemorylessPolicy:
    """A policy whose actions depend only on the observation."""

    def act(self, observation: Observation) -> NDArray[Any]:
        """Return actions (..., action size) in [-1, 1] for one observation or a batch."""
        raise NotImplementedError

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], None]:
        """Return the actions of `act`, and None as state."""
        del state, episode_start, deterministic
        return self.act(observation), None


# Keeps the random numbers of actions apart from those of resets with the same seed.
_ACTION_STREAM = 1


class RandomPolicy(MemorylessPolicy):
    """Policy of uniformly random actions, drawn with `seed` unless `start` gives other seeds."""

    def __init__(self, action_size: int, seed: int = 0) -> None:
        self._action_size = action_size
        self._generator = np.random.default_rng(seed)
        self._row_generators: list[np.random.Generator] = []

    def start(self, seeds: Sequence[int]) -> None:
        """Seed one random generator per row of the batch; equal seeds give equal actions."""
        self._row_generators = [np.random.default_rng((seed, _ACTION_STREAM)) for seed in seeds]

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """Return random actions (..., action size) in [-1, 1]."""
        shape = _action_shape(observation, self._action_size)
        if shape == (len(self._row_generators), self._action_size):
            rows = [generator.uniform(-1.0, 1.0, shape[1:]) for generator in self._row_generators]
            return np.array(rows, np.float32)
        return self._generator.uniform(-1.0, 1.0, shape).astype(np.float32)


class RestingPolicy(MemorylessPolicy):
    """Policy of the zero action: the gripper stays, and the hand moves to its middle position."""

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """Return zeros (..., action size)."""
        return np.zeros(_action_shape(observation, self._action_size), np.float32)


def _action_shape(observation: Observation, action_size: int) -> tuple[int, ...]:
    _require_mapping(observation)
    return (*np.shape(observation['observation'])[:-1], action_size)


def _require_mapping(observation: object) -> None:
    if not isinstance(observation, Mapping):
        given = type(observation).__name__
        raise TypeError(f"observation of type {given}; allowed: a mapping with 'observation'")


def _part(observation: Observation, key: str, size: int) -> NDArray[np.float32]:
    if key not in observation:
        raise ValueError(f'observation has no {key!r}; given: {", ".join(observation)}')
    values = np.asarray(observation[key], dtype=np.float32)
    if values.ndim == 0 or values.shape[-1] != size:
        raise ValueError(f'{key} has shape {values.shape}; allowed: (..., {size})')
    return values


def observation_and_goal(
    observation: Observation, observation_size: int, goal_size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return observation and desired goal, (..., size) each, with the same leading axes.

    One goal for a batch of observations, or one observation for several goals, is repeated.

    Raises:
        ValueError: If a part is missing or has a wrong shape.
        TypeError: If the observation is not a mapping.
    """
    _require_mapping(observation)
    seen = _part(observation, 'observation', observation_size)
    goal = _part(observation, 'desired_goal', goal_size)
    if seen.shape[:-1] == goal.shape[:-1]:
        return seen, goal
    try:
        leading = np.broadcast_shapes(seen.shape[:-1], goal.shape[:-1])
    except ValueError:
        raise ValueError(
            f'observation has shape {seen.shape}, desired_goal {goal.shape}; allowed: batches of '
            'equal size, or one of the two for a whole batch'
        ) from None
    return (
        np.broadcast_to(seen, (*leading, observation_size)),
        np.broadcast_to(goal, (*leading, goal_size)),
    )


# Past actions, the memory of policies for robots with a delay.


def past_before(
    state: Any, episode_start: Any, leading: tuple[int, ...], size: int
) -> NDArray[np.float32]:
    """Return the past actions (`*leading`, size) as input of a prediction, newest first.

    Args:
        state: State that the last prediction returned; None at the start of all episodes.
        episode_start: Booleans (`*leading`,), True where an episode starts; its past is zeros.
        leading: Leading axes of the observation.
        size: Number of past actions times the action size.

    Raises:
        ValueError: If `state` has another shape, as from another batch or policy.
    """
    past = np.zeros((*leading, size), np.float32)
    if state is None:
        return past
    given = np.asarray(state, dtype=np.float32)
    if given.shape != past.shape:
        raise ValueError(f'state has shape {given.shape}; allowed: {past.shape}')
    if episode_start is None:
        return given
    return np.where(np.asarray(episode_start, dtype=np.bool_)[..., None], past, given)


def past_after(past: NDArray[np.float32], action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return `past` with `action` (..., action size) inserted first and the oldest one dropped."""
    return np.concatenate([action, past], axis=-1)[..., : past.shape[-1]].astype(np.float32)
