"""Collects whole episodes from the batched simulation with exploration noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import Policy, past_after
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Held, Hierarchical
from policy_node.training.experience.exploration import ActionNoise, ParameterNoise
from policy_node.training.experience.frame_skip import Holder
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.subgoals import Guide, Proposer, subgoal_columns


class Collector:
    """Steps all simulations through one episode at a time.

    It owns its generator and touches nothing of the learner, so it may run in another thread and
    still gives the same episodes for the same policy.

    Args:
        simulation: The simulations.
        seeds: One seed per simulation for its resets; the first also seeds exploration.
        config: Says how to explore. With `longest_hold` above 1 actions say how long they hold,
            with `subgoal_every` above 0 subgoals follow them.

    Attributes:
        exploration: Share of `noise_std` and `random_epsilon` that is in force.
        proposer: Who proposes subgoals; None lets the goal itself be pursued.
    """

    def __init__(self, simulation: Simulation, seeds: list[int], config: TrainConfig) -> None:
        self.simulation = simulation
        self.exploration = 1.0
        self.proposer: Proposer | None = None
        generator = np.random.default_rng(seeds[0])
        held, guided = config.find(Held), config.find(Hierarchical)
        longest = held.longest_hold if held else 1
        every = guided.subgoal_every if guided else 0
        spec, noise = simulation.spec, config.learner.exploration
        std, epsilon = noise.noise_std, noise.random_epsilon
        size = spec.robot.action_size + (longest > 1)
        self._past_size = config.network.past_actions * spec.robot.action_size
        self._inputs = spec.observation_size + self._past_size
        self._columns = size + subgoal_columns(every, spec.goal.size)
        self._holder = Holder(longest) if longest > 1 else None
        self._parameters = ParameterNoise(generator, std) if noise.parameter_noise else None
        self._noise = ActionNoise(
            generator,
            (simulation.num_envs, size),
            0.0 if noise.parameter_noise else std,
            epsilon,
            noise.noise_ticks(config.collect.control_hz),
        )
        self._guide = Guide(every, generator, std, epsilon) if every else None
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
            observation=np.empty((count, ticks + 1, self._inputs), np.float32),
            achieved_goal=np.empty((count, ticks + 1, spec.goal.size), np.float32),
            desired_goal=observation['desired_goal'].astype(np.float32),
            action=np.empty((count, ticks, self._columns), np.float32),
        )
        whole = np.ones(count, dtype=np.bool_)
        success = np.zeros(count, dtype=np.bool_)
        acting = self._acting(policy)
        past = np.zeros((count, self._past_size), np.float32)
        for tick in range(ticks):
            episodes.observation[:, tick] = np.concatenate([observation['observation'], past], 1)
            episodes.achieved_goal[:, tick] = observation['achieved_goal']
            action = self._explore(acting, observation, past, random, tick)
            if self._holder is not None:
                action = self._holder.take(action, ticks - tick)
            episodes.action[:, tick] = action
            result = simulation.step(action[:, : spec.robot.action_size])
            if self._past_size:
                past = past_after(past, action[:, : spec.robot.action_size])
            observation, success = result.observation, result.success
            whole &= ~result.diverged
        episodes.observation[:, ticks] = np.concatenate([observation['observation'], past], 1)
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
        self,
        policy: Policy,
        observation: Mapping[str, ArrayLike],
        past: NDArray[np.float32],
        random: bool,
        tick: int,
    ) -> NDArray[np.float32]:
        guide = self._guide
        if guide is not None:
            observation = guide.lead(observation, None if random else self.proposer, tick)
        if random:
            own = noisy = self._noise.random(tick)
        else:
            state = past if self._past_size else None
            own = policy.predict(observation, state, deterministic=True)[0]
            noisy = self._noise.around(own, tick)
        return noisy if guide is None else guide.mark(noisy, own)
