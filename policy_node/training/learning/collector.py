"""Collects whole episodes from the batched simulation with exploration noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import Policy
from policy_node.training.learning.exploration import ActionNoise, ParameterNoise
from policy_node.training.learning.frame_skip import Holder
from policy_node.training.learning.replay import Episodes
from policy_node.training.learning.subgoals import Guide, Proposer, subgoal_columns


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
        noise_ticks: For how many ticks noise and random actions hold.
        parameter_noise: Whether weights are moved, and by them actions by `noise_std`, instead of
            actions themselves.
        longest_hold: Most ticks for which actions may hold; above 1 they say how long.
        subgoal_every: Ticks for which a subgoal holds, which then follows the actions; 0 has none.

    Attributes:
        exploration: Share of `noise_std` and `random_epsilon` that is in force.
        proposer: Who proposes subgoals; None lets the goal itself be pursued.
    """

    def __init__(
        self,
        simulation: Simulation,
        seeds: list[int],
        noise_std: float,
        random_epsilon: float,
        noise_spread: float = 0.0,
        *,
        noise_ticks: int = 1,
        parameter_noise: bool = False,
        longest_hold: int = 1,
        subgoal_every: int = 0,
    ) -> None:
        self.simulation = simulation
        self.exploration = 1.0
        self.proposer: Proposer | None = None
        generator = np.random.default_rng(seeds[0])
        self._holder = Holder(longest_hold) if longest_hold > 1 else None
        self._shape = (simulation.num_envs, simulation.spec.robot.action_size + (longest_hold > 1))
        std = 0.0 if parameter_noise else noise_std
        self._noise = ActionNoise(
            generator, self._shape, std, random_epsilon, noise_spread, noise_ticks
        )
        self._parameters = ParameterNoise(generator, noise_std) if parameter_noise else None
        self._guide: Guide | None = None
        if subgoal_every:
            self._guide = Guide(subgoal_every, generator, noise_std, random_epsilon)
        self._columns = self._shape[1] + subgoal_columns(subgoal_every, simulation.spec.goal.size)
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
            action=np.empty((count, ticks, self._columns), np.float32),
        )
        whole = np.ones(count, dtype=np.bool_)
        success = np.zeros(count, dtype=np.bool_)
        acting = self._acting(policy)
        for tick in range(ticks):
            episodes.observation[:, tick] = observation['observation']
            episodes.achieved_goal[:, tick] = observation['achieved_goal']
            action = self._explore(acting, observation, random, tick)
            if self._holder is not None:
                action = self._holder.take(action, ticks - tick)
            episodes.action[:, tick] = action
            result = simulation.step(action[:, : spec.robot.action_size])
            observation, success = result.observation, result.success
            whole &= ~result.diverged
        episodes.observation[:, ticks] = observation['observation']
        episodes.achieved_goal[:, ticks] = observation['achieved_goal']
        if not random:
            self._adapt(policy, acting, episodes)
        return episodes.select(whole), float(success[whole].mean()) if whole.any() else 0.0

    def _acting(self, policy: Policy) -> Policy:
        """What acts through the episodes: the policy, or copies of it with other weights."""
        self._noise.share = self.exploration
        if self._guide is not None:
            self._guide.share = self.exploration
        if self._parameters is None:
            return policy
        self._parameters.share = self.exploration
        return self._parameters.perturb(policy)

    def _adapt(self, policy: Policy, acting: Policy, episodes: Episodes) -> None:
        if self._parameters is not None:
            ticks = episodes.ticks
            states = {
                'observation': episodes.observation[:, :-1].reshape(len(episodes) * ticks, -1),
                'desired_goal': np.repeat(episodes.desired_goal, ticks, axis=0),
            }
            self._parameters.adapt(policy, acting, states)

    def _explore(
        self, policy: Policy, observation: Mapping[str, ArrayLike], random: bool, tick: int
    ) -> NDArray[np.float32]:
        guide = self._guide
        if guide is not None:
            observation = guide.lead(observation, None if random else self.proposer, tick)
        if random:
            own = noisy = self._noise.random(tick)
        else:
            own = policy.predict(observation, deterministic=True)[0]
            noisy = self._noise.around(own, tick)
        return noisy if guide is None else guide.mark(noisy, own)
