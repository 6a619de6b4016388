"""Simulate batches of the tasks of `msgs_spec.tasks`."""

from __future__ import annotations

from fetch_hand_sim.simulation.tasks.registry import make_task, task_asset
from fetch_hand_sim.simulation.tasks.task import Task

__all__ = ['Task', 'make_task', 'task_asset']
