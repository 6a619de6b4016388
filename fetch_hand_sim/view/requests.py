"""What the page asks for, of a running robot or of a file.

Snapshots are replaced by newer ones, events all arrive (`mujoco.studio.messages`).
"""

from __future__ import annotations

from dataclasses import dataclass

from mujoco.studio import messages

from msgs_spec.arrays import Array


class Request(messages.Event):
    """What the page asks for, once."""


class LatestRequest(messages.Snapshot):
    """What the page asks for again and again; only the newest counts."""


@dataclass(frozen=True)
class SetPaused(Request):
    """Stops time or lets it go on."""

    is_paused: bool


@dataclass(frozen=True)
class StepOnce(Request):
    """Runs one tick, or shows the next frames of a file (negative: earlier ones)."""

    frames: int = 1


@dataclass(frozen=True)
class Reset(Request):
    """Ends the episode; the next one has this seed, or the next in order for None."""

    seed: int | None = None


@dataclass(frozen=True)
class SetSpeed(Request):
    """Changes the simulated seconds per second."""

    factor: float


@dataclass(frozen=True)
class ChooseActor(Request):
    """Lets another actor command."""

    name: str


@dataclass(frozen=True)
class SetCommanding(Request):
    """Lets the page's sliders command, or no longer."""

    is_commanding: bool


@dataclass(frozen=True, eq=False)
class SetCommand(LatestRequest):
    """The sliders' command (action size,), command units."""

    values: Array


@dataclass(frozen=True, eq=False)
class SetGoal(LatestRequest):
    """A new goal (goal size,).

    Attributes:
        values: m and quaternion wxyz.
        is_kept: Whether later episodes get it as well.
    """

    values: Array
    is_kept: bool = True


@dataclass(frozen=True)
class ReleaseGoal(Request):
    """Lets later episodes draw their own goals again."""


@dataclass(frozen=True, eq=False)
class Push(LatestRequest):
    """A pull at a body, as long as it is sent; what is beyond the robot's limit is made less.

    Attributes:
        body: Name of the body.
        wrench: (6,) N and N m, world axes, at the centre of mass.
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
