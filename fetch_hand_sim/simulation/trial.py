"""Tries a task of another package out: what a specification cannot say and no error tells.

Episodes that depend on what was before, resets that reach into other simulations, and a model that
is not the one that is drawn go on for days before somebody sees them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import mujoco
import numpy as np

from fetch_hand_sim.simulation.first_reset import SpecificationError
from fetch_hand_sim.simulation.models import load_model
from fetch_hand_sim.simulation.tasks import Task
from msgs_spec.arrays import Array
from msgs_spec.tasks import TaskSpec
from msgs_spec.text import one_line

# Long enough for everything to move.
_TICKS = 3
_ACTION = 0.5
# A reset computes in another order than the last one did, at most.
_ROUNDING = 1e-9
# Tasks that this process has tried out, by name and what simulates them.
TRIED: set[tuple[str, type[Task]]] = set()


class TwoSimulations(Protocol):
    """What is asked of a `Simulation` with two copies."""

    spec: TaskSpec

    @property
    def task(self) -> Task:
        """The physics."""

    def reset(self, seed: Any, ids: Any = None) -> Any:
        """Starts copies again."""

    def step(self, actions: Array) -> Any:
        """Advances both by a tick."""


def try_out(simulation: TwoSimulations) -> Iterator[str]:
    """Resets, steps and resets one of two simulations again, from the same seed.

    Args:
        simulation: Two simulations of the task, which nobody else uses.

    Yields:
        A line for everything that is wrong.

    Raises:
        SpecificationError: If it cannot be stepped.
    """
    yield from _drawn_otherwise(simulation.task)
    simulation.reset(seed=[0, 1])
    first = _sensed(simulation)
    _move(simulation)
    before = _sensed(simulation)
    simulation.reset(seed=0, ids=[0])
    again = _sensed(simulation)
    if not np.allclose(again[0], first[0], _ROUNDING, _ROUNDING):
        yield (
            'after reset with the same seed sensors say something else than the first time; reset '
            'sets the whole state and calls self.batch.forward(ids)'
        )
    if not np.array_equal(again[1], before[1]):
        yield 'reset changes simulations that are not among its ids'


def _move(simulation: TwoSimulations) -> None:
    actions = np.full((2, simulation.spec.robot.action_size), _ACTION)
    try:
        for _ in range(_TICKS):
            simulation.step(actions)
    except Exception as error:
        why = f'{type(error).__name__}: {one_line(error)}'
        line = f'{simulation.spec.name}: {_TICKS} ticks cannot be made: {why}'
        raise SpecificationError(line) from error


def _sensed(simulation: TwoSimulations) -> Array:
    """What all sensors say, (2, size)."""
    return np.concatenate(list(simulation.task.readings().values()), axis=1)


def _drawn_otherwise(task: Task) -> Iterator[str]:
    """Compares the shapes that are simulated with those of the file, which are drawn."""
    simulated, drawn = (_shapes(model) for model in (task.model, load_model(task.asset)))
    if simulated.shape != drawn.shape or not np.allclose(simulated, drawn):
        yield (
            f'what is simulated is not what {task.asset} says ({len(simulated)} and {len(drawn)} '
            'geoms, or others), and pictures, films and /tf show the file; put changes there'
        )


def _shapes(model: mujoco.MjModel) -> Array:
    """Where geoms are on their bodies, and how large, (geoms, 8)."""
    columns = model.geom_bodyid[:, None], model.geom_type[:, None], model.geom_pos, model.geom_size
    return np.concatenate(columns, axis=1)
