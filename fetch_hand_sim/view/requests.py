"""Messages from the page to its source (a running robot or a file player): user requests.

A newer snapshot replaces an older one; every event arrives (`mujoco.studio.messages`).
"""

from __future__ import annotations

from dataclasses import dataclass

from mujoco.studio import messages

from msgs_spec.arrays import Array


class Request(messages.Message):
    """A request of the user: an event sent once, or a snapshot sent in every frame."""


@dataclass(frozen=True)
class SetPaused(Request, messages.Event):
    """Pauses or resumes."""

    is_paused: bool


@dataclass(frozen=True)
class StepOnce(Request, messages.Event):
    """Runs one tick, or moves the playhead of a file by `frames`."""

    frames: int = 1


@dataclass(frozen=True)
class Reset(Request, messages.Event):
    """Ends the episode; the next one uses `seed`, or the next seed in order for None."""

    seed: int | None = None


@dataclass(frozen=True)
class SetSpeed(Request, messages.Event):
    """Sets the simulated seconds per second."""

    factor: float


@dataclass(frozen=True)
class ChooseActor(Request, messages.Event):
    """Makes the policy node load another actor."""

    name: str


@dataclass(frozen=True)
class SetCommanding(Request, messages.Event):
    """Switches the commands of the page's sliders on or off."""

    is_commanding: bool


@dataclass(frozen=True, eq=False)
class SetCommand(Request, messages.Snapshot):
    """The command (action size,) of the sliders, command units."""

    values: Array


@dataclass(frozen=True, eq=False)
class SetGoal(Request, messages.Snapshot):
    """A new goal (goal size,), m and quaternion wxyz; `is_kept` repeats it in later episodes."""

    values: Array
    is_kept: bool = True


@dataclass(frozen=True)
class ReleaseGoal(Request, messages.Event):
    """Lets later episodes draw their own goals again."""


@dataclass(frozen=True, eq=False)
class Push(Request, messages.Snapshot):
    """A wrench (6,) on a body, N and N m, world axes at the centre of mass, while it is sent.

    A force above the robot's limit is reduced.
    """

    body: str
    wrench: Array


@dataclass(frozen=True)
class Seek(Request, messages.Event):
    """Shows a frame of a file."""

    index: int


@dataclass(frozen=True)
class ChangeEpisode(Request, messages.Event):
    """Opens another episode of the list, relative to this one."""

    by: int


@dataclass(frozen=True)
class OpenEpisode(Request, messages.Event):
    """Opens an episode of the list by its number, from 0."""

    number: int
