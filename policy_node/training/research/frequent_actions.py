"""Learning at high action frequencies: actions held for several ticks, and noise on weights."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array32
from policy_node.policies.actor import Actor
from policy_node.policies.policy import MemorylessPolicy, Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.collector import Collector, Observations
from policy_node.training.experience.replay import Episodes, Starts
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.ddpg import DDPG, TensorBatch


def ticks_of(length: Array32, most: int) -> NDArray[np.int64]:
    """Convert the actor's output `length`, [-1, 1], to the nearest number of ticks 1 ... `most`."""
    share = (np.asarray(length, np.float64) + 1.0) / 2.0
    return 1 + np.rint(share * (most - 1)).astype(np.int64)


def length_of(ticks: NDArray[np.int64], most: int) -> Array32:
    """Convert the ticks an action holds, 1 ... `most`, to the actor's output; `most` is above 1."""
    return (2.0 * (ticks - 1) / (most - 1) - 1.0).astype(np.float32)


class HoldingCollector(Collector):
    """Collector that holds each action for several ticks; the actor's last output is their number.

    The paper suggests this for very frequent actions (after Sharma et al. 2017, FiGAR). The actor
    decides rarely and learns how rarely. So exploration goes further, and values propagate over
    many ticks at once. Every tick of a held action is stored as an action with the number of ticks
    that are left. No action is held beyond the end of its episode. Arguments as `Collector`.
    """

    def __init__(self, simulation: Simulation, seeds: list[int], config: TrainConfig) -> None:
        super().__init__(simulation, seeds, config, extra_actions=1)
        self._most = config.longest_hold
        self._left = np.zeros(simulation.num_envs, np.int64)
        self._held: Array32 = np.zeros((simulation.num_envs, self._columns), np.float32)

    def _explore(
        self, policy: Policy, observation: Observations, past: Array32, tick: int
    ) -> Array32:
        action = super()._explore(policy, observation, past, tick)
        free = self._left == 0
        wanted = np.minimum(
            ticks_of(action[:, -1], self._most), self.simulation.spec.episode_ticks - tick
        )
        self._left = np.where(free, wanted, self._left)
        held = np.where(free[:, None], action, self._held)
        held[:, -1] = length_of(self._left, self._most)
        self._left, self._held = self._left - 1, held
        return held


class HoldingSampler(TransitionSampler):
    """Samples n-step transitions, where n is the number of ticks that the action still holds.

    `most_steps` is the largest n.
    """

    def steps(
        self, starts: Starts, goal: Array32, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return for how many ticks each action still holds, (batch,), not beyond `starts.last`."""
        del goal, generator
        length = starts.episodes.action[starts.row, starts.tick, -1]
        left: NDArray[np.int64] = starts.last - starts.tick
        return np.asarray(np.minimum(ticks_of(length, self.most_steps), left))


class HoldingDDPG(DDPG):
    """`DDPG` whose actor also returns how long an action holds; evaluation ignores this output."""

    def _penalty(self, batch: TensorBatch, action: Tensor) -> Tensor:
        # The length of an action costs nothing.
        return super()._penalty(batch, action[..., :-1])

    def evaluation_actor(self) -> Actor:
        """Return the actor to evaluate, without the output for how long an action holds."""
        actor = super().evaluation_actor()
        plain = Actor(replace(actor.shape, action_size=actor.shape.action_size - 1))
        state = actor.state_dict()
        for name in ('network.output.weight', 'network.output.bias'):
            state[name] = state[name][:-1].clone()
        plain.load_state_dict(state)
        return plain.eval()


# Perturbed copies that collect side by side, each in its share of the simulations.
_COPIES = 8
# States at which the distance of copies is measured.
_MEASURED = 256
_FIRST_SCALE = 0.05


class PerturbedActors(MemorylessPolicy):
    """Several actors with perturbed weights; each acts for an equal share of the simulations."""

    def __init__(self, actors: list[Actor]) -> None:
        self._actors = actors

    def act(self, observation: Observations) -> Array32:
        """Return actions (N, action size); the first rows of observations go to the first actor."""
        values = {name: np.asarray(rows) for name, rows in observation.items()}
        parts = np.array_split(np.arange(len(values['observation'])), len(self._actors))
        answers = [
            actor.predict({name: rows[part] for name, rows in values.items()})[0]
            for actor, part in zip(self._actors, parts, strict=True)
            if len(part)
        ]
        return np.concatenate(answers)


class PerturbingCollector(Collector):
    """Collector with noise on the actor's weights, constant within an episode (arXiv 1706.01905).

    The noise is scaled until it changes actions by `noise_std` (root mean square). After every
    cycle, its scale is multiplied by wanted / measured change, limited to 1/2 ... 2. The cited
    paper changes the scale by 1 % at a time, too slowly for a few dozen cycles of long episodes.
    Arguments as `Collector`.
    """

    def __init__(self, simulation: Simulation, seeds: list[int], config: TrainConfig) -> None:
        super().__init__(simulation, seeds, config)
        self._distance, self._scale = config.noise_std, _FIRST_SCALE

    def _begin(self, policy: Policy) -> Policy:
        actor = super()._begin(policy)
        assert isinstance(actor, Actor)
        return PerturbedActors([self._copy(actor) for _ in range(_COPIES)])

    @torch.no_grad()
    def _copy(self, actor: Actor) -> Actor:
        perturbed = copy.deepcopy(actor)
        for parameter in perturbed.network.parameters():
            noise = self._generator.standard_normal(tuple(parameter.shape), dtype=np.float32)
            parameter.add_(torch.from_numpy(noise), alpha=self._scale)
        return perturbed

    def _end(self, policy: Policy, acting: Policy, episodes: Episodes) -> None:
        count, ticks = len(episodes) * episodes.ticks, episodes.ticks
        chosen = self._generator.choice(count, min(count, _MEASURED), replace=False)
        states = {
            'observation': episodes.observation[:, :-1].reshape(count, -1)[chosen],
            'desired_goal': episodes.desired_goal[chosen // ticks],
        }
        moved = acting.predict(states)[0] - policy.predict(states)[0]
        distance = float(np.sqrt(np.square(moved).mean()))
        wanted = self.exploration * self._distance
        self._scale *= float(np.clip(wanted / max(distance, 1e-6), 0.5, 2.0))
