"""Imitate a policy of the undisturbed robot on a disturbed one (DAgger, Ross et al. 2011).

The imitating policy acts and observes the disturbed robot. The imitated policy is given the true
state at the tick at which the action takes effect, and its action is the label. So the imitating
policy learns to act ahead of latency; see docs/robust_policies.md.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from msgs_spec.arrays import Array, Array32
from msgs_spec.disturbances import read_disturbances
from policy_node.policies.actor import Actor
from policy_node.policies.policy import past_after
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.evaluation import EpisodeOutcomes, training_seeds
from policy_node.training.learners.actor_critic import network_shape, set_learning_rate
from policy_node.training.learners.ddpg import Critic
from policy_node.training.runs.initial_networks import InitialNetworks
from policy_node.training.runs.run_folder import LATEST_FILE, RunFolder, disk_warning
from policy_node.training.runs.run_log import RunLog, loss_columns
from policy_node.training.runs.trainer import BaseTrainer
from policy_node.training.runs.training_state import RunClock, part_of


class Answers:
    """Ring buffer of training data: inputs of the imitating policy, actions of the imitated one.

    Args:
        capacity: Largest number of rows; new rows replace the oldest.
        sizes: Lengths of the parts of a row. The parts are an input, an action and, if
            `value_weight` > 0, the features of the true state in which the action takes effect.
    """

    def __init__(self, capacity: int, sizes: Sequence[int]) -> None:
        self._parts = [torch.empty(capacity, size) for size in sizes]
        self._capacity, self._count = capacity, 0

    def add(self, *parts: Tensor) -> None:
        """Store n rows, given as one tensor (n, size) for each part in the order of `sizes`."""
        rows = (self._count + torch.arange(len(parts[0]))) % self._capacity
        for stored, values in zip(self._parts, parts, strict=True):
            stored[rows] = values
        self._count += len(rows)

    def __len__(self) -> int:
        return min(self._count, self._capacity)

    def draw(self, count: int) -> list[Tensor]:
        """Draw `count` rows with replacement; return one tensor (count, size) for each part."""
        rows = torch.randint(len(self), (count,))
        return [part[rows] for part in self._parts]


def _scaled(config: TrainConfig, scale: float) -> TrainConfig:
    scaled = read_disturbances(config.disturbances).scaled(scale)
    return replace(config, disturbances=scaled.to_json())


class ImitationTrainer(BaseTrainer):
    """Trainer for `algorithm=imitation`: one run, in one process.

    Args:
        init_from: The networks to imitate, from which the imitating actor starts too.

    Raises:
        ValueError: With several workers, if `init_from` has another rate, or if `value_weight` is
            set and `init_from` has no critic.
    """

    def __init__(self, folder: RunFolder, init_from: InitialNetworks) -> None:
        config, count = folder.config, folder.workers.world_size
        if count > 1:
            raise ValueError(f'{count} workers; algorithm imitation needs 1')
        if init_from.control_hz != config.control_hz:
            raise ValueError(
                f'{init_from.origin["name"]} was trained at {init_from.control_hz:g} Hz, this run '
                f'has {config.control_hz:g} Hz; algorithm imitation needs equal rates'
            )
        super().__init__(folder, init_from)
        self._simulations = [
            self._simulate(_scaled(config, scale), config.num_envs)
            for scale in config.disturbance_scales
        ]
        self.actor = Actor(network_shape(config))
        self.actor.load_state_dict(part_of(init_from.tensors, 'actor'))
        # The past actions, which the imitated policy does not have, have zero weights here.
        self._imitated = copy.deepcopy(self.actor).requires_grad_(False)
        self._critic = self._make_critic(init_from)
        self._optimizer = torch.optim.Adam(self.actor.network.parameters())
        shape, capacity = self.actor.shape, config.replay_transitions
        sizes = [shape.feature_size, shape.action_size]
        if self._critic is not None:
            sizes.append(shape.feature_size)
        self._answers = Answers(min(capacity, config.total_steps), sizes)

    def _make_critic(self, init_from: InitialNetworks) -> Critic | None:
        if not self.config.value_weight:
            return None
        shape = self.actor.shape
        critic = Critic(shape.feature_size + shape.action_size, shape)
        try:
            critic.load_state_dict(part_of(init_from.tensors, 'critic'))
        except RuntimeError:
            name = init_from.origin['name']
            raise ValueError(
                f'value_weight {self.config.value_weight}: {name} has no single critic beside it'
            ) from None
        return critic.requires_grad_(False)

    def train(self, log: RunLog | None = None) -> str:
        """Train until `stop` or a limit such as `total_steps`; return the reason as text.

        Raises:
            OSError: If a file cannot be written; the earlier files stay.
        """
        config, counters, clock = self.config, self.counters, RunClock(self.counters)
        while True:
            before = time.monotonic()
            success = self._collect()
            loss = self._learn()
            clock.update()
            reason = self._reason_to_stop()
            outcomes = self._evaluate(is_last=bool(reason))
            reason = reason or self._reason_to_stop()
            if reason:
                self.folder.save_actor(LATEST_FILE, self.actor, counters.env_steps)
            elif outcomes is not None:
                with disk_warning('no checkpoint, the one before is kept'):
                    self.folder.save_actor(LATEST_FILE, self.actor, counters.env_steps)
            samples = config.updates_per_cycle * config.batch_size
            seconds = max(time.monotonic() - before, 1e-9)
            row = self._row(success, outcomes, samples, seconds)
            row |= {**loss_columns([]), 'actor_loss': loss}
            if log is not None:
                log.write(row)
            if reason:
                return reason

    def _collect(self) -> float:
        """Run the imitating policy for an episode in each simulation; return its success rate.

        An episode whose simulation diverged counts as a failure, as in an evaluation. The inputs
        and labels (imitated actions) of the other episodes are stored.
        """
        count = self.config.num_envs
        cycle = self.counters.episodes // count
        simulation = self._simulations[cycle % len(self._simulations)]
        ticks = simulation.spec.episode_ticks
        seeds = np.random.SeedSequence([self.config.seed, self.counters.env_steps])
        observation = simulation.reset(seed=training_seeds(seeds, count))
        latency = np.array(
            [int(simulation.variation(i).get('action_latency', 0)) for i in range(count)]
        )
        past = np.zeros((count, self.actor.shape.past_size), np.float32)
        nothing, diverged = past.copy(), np.zeros(count, np.bool_)
        inputs, states, answers = [], [], []
        for _ in range(ticks):
            goal = torch.tensor(observation['desired_goal'], dtype=torch.float32)
            true = simulation.observe_from(simulation.true_readings())['observation']
            with torch.no_grad():
                states.append(self._features(true, nothing, goal))
                answers.append(self._imitated(states[-1]))
                inputs.append(self._features(observation['observation'], past, goal))
                action = self.actor(inputs[-1]).numpy()
            past = past_after(past, action)
            result = simulation.step(action)
            observation, diverged = result.observation, diverged | result.diverged
        for delay in np.unique(latency):
            rows = np.flatnonzero((latency == delay) & ~diverged)
            # An action takes effect `delay` ticks later; the last ones never do.
            parts = [inputs[: ticks - delay], answers[delay:]]
            if self._critic is not None:
                parts.append(states[delay:])
            self._answers.add(*(torch.stack(part)[:, rows].flatten(0, 1) for part in parts))
        self.counters.env_steps += count * ticks
        self.counters.episodes += count
        return float((result.success & ~diverged).mean())

    def _features(self, observation: Array, past: Array32, goal: Tensor) -> Tensor:
        seen = np.concatenate([observation, past], axis=-1)
        return self.actor.features(torch.tensor(seen, dtype=torch.float32), goal)

    def _learn(self) -> float | None:
        """Fit the actor to stored labels, the imitated actions; return the mean loss of a cycle.

        Return None without labels, because all simulations have diverged so far.
        """
        config, total = self.config, 0.0
        if not self._answers:
            return None
        set_learning_rate(self._optimizer, config, self._progress())
        for _ in range(config.updates_per_cycle):
            inputs, answers, *states = self._answers.draw(config.batch_size)
            actions = self.actor(inputs)
            loss = (actions - answers).square().mean()
            if self._critic is not None:
                lost = self._critic(*states, answers) - self._critic(*states, actions)
                # An action of higher value than the imitated one exploits errors of the critic.
                loss = loss + config.value_weight * lost.clamp(min=0.0).mean()
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()
            total += loss.item()
        self.counters.updates += config.updates_per_cycle
        return total / max(config.updates_per_cycle, 1)

    def _evaluate(self, is_last: bool) -> EpisodeOutcomes | None:
        counters = self.counters
        if not is_last and counters.env_steps < counters.next_evaluation:
            return None
        counters.next_evaluation = counters.env_steps + self.config.evaluate_every
        outcomes = self._outcomes(self.actor)
        self.folder.keep_best(outcomes, self.actor, counters)
        return outcomes
