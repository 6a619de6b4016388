"""Messages from the page to the source: requests of the visitor.

A newer snapshot replaces an older one; every event arrives (`mujoco.studio.messages`).
"""

from __future__ import annotations

from dataclasses import dataclass

from mujoco.studio import messages

from msgs_spec.arrays import Array


class Request(messages.Event):
    """A request that is sent once."""


class LatestRequest(messages.Snapshot):
    """A request that is sent repeatedly; only the newest counts."""


@dataclass(frozen=True)
class SetPaused(Request):
    """Pauses or resumes."""

    is_paused: bool


@dataclass(frozen=True)
class StepOnce(Request):
    """Runs one tick, or moves the playhead of a file by `frames`."""

    frames: int = 1


@dataclass(frozen=True)
class Reset(Request):
    """Ends the episode; the next one uses `seed`, or the next seed in order for None."""

    seed: int | None = None


@dataclass(frozen=True)
class SetSpeed(Request):
    """Sets the simulated seconds per second."""

    factor: float


@dataclass(frozen=True)
class ChooseActor(Request):
    """Lets another actor command."""

    name: str


@dataclass(frozen=True)
class SetCommanding(Request):
    """Switches the commands of the page's sliders on or off."""

    is_commanding: bool


@dataclass(frozen=True, eq=False)
class SetCommand(LatestRequest):
    """The command (action size,) of the sliders, command units."""

    values: Array


@dataclass(frozen=True, eq=False)
class SetGoal(LatestRequest):
    """A new goal (goal size,), m and quaternion wxyz; `is_kept` repeats it in later episodes."""

    values: Array
    is_kept: bool = True


@dataclass(frozen=True)
class ReleaseGoal(Request):
    """Lets later episodes draw their own goals again."""


@dataclass(frozen=True, eq=False)
class Push(LatestRequest):
    """A wrench (6,) on a body, N and N m, world axes at the centre of mass, while it is sent.

    A force above the robot's limit is reduced.
    """

    body: str
    wrench: Array


@dataclass(frozen=True)
class Seek(Request):
    """Shows a frame of a file."""

    index: int


@dataclass(frozen=True)
class ChangeEpisode(Request):
    """Opens another episode of the list, relative to this one."""

    by: int


@dataclass(frozen=True)
class OpenEpisode(Request):
    """Opens an episode of the list by its number, from 0."""

    number: int
