"""MuJoCo's model and data of a simulation, shared with whoever reaches for them."""

from __future__ import annotations

from typing import Any

import mujoco

from fetch_hand_sim.simulation import Simulation


class SharedPhysics:
    """What `env.unwrapped.model` and `env.unwrapped.data` give: live, to read and to write.

    What was written into the data counts from the next call on, as if the simulation had come to it
    itself; so does what was written into the model. Nothing is copied before somebody asks.
    """

    def __init__(self, simulation: Simulation) -> None:
        """Shares the first copy of a simulation that keeps its data."""
        self._simulation = simulation
        self._data: mujoco.MjData | None = None
        self._shares_model = False

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, always the same object."""
        self._shares_model = True
        return self._simulation.model

    @property
    def data(self) -> mujoco.MjData:
        """The state and what MuJoCo derived from it in its last pass, always the same object."""
        if self._data is None:
            self._data = mujoco.MjData(self._simulation.model)
            self.receive()
        return self._data

    def send(self) -> None:
        """Takes over what was written; to be called before anything is computed."""
        if self._shares_model:
            self._simulation.apply_model_changes()
        if self._data is not None:
            self._simulation.write_data(0, self._data)

    def receive(self) -> None:
        """Shows what was computed."""
        if self._data is not None:
            self._simulation.read_data(0, self._data)

    def __getstate__(self) -> dict[str, Any]:
        """The data is read from the simulation again."""
        return self.__dict__ | {'_data': None}
