"""MuJoCo's model and data of a simulation, shared with the user."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array


class SharedPhysics:
    """Live `env.unwrapped.model` and `env.unwrapped.data`, to read and to write.

    Changes of model and data take effect in the next call. Nothing is copied before the first
    access.
    """

    # Values of the model when it was first shared, where its physics vary.
    _unchanged: dict[str, NDArray[Any]] | None = None

    def __init__(self, simulation: Simulation) -> None:
        """Shares the first copy of a simulation that keeps its data."""
        self._simulation = simulation
        self._data: mujoco.MjData | None = None
        self._shares_model = False

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, always the same object."""
        if not self._shares_model and self._simulation.varies_physics:
            self._unchanged = _values(self._simulation.model)
        self._shares_model = True
        return self._simulation.model

    @property
    def data(self) -> mujoco.MjData:
        """The state and what MuJoCo derived from it in its last pass, always the same object."""
        if self._data is None:
            self._data = mujoco.MjData(self._simulation.model)
            self.receive()
        return self._data

    @property
    def is_shared(self) -> bool:
        """True if the model or the data was read before."""
        return self._shares_model or self.shares_data

    @property
    def shares_data(self) -> bool:
        """True if the data was read before."""
        return self._data is not None

    def move_sites(self, sites: list[int], positions: Array) -> None:
        """Move sites (n,) of the model to (n, 3) in m that only pictures show."""
        site_pos = self._simulation.model.site_pos
        site_pos[sites] = positions
        if self._unchanged is not None:
            self._unchanged['MjModel.site_pos'] = site_pos.copy()

    def send(self) -> None:
        """Takes over what was written; to be called before anything is computed."""
        if self._shares_model:
            self._send_model()
        if self._data is not None:
            self._simulation.write_data(0, self._data)

    def _send_model(self) -> None:
        if self._unchanged is not None and self._simulation.varies_physics:
            model = self._simulation.model
            if all(np.array_equal(now, self._unchanged[n]) for n, now in _values(model).items()):
                return
        self._simulation.apply_model_changes()

    def receive(self) -> None:
        """Shows what was computed."""
        if self._data is not None:
            self._simulation.read_data(0, self._data)

    def __getstate__(self) -> dict[str, Any]:
        """The data is read from the simulation again."""
        return self.__dict__ | {'_data': None}


def _values(model: mujoco.MjModel) -> dict[str, NDArray[Any]]:
    """Return copies of the arrays of a model and of its options."""
    found = {}
    for owner in (model, model.opt):
        for name in dir(owner):
            value = None if name.startswith('_') else getattr(owner, name)
            if isinstance(value, (np.ndarray, float, int)):
                found[f'{type(owner).__name__}.{name}'] = np.array(value)
    return found
