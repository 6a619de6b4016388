"""The simulations that a configuration trains and is evaluated in."""

from __future__ import annotations

from typing import Any

from fetch_hand_sim.simulation import Simulation
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Dense
from policy_node.training.experience.gamble import GambleSimulation


def make_simulation(config: TrainConfig, num_envs: int, num_threads: int) -> Simulation:
    """Returns `num_envs` copies of the task as the configuration has it."""
    options: dict[str, Any] = {
        'num_envs': num_envs,
        'num_threads': num_threads,
        'reward_type': 'dense' if config.find(Dense) else 'sparse',
        'success_rule': config.collect.success_rule,
        'control_hz': config.collect.control_hz,
        'disturbances': config.collect.disturbances,
    }
    return (GambleSimulation if config.collect.gamble else Simulation)(config.task, **options)
