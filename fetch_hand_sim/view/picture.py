"""What the page is told: everything that it shows of one tick.

Snapshots are replaced by newer ones, events all arrive (`mujoco.studio.messages`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from mujoco.studio import messages

from fetch_hand_sim.simulation.scene import Frame, Scene
from msgs_spec.arrays import Array

# Where nobody may act.
ONLY_WATCHED = 'this page may only watch (--read-only)'


@dataclass(frozen=True, slots=True)
class Facts:
    """What the page says in words.

    Attributes:
        source: `live` or `file`.
        phase: Of the episode.
        episode: Its number.
        seed: Its seed.
        tick: Steps of it so far.
        ticks: Steps it will have.
        episode_return: Sum of its rewards.
        commander: Who commands.
        is_paused: Whether time stands still.
        speed: Simulated seconds per second, asked for; 0 for as fast as possible.
        has_speed: Whether that can be chosen; in lockstep commands say how fast time goes.
        rate: Ticks per second, measured; 0 if unknown.
        missed_ticks: Since the robot started.
        push_limit: Largest force of a push, N; 0 where the robot takes none.
        may_command: Whether this page may act at all.
        actors: Actors to choose from; empty where there is no policy.
        actor: The one of these that acts, the file of another one, or '' if unknown.
        is_replay: Whether what is live is the replay of an episode.
        is_silent: Whether nothing is heard of the robot any more; all else is what it said last.
        is_commanding: Whether the page sends commands.
        notice: What the last action led to.
    """

    source: str = 'live'
    phase: str = 'waiting'
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
        """Whether there is a robot that does what this page asks for."""
        return self.source == 'live' and self.may_command and not self.is_replay


@dataclass(frozen=True, slots=True)
class Series:
    """A curve: times in simulated seconds and values of the same length."""

    times: Array
    values: Array

    def until(self, time: float) -> Series:
        """The curve up to a time."""
        known = self.times <= time + 1e-9
        return Series(self.times[known], self.values[known])


@dataclass(frozen=True, slots=True)
class Graphs:
    """The curves of the page; None for what the task does not have.

    Attributes:
        distance: To the goal, m.
        rotation: To the goal, rad.
        reward: Of each tick.
        commands: One column per command: (ticks,) times and (ticks, commands) values.
        positions: The joints that the commands drive, likewise; how far a gripper is open, from -1
            to 1; NaN for its path.
    """

    distance: Series | None = None
    rotation: Series | None = None
    reward: Series | None = None
    commands: Series | None = None
    positions: Series | None = None

    def until(self, time: float) -> Graphs:
        """The curves up to a time."""
        series = (getattr(self, each.name) for each in fields(self))
        return Graphs(*(each.until(time) if each is not None else None for each in series))


@dataclass(frozen=True, slots=True)
class Timeline:
    """Where a file is being played.

    Attributes:
        index: Frame shown, from 0.
        frames: How many there are.
        time: Seconds since the first.
        title: Name of the episode.
        number: Which one of the list, from 0.
        count: How many there are in the list.
    """

    index: int
    frames: int
    time: float
    title: str
    number: int
    count: int


@dataclass(frozen=True, eq=False)
class Picture(messages.Snapshot):
    """Everything the page shows of one tick.

    Attributes:
        task: Name of the task.
        frame: Robot, object and goals; None before the first tick.
        stamp_ns: Simulated time of the frame, nanoseconds.
        trail: Where the object or gripper was before.
        facts: In words.
        graphs: What it did before, as curves.
        command: The last applied command.
        timeline: Where a file is being played; None for a running robot.
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
    """The page shows another robot from now on."""

    scene: Scene
