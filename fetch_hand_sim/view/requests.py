"""User requests, which the page sends to its source (a running robot or a file player).

MuJoCo's viewer delivers each `Event`, but of each `Snapshot` class only the newest message.
"""

from __future__ import annotations

from dataclasses import dataclass

from mujoco.studio import messages

from msgs_spec.arrays import Array


class Request(messages.Message):
    """A request of the user: an event sent once, or a snapshot sent in every frame."""


@dataclass(frozen=True)
class SetPaused(Request, messages.Event):
    """Pauses or resumes the robot or the playback."""

    is_paused: bool


@dataclass(frozen=True)
class StepOnce(Request, messages.Event):
    """Runs one tick of a robot, or pauses a file and moves its playhead by `frames` (-1: back)."""

    frames: int = 1


@dataclass(frozen=True)
class Reset(Request, messages.Event):
    """Ends the episode; the next one uses `seed`, or the robot's next seed if `seed` is None."""

    seed: int | None = None


@dataclass(frozen=True)
class SetSpeed(Request, messages.Event):
    """Sets the simulated seconds per second."""

    factor: float


@dataclass(frozen=True)
class ChooseActor(Request, messages.Event):
    """Makes the policy node load another actor; `name` is a shipped actor, random or resting."""

    name: str


@dataclass(frozen=True)
class SetCommanding(Request, messages.Event):
    """Switches the commands of the page's sliders on or off."""

    is_commanding: bool


@dataclass(frozen=True, eq=False)
class SetCommand(Request, messages.Snapshot):
    """Sends the command (action size,) of the sliders, command units."""

    values: Array


@dataclass(frozen=True, eq=False)
class SetGoal(Request, messages.Snapshot):
    """Sets a goal (goal size,), m and quaternion wxyz; `is_kept` repeats it in later episodes."""

    values: Array
    is_kept: bool = True


@dataclass(frozen=True)
class ReleaseGoal(Request, messages.Event):
    """Lets later episodes draw their own goals again."""


@dataclass(frozen=True, eq=False)
class Push(Request, messages.Snapshot):
    """Pushes a body with a wrench (6,), N and N m, as long as the request is repeated.

    The wrench acts at the centre of mass, along the world axes; `Facts.push_limit` limits it.
    """

    body: str
    wrench: Array


@dataclass(frozen=True)
class Seek(Request, messages.Event):
    """Pauses the playback and shows the frame `index` of a file."""

    index: int


@dataclass(frozen=True)
class ChangeEpisode(Request, messages.Event):
    """Opens the episode `by` places further in the file player's list, which wraps around."""

    by: int


@dataclass(frozen=True)
class OpenEpisode(Request, messages.Event):
    """Opens an episode of the file player's list by its number, from 0; ignored if unknown."""

    number: int
