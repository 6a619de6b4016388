"""Collect whole episodes from the batched simulation, with exploration noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array32
from policy_node.policies.policy import Policy, past_after
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.replay import Episodes

Observations = Mapping[str, ArrayLike]


class ActionNoise:
    """Adds Gaussian noise to actions, or replaces actions by uniformly random ones.

    Args:
        shape: (simulations, action size).
        std: Standard deviation of the Gaussian noise; actions are in [-1, 1].
        epsilon: Probability that a simulation gets a random action.
        ticks: Number of ticks for which noise and random actions are held.

    Attributes:
        share: Factor on `std` and `epsilon`, from 0 (no exploration) to 1.
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

    def around(self, action: NDArray[Any], tick: int) -> Array32:
        """Return `action` (simulations, action size) with exploration noise, clipped to [-1, 1].

        `tick` counts the steps of the episode from 0. Multiples of `ticks` draw new noise.
        """
        share = self.share
        if tick % self._ticks == 0:
            self._uniform = self._generator.uniform(-1.0, 1.0, self._shape).astype(np.float32)
            self._noise = self._generator.standard_normal(self._shape, dtype=np.float32)
            self._replaced = self._generator.random(self._shape[0]) < share * self._epsilon
        noisy = action + np.float32(self._std * share) * self._noise
        noisy = np.clip(noisy, -1.0, 1.0)
        return np.where(self._replaced[:, None], self._uniform, noisy)


class Collector:
    """Runs one episode at a time in every simulation and records it.

    A collector has its own random generator and shares no state with the learner. So it can run in
    another thread and returns the same episodes for the same policy.

    Args:
        seeds: One seed per simulation for its resets; the first also seeds exploration.
        extra_actions: Number of additional outputs of the policy. They are recorded, with noise,
            but not sent to the simulation.
        extra_columns: Number of values that a subclass computes and records after each action.

    Attributes:
        exploration: Factor on all exploration noise, 0 ... 1.
    """

    def __init__(
        self,
        simulation: Simulation,
        seeds: list[int],
        config: TrainConfig,
        extra_actions: int = 0,
        extra_columns: int = 0,
    ) -> None:
        self.simulation = simulation
        self.exploration = 1.0
        self._generator = np.random.default_rng(seeds[0])
        size = simulation.spec.robot.action_size
        self._action_size = size
        self._past_size = config.past_actions * size
        self._columns = size + extra_actions + extra_columns
        self._noise = ActionNoise(
            self._generator,
            (simulation.num_envs, size + extra_actions),
            0.0 if config.parameter_noise else config.noise_std,
            config.random_epsilon,
            config.noise_ticks,
        )
        self._seeds: list[int] | None = seeds

    def collect(self, policy: Policy) -> tuple[Episodes, float]:
        """Run one episode in every simulation.

        Returns:
            The episodes whose simulation did not diverge, and their success rate at the last step
            (0 if all diverged).
        """
        simulation = self.simulation
        spec = simulation.spec
        ticks, count = spec.episode_ticks, simulation.num_envs
        inputs = spec.observation_size + self._past_size
        observation = simulation.reset(seed=self._seeds)
        self._seeds = None
        episodes = Episodes(
            observation=np.empty((count, ticks + 1, inputs), np.float32),
            achieved_goal=np.empty((count, ticks + 1, spec.goal.size), np.float32),
            desired_goal=observation['desired_goal'].astype(np.float32),
            action=np.empty((count, ticks, self._columns), np.float32),
        )
        whole = np.ones(count, dtype=np.bool_)
        success = np.zeros(count, dtype=np.bool_)
        acting = self._begin(policy)
        past = np.zeros((count, self._past_size), np.float32)
        for tick in range(ticks):
            episodes.observation[:, tick] = np.concatenate([observation['observation'], past], 1)
            episodes.achieved_goal[:, tick] = observation['achieved_goal']
            action = self._explore(acting, observation, past, tick)
            episodes.action[:, tick] = action
            result = simulation.step(action[:, : self._action_size])
            past = past_after(past, action[:, : self._action_size])
            observation, success = result.observation, result.success
            whole &= ~result.diverged
        episodes.observation[:, ticks] = np.concatenate([observation['observation'], past], 1)
        episodes.achieved_goal[:, ticks] = observation['achieved_goal']
        self._end(policy, acting, episodes)
        return episodes.select(whole), float(success[whole].mean()) if whole.any() else 0.0

    def _begin(self, policy: Policy) -> Policy:
        """Scale the noise by `exploration`; return the policy that acts in the next episodes.

        Here it is `policy` itself. Subclasses may return another one, such as a perturbed copy.
        """
        self._noise.share = self.exploration
        return policy

    def _end(self, policy: Policy, acting: Policy, episodes: Episodes) -> None:
        """Do nothing after the episodes; a subclass may adapt its exploration noise here.

        `policy` is the policy without noise; `acting` is the result of `_begin`, which acted.
        `episodes` includes those that diverged.
        """

    def _explore(
        self, policy: Policy, observation: Observations, past: Array32, tick: int
    ) -> Array32:
        """Return the values to record in one tick, (simulations, recorded columns).

        These are the robot's actions with noise, then the extra actions and extra columns. `past`
        contains the robot's past actions, (simulations, `past_actions` * action size).
        """
        return self._noise.around(self._predict(policy, observation, past), tick)

    def _predict(self, policy: Policy, observation: Observations, past: Array32) -> NDArray[Any]:
        state = past if self._past_size else None
        return policy.predict(observation, state, deterministic=True)[0]
