"""Find the class and the model of a task by name."""

from __future__ import annotations

from typing import Any

from fetch_hand_sim.simulation.tasks.fetch import FETCH_CONFIGS, FetchTask
from fetch_hand_sim.simulation.tasks.hand import HandReachTask
from fetch_hand_sim.simulation.tasks.hand_manipulate import MANIPULATE_CONFIGS, HandManipulateTask
from fetch_hand_sim.simulation.tasks.task import BatchConfig, Task
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    PHYSICS_TIMESTEP,
    TaskSpec,
    task_spec,
    third_party_simulation,
)

_FAMILIES: dict[str, type[Task]] = {
    **dict.fromkeys(FETCH_CONFIGS, FetchTask),
    'HandReach': HandReachTask,
    **dict.fromkeys(MANIPULATE_CONFIGS, HandManipulateTask),
}


def make_task(name: str, batch: BatchConfig | None = None) -> Task:
    """Compile the model of a task and create its batch of simulations.

    Raises:
        ValueError: If the task or `control_hz` is not allowed. For third-party tasks also if
            the simulation class is missing or compiles another file than its `ASSET`, or if the
            model has a time step other than `PHYSICS_TIMESTEP` or lacks a joint of the task.
    """
    batch = batch or BatchConfig()
    control_hz = batch.control_hz if batch.timing == 'seconds' else DEFAULT_CONTROL_HZ
    spec = task_spec(name, control_hz=control_hz)
    task: Task = _family(spec)(spec, batch)
    if str(task.asset) != (named := task_asset(name)):
        raise ValueError(
            f'{name} simulates {task.asset}, but its ASSET, which pictures show, is {named}'
        )
    if (timestep := float(task.model.opt.timestep)) != PHYSICS_TIMESTEP:
        raise ValueError(
            f'{name}: {task.asset} has a time step of {timestep:g} s; allowed: '
            f'{PHYSICS_TIMESTEP:g} s (<option timestep="{PHYSICS_TIMESTEP:g}"/>)'
        )
    return task


def _family(spec: TaskSpec) -> Any:
    """Return the class that simulates a task of this package or of a third party."""
    return _FAMILIES.get(spec.name) or third_party_simulation(spec.name)


def task_asset(name: str) -> str:
    """Return the MJCF asset of a task, for example `fetch/reach.xml`, or raise ValueError."""
    config = FETCH_CONFIGS.get(name) or MANIPULATE_CONFIGS.get(name)
    if config is not None:
        return config.asset
    named = getattr(_family(task_spec(name)), 'ASSET', None)
    if named is None:
        raise ValueError(f'the simulation of {name} lacks ASSET, its MJCF file')
    return str(named)
