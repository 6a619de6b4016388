"""Untrained actors, and observations for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from msgs_spec.tasks import TaskSpec, task_spec
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.checkpoint import ActorInfo


def observations(spec: TaskSpec, *leading: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Observations in which quaternions are what they should be."""
    generator = np.random.default_rng(seed)
    parts = {'observation': spec.observation_size, 'desired_goal': spec.goal.size}
    values = {name: generator.normal(size=(*leading, size)) for name, size in parts.items()}
    if spec.goal.size == 7:
        start = spec.achieved_goal_start + 3
        for quaternion in (
            values['observation'][..., start : start + 4],
            values['desired_goal'][..., 3:],
        ):
            quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return {**values, 'achieved_goal': values['desired_goal']}


def fresh_actor(path: Path, task: str, **changes: object) -> Actor:
    """Write an untrained actor with non-trivial normalisers."""
    torch.manual_seed(1)
    spec = task_spec(task)
    fields = {
        'task': task,
        'observation_layout': checkpoint.observation_layout(spec),
        'goal_size': spec.goal.size,
        'action_size': spec.robot.action_size,
        'hidden_sizes': (32, 16),
        'layer_norm': False,
        'control_hz': 25.0,
        'seed': 0,
    }
    info = ActorInfo(**(fields | changes))
    actor = Actor(info.shape).eval()
    for normalizer in (actor.observation_normalizer, actor.goal_normalizer):
        normalizer.mean.uniform_(-1, 1)
        normalizer.std.uniform_(0.5, 2)
    checkpoint.save(path, actor, info)
    return actor
