"""What one update learns from."""

from __future__ import annotations

from dataclasses import dataclass

from policy_node.training.learning.replay import Array


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch for one update, float32; the target of a value is reward + discount * next value.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size); several steps later where returns are longer.
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`.
        discount: (batch,) of the value of the next state.
        condition: (batch, 1) what values are conditioned on; None is nothing.
        next_condition: (batch, 1) the same in the next state.
    """

    observation: Array
    next_observation: Array
    goal: Array
    action: Array
    reward: Array
    discount: Array
    condition: Array | None = None
    next_condition: Array | None = None
