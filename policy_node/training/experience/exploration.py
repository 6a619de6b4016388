"""In what collected actions differ from the actor's: noise on actions, or on its parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from policy_node.policies.actor import Actor
from policy_node.policies.policy import Policy

Actions = NDArray[np.float32]


class ActionNoise:
    """Gaussian noise and, now and then, a uniformly random action instead.

    Args:
        generator: Source of all randomness.
        shape: (simulations, action size).
        std: Standard deviation of the Gaussian noise.
        epsilon: Probability of a random action.
        ticks: For how many ticks whatever was drawn holds.

    Attributes:
        share: Share of `std` and `epsilon` that is in force.
    """

    def __init__(
        self,
        generator: np.random.Generator,
        shape: tuple[int, int],
        std: float,
        epsilon: float,
        ticks: int = 1,
    ) -> None:
        self._generator = generator
        self._shape = shape
        self._std, self._epsilon = std, epsilon
        self._ticks = ticks
        self.share = 1.0
        self._uniform, self._noise = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._replaced = np.zeros(shape[0], np.bool_)

    def random(self, tick: int) -> Actions:
        """Uniformly random actions (N, action size) for a tick of an episode."""
        if tick % self._ticks == 0:
            self._uniform = self._generator.uniform(-1.0, 1.0, self._shape).astype(np.float32)
        return self._uniform

    def around(self, action: NDArray[Any], tick: int) -> Actions:
        """Actions (N, action size) with noise for a tick of an episode."""
        share = self.share
        if tick % self._ticks == 0:
            self.random(tick)
            self._noise = self._generator.standard_normal(self._shape, dtype=np.float32)
            self._replaced = self._generator.random(self._shape[0]) < share * self._epsilon
        noisy = action + np.float32(self._std * share) * self._noise
        noisy = np.clip(noisy, -1.0, 1.0)
        return np.where(self._replaced[:, None], self._uniform, noisy)


# Perturbed copies that collect side by side, each in its share of the simulations.
_COPIES = 8
# States at which the distance of copies is measured.
_MEASURED = 256
_FIRST_SCALE = 0.05


class ParameterNoise:
    """Noise on the weights of the actor, the same for a whole episode (arXiv 1706.01905).

    Its scale follows from how far it moves actions: after every cycle it is multiplied by what
    would have given the distance wanted, at most by 2 or 1/2. The paper takes steps of 1 %; with a
    few dozen cycles of long episodes that would never arrive.

    Args:
        generator: Source of all randomness.
        distance: Root mean square that actions are to be moved by.

    Attributes:
        share: Share of `distance` that is in force.
        scale: Standard deviation of the noise on weights.
    """

    def __init__(self, generator: np.random.Generator, distance: float) -> None:
        self._generator = generator
        self._distance = distance
        self.share = 1.0
        self.scale = _FIRST_SCALE

    def perturb(self, actor: Policy) -> PerturbedActors:
        """Copies of an actor with other weights each.

        Raises:
            TypeError: If it has no weights that can be moved.
        """
        if not isinstance(actor, Actor):
            raise TypeError(f'parameter noise needs an actor, not a {type(actor).__name__}')
        return PerturbedActors([self._copy(actor) for _ in range(_COPIES)])

    @torch.no_grad()
    def _copy(self, actor: Actor) -> Actor:
        perturbed = copy.deepcopy(actor)
        for parameter in perturbed.network.parameters():
            noise = self._generator.standard_normal(tuple(parameter.shape), dtype=np.float32)
            parameter.add_(torch.from_numpy(noise), alpha=self.scale)
        return perturbed

    def adapt(self, actor: Policy, perturbed: Policy, states: Mapping[str, ArrayLike]) -> None:
        """Changes the scale by how far the copies were from the actor.

        Args:
            actor: The actor.
            perturbed: Its copies.
            states: Observations (states, ...) of the last cycle.
        """
        count = len(np.asarray(states['observation']))
        chosen = self._generator.choice(count, min(count, _MEASURED), replace=False)
        at = {name: np.asarray(values)[chosen] for name, values in states.items()}
        moved = perturbed.predict(at)[0] - actor.predict(at)[0]
        distance = float(np.sqrt(np.square(moved).mean()))
        wanted = self.share * self._distance
        self.scale *= float(np.clip(wanted / max(distance, 1e-6), 0.5, 2.0))


class PerturbedActors:
    """Actors that each answer for their share of the rows."""

    def __init__(self, actors: list[Actor]) -> None:
        self._actors = actors

    def predict(
        self,
        observation: Mapping[str, ArrayLike],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Actions (N, action size) for observations (N, ...), as `Policy.predict`."""
        del state, episode_start, deterministic
        values = {name: np.asarray(rows) for name, rows in observation.items()}
        parts = np.array_split(np.arange(len(values['observation'])), len(self._actors))
        answers = [
            actor.predict({name: rows[part] for name, rows in values.items()})[0]
            for actor, part in zip(self._actors, parts, strict=True)
            if len(part)
        ]
        return np.concatenate(answers), None
