"""Messages from the source (a running robot or a file player) to the page.

MuJoCo's viewer delivers each `Event`, but of each `Snapshot` class only the newest message.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from mujoco.studio import messages

from fetch_hand_sim.simulation.scene import Frame, Scene
from msgs_spec.arrays import Array

ONLY_WATCHED = 'this page can only watch (--read-only)'


@dataclass(frozen=True, slots=True)
class Facts:
    """State of robot and episode that the page shows as text.

    Attributes:
        source: `live` for a running robot, `file` for an episode file.
        tick: Steps of the episode so far.
        ticks: Steps of a whole episode.
        commander: Names of the nodes that command the robot.
        speed: Requested simulated seconds per second; 0 means as fast as possible.
        has_speed: Whether the speed can be chosen, which is not possible in lockstep.
        rate: Measured ticks per second; 0 if unknown.
        missed_ticks: Number of missed ticks since the robot started.
        push_limit: Largest force of a push, N; 0 if the robot accepts none.
        may_command: False for a page that can only watch (`--read-only`).
        actors: Actors to choose from; empty without a policy node.
        actor: Name or file of the active actor, or '' if unknown.
        is_replay: Whether a replay node publishes instead of a robot.
        is_silent: Whether the robot has stopped publishing; then other facts are the last known.
        is_commanding: Whether the sliders of the page command the robot.
        notice: Line about the result of the user's last request, or ''.
    """

    source: str = 'live'
    episode: int = 0
    seed: int = 0
    tick: int = 0
    ticks: int = 0
    episode_return: float = 0.0
    commander: str = ''
    is_paused: bool = False
    speed: float = 1.0
    has_speed: bool = True
    rate: float = 0.0
    missed_ticks: int = 0
    push_limit: float = 0.0
    may_command: bool = True
    actors: tuple[str, ...] = ()
    actor: str = ''
    is_replay: bool = False
    is_silent: bool = False
    is_commanding: bool = False
    notice: str = ''

    @property
    def takes_actions(self) -> bool:
        """True if the user of this page can set goals and push the robot."""
        return self.source == 'live' and self.may_command and not self.is_replay


@dataclass(frozen=True, slots=True)
class Series:
    """A curve: times in simulated seconds and values of the same length."""

    times: Array
    values: Array


@dataclass(frozen=True, slots=True)
class Graphs:
    """The curves of the page; a curve that the task does not have is None.

    Attributes:
        distance: Distance to the goal, m.
        rotation: Rotation to the goal, rad, 0 ... pi.
        reward: Reward of each tick; NaN at a reset.
        commands: Values (ticks, action size), command units; NaN at a reset.
        positions: Positions (ticks, action size) of the commanded joints, rad. For Fetch, the first
            three columns are NaN, and the last contains the fingers, -1 (closed) to 1 (open).
    """

    distance: Series | None = None
    rotation: Series | None = None
    reward: Series | None = None
    commands: Series | None = None
    positions: Series | None = None


@dataclass(frozen=True, slots=True)
class Timeline:
    """Position of the playhead in an episode, and of the episode in the list.

    Attributes:
        time: Simulated seconds since the first frame.
        title: Name of the episode.
        number: Position of the episode in the list, from 0.
        count: Number of episodes in the list.
    """

    time: float
    title: str
    number: int
    count: int


@dataclass(frozen=True, eq=False)
class Picture(messages.Snapshot):
    """Message with everything that the page shows of one tick.

    Attributes:
        frame: State of robot, object and goals; None before the first tick.
        stamp_ns: Simulated time of the frame, nanoseconds.
        trail: Last positions (3,) of the object, gripper or first fingertip, the newest at the end.
        command: The last applied command (action size,); None at a reset.
        timeline: Position in the file; None for a running robot.
    """

    task: str
    frame: Frame | None = None
    stamp_ns: int = 0
    trail: tuple[Array, ...] = ()
    facts: Facts = field(default_factory=Facts)
    graphs: Graphs = field(default_factory=Graphs)
    command: Array | None = None
    timeline: Timeline | None = None


@dataclass(frozen=True, eq=False)
class ShowScene(messages.Event):
    """Message with the scene of another task, which the page shows from then on."""

    scene: Scene
