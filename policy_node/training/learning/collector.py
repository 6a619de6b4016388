"""Collects whole episodes from the batched simulation with exploration noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import Policy
from policy_node.training.learning.replay import Episodes


class Collector:
    """Steps all simulations through one episode at a time.

    It owns its generator and touches nothing of the learner, so it may run in another thread and
    still gives the same episodes for the same policy.

    Args:
        simulation: The simulations.
        seeds: One seed per simulation for its resets; the first also seeds exploration.
        noise_std: Standard deviation of the Gaussian noise on actions.
        random_epsilon: Probability of a uniformly random action instead.
        noise_spread: The first simulation has 1 - spread times both, the last 1 + spread.

    Attributes:
        exploration: Share of `noise_std` and `random_epsilon` that is in force.
    """

    def __init__(
        self,
        simulation: Simulation,
        seeds: list[int],
        noise_std: float,
        random_epsilon: float,
        noise_spread: float = 0.0,
    ) -> None:
        self.simulation = simulation
        self.noise_std = noise_std
        self.random_epsilon = random_epsilon
        self.exploration = 1.0
        self._shares = 1.0 + noise_spread * np.linspace(-1.0, 1.0, simulation.num_envs)
        self._generator = np.random.default_rng(seeds[0])
        self._seeds: list[int] | None = seeds

    def collect(self, policy: Policy, random: bool = False) -> tuple[Episodes, float]:
        """Runs one episode in every simulation.

        Args:
            policy: The policy to explore around.
            random: Act uniformly at random instead.

        Returns:
            The episodes (those in which MuJoCo diverged left out) and the share of them that ended
            in success, with the noise.
        """
        simulation = self.simulation
        spec = simulation.spec
        ticks, count = spec.episode_ticks, simulation.num_envs
        observation = simulation.reset(seed=self._seeds)
        self._seeds = None
        episodes = Episodes(
            observation=np.empty((count, ticks + 1, spec.observation_size), np.float32),
            achieved_goal=np.empty((count, ticks + 1, spec.goal.size), np.float32),
            desired_goal=observation['desired_goal'].astype(np.float32),
            action=np.empty((count, ticks, spec.robot.action_size), np.float32),
        )
        whole = np.ones(count, dtype=np.bool_)
        success = np.zeros(count, dtype=np.bool_)
        for tick in range(ticks):
            episodes.observation[:, tick] = observation['observation']
            episodes.achieved_goal[:, tick] = observation['achieved_goal']
            episodes.action[:, tick] = self._explore(policy, observation, random)
            result = simulation.step(episodes.action[:, tick])
            observation, success = result.observation, result.success
            whole &= ~result.diverged
        episodes.observation[:, ticks] = observation['observation']
        episodes.achieved_goal[:, ticks] = observation['achieved_goal']
        return episodes.select(whole), float(success[whole].mean()) if whole.any() else 0.0

    def _explore(
        self, policy: Policy, observation: Mapping[str, ArrayLike], random: bool
    ) -> NDArray[np.float32]:
        shape = (self.simulation.num_envs, self.simulation.spec.robot.action_size)
        uniform = self._generator.uniform(-1.0, 1.0, shape).astype(np.float32)
        if random:
            return uniform
        action, _ = policy.predict(observation, deterministic=True)
        share = self.exploration * self._shares
        noise = self._generator.standard_normal(shape, dtype=np.float32)
        noisy = action + (self.noise_std * share[:, None]).astype(np.float32) * noise
        noisy = np.clip(noisy, -1.0, 1.0)
        replaced = self._generator.random(shape[0]) < share * self.random_epsilon
        return np.where(replaced[:, None], uniform, noisy)
