"""A running robot as the page sees it."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import TRAIL_TICKS, tracked_position
from fetch_hand_sim.view.curves import Curves
from fetch_hand_sim.view.frame_rate import FOLLOWING, OVERLOOKING
from fetch_hand_sim.view.picture import ONLY_WATCHED, Facts, Graphs, Picture
from fetch_hand_sim.view.replay_watch import ReplayWatch
from fetch_hand_sim.view.requests import LatestRequest, Request, SetCommanding, SetGoal
from fetch_hand_sim.view.robot_requests import RobotRequests
from fetch_hand_sim.view.robot_watch import ANY_TASK, WATCHING, RobotWatch, SeenTick
from msgs_spec.arrays import Array
from msgs_spec.codecs import decode_status
from msgs_spec.diagnostics import (
    ASKED_RATE,
    COMMANDERS,
    MISSED_TICKS,
    MODE,
    PAUSED,
    PERTURB_LIMIT,
    RATE,
)
from msgs_spec.tasks import SuccessRule, TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, topic
from node_runtime.ros import full_name

# A robot is fast that has more ticks per second than in real time by this factor.
_HURRY = 1.5
# Seconds between two looks at who is there and what nodes are set to.
_LOOK_PERIOD = 0.5
# Seconds without a word that say a robot is gone: one that is there reports every second.
_SILENCE = 4.0


class LiveRobot:
    """Follows the robot in the node's namespace and passes on what the page asks for.

    Args:
        node: Of this process.
        may_command: Whether the page may act.
    """

    def __init__(self, node: Node, may_command: bool) -> None:
        self._may_command = may_command
        self._name = node.get_fully_qualified_name()
        self._sim_name = full_name(node.get_namespace(), 'sim_node')
        self._facts = Facts(may_command=may_command)
        self._commander = ''
        self._phase = ''
        self._asked_rate: str | None = None
        self._heard = time.monotonic()
        # Settings of nodes to be read: they may have changed.
        self._unread: set[str] = set()
        self._trail: deque[Array] = deque(maxlen=TRAIL_TICKS)
        self._curves: Curves | None = None
        self._rule: SuccessRule | None = None
        self._episode: tuple[int, int] | None = None
        self._picture: Picture | None = None
        self._is_new = False
        self._requests = RobotRequests(node, self._update_facts)
        self._watch = RobotWatch(node, self._on_status, self._on_tick, every_tick=False)
        self._watch.subscribe(DIAGNOSTICS, WATCHING, self._on_diagnostics)
        introduction = topic(ANY_TASK, 'policy_status')
        self._watch.subscribe(introduction, introduction.qos, self._on_commander)
        self._replays = ReplayWatch(node)
        # In wall time: simulated time stands still with a robot that is paused.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_LOOK_PERIOD, self._look, clock=clock)

    @property
    def spec(self) -> TaskSpec | None:
        """The robot's task; None until there is one."""
        return self._watch.spec

    @property
    def picture_period(self) -> float:
        """Seconds between two pictures that show enough of it."""
        status = self._watch.status
        is_fast = status is not None and self._facts.rate > _HURRY * status.control_hz
        return OVERLOOKING if is_fast else FOLLOWING

    def picture(self) -> Picture | None:
        """Returns what to show if it has changed since the last call."""
        if not self._is_new or self._picture is None:
            return None
        self._is_new = False
        # Curves are copied as often as they are drawn, not as often as the robot ticks.
        graphs = self._curves.graphs() if self._curves is not None else Graphs()
        return dataclasses.replace(self._picture, graphs=graphs, facts=self._current_facts())

    def perform(self, request: Request | LatestRequest) -> None:
        """Does what the page asks for, unless it may only watch."""
        if not self._may_command:
            self._update_facts(notice=ONLY_WATCHED)
            return
        self._requests.perform(request)
        if (
            isinstance(request, SetGoal)
            and not self._facts.is_replay
            and self._requests.fits(request)
        ):
            self._show_goal(request.values)

    def leave(self) -> None:
        """Stops to command, as nobody is at the page."""
        if self._facts.is_commanding:
            self._requests.perform(SetCommanding(False))
            self._update_facts(notice='nobody was at the page: its sliders no longer command')

    def _on_status(self, status: EpisodeStatus) -> None:
        self._hear()
        spec = task_spec(status.task, status.joint_prefix, status.control_hz)
        # One that waits has no episode yet: what is known is of another, that was here before.
        is_waiting = status.phase == 'waiting'
        if self._picture is None or self._picture.task != spec.name or is_waiting:
            self._picture, self._curves = Picture(spec.name), None
            self._trail.clear()
        if self._curves is None or self._rule != status.success_rule:
            self._rule = status.success_rule
            self._curves = Curves(spec, GoalMetric(spec, success_rule=status.success_rule))
        self._requests.take_task(spec)
        self._phase = status.phase
        # The reset itself of a fast robot may not have been among the ticks that came.
        episode = status.episode, status.seed
        if status.phase == 'reset' or episode != self._episode or status.tick < self._facts.tick:
            self._trail.clear()
            self._count(status.tick, status.episode_return)
            self._requests.begin_episode()
        self._episode = episode
        self._is_new = True

    def _on_tick(self, tick: SeenTick) -> None:
        spec = self.spec
        if spec is None or self._curves is None:
            return
        self._hear()
        self._replays.count_tick()
        if tick.status is None and tick.reward is not None:
            # `episode_status` speaks up only where an episode begins or ends.
            self._phase = 'running'
        goal = self._requests.shown_goal(tick.frame.desired_goal)
        frame = dataclasses.replace(tick.frame, desired_goal=goal)
        if self._picture is not None and tick.stamp_ns < self._picture.stamp_ns:
            # A replay that begins again, or a robot: curves go one way.
            self._curves = Curves(spec, self._curves.metric)
        self._trail.append(tracked_position(frame))
        self._curves.add(tick.stamp_ns * 1e-9, frame, tick.reward, tick.command)
        if tick.status is not None:
            self._count(tick.status.tick, tick.status.episode_return)
        else:
            steps, reward = int(tick.command is not None), tick.reward or 0.0
            self._count(self._facts.tick + steps, self._facts.episode_return + reward)
        self._picture = Picture(
            task=spec.name,
            frame=frame,
            stamp_ns=tick.stamp_ns,
            trail=tuple(self._trail),
            command=tick.command,
        )

    def _count(self, tick: int, episode_return: float) -> None:
        self._update_facts(tick=tick, episode_return=episode_return)

    def _show_goal(self, goal: Array) -> None:
        """Shows a goal before the robot confirms it."""
        picture = self._picture
        if picture is not None and picture.frame is not None:
            frame = dataclasses.replace(picture.frame, desired_goal=goal)
            self._picture = dataclasses.replace(picture, frame=frame)
            # A robot that stands still sends no tick with which it would be shown.
            self._is_new = True

    def _on_commander(self, message: Any) -> None:
        self._commander = decode_status(message).get('commander', '')
        self._unread.add('actor')
        self._is_new = True

    def _hear(self) -> None:
        self._heard = time.monotonic()
        if self._facts.is_silent:
            self._update_facts(is_silent=False)

    def _look(self) -> None:
        """Looks at who is there, and reads what nodes may have been set to."""
        is_other = self._replays.look()
        replay, facts = self._replays.replay, self._facts
        if is_other:
            self._requests.take_replay(replay)
            self._facts = dataclasses.replace(
                facts, is_replay=replay is not None, is_paused=False, commander='', rate=0.0
            )
        if replay is not None:
            self._follow_replay(replay.name)
        elif self.spec is not None and time.monotonic() - self._heard > _SILENCE:
            self._notice_silence()
        # Read once it is known; `_update_facts` ticks off what an answer brings, by the same names.
        for name, read in (
            ('speed', self._requests.read_speed),
            ('actor', self._requests.read_actor),
        ):
            if name in self._unread:
                read()

    def _notice_silence(self) -> None:
        """Stops to say of a robot that is gone, or hangs, how fast it ticks and who commands."""
        if not self._facts.is_silent:
            self._update_facts(is_silent=True, is_paused=False, commander='', rate=0.0)

    def _follow_replay(self, name: str) -> None:
        """Says of a replay what a robot says of itself in its diagnostics."""
        self._hear()
        self._asked_rate = None
        self._unread.add('speed')
        self._requests.push_limit = 0.0
        self._update_facts(
            is_paused=self._replays.stands_still(self._facts.is_paused),
            rate=self._replays.rate,
            missed_ticks=0,
            commander=f'a replay ({name})',
            push_limit=0.0,
            has_speed=True,
        )
        self._yield_to_others()

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name == self._sim_name and not self._facts.is_replay:
                self._take_report({pair.key: pair.value for pair in status.values})

    def _take_report(self, values: dict[str, str]) -> None:
        self._hear()
        asked = values.get(ASKED_RATE)
        if asked != self._asked_rate:
            # Rounded, and of a robot that is paused or in lockstep not there: the robot knows.
            self._asked_rate = asked
            self._unread.add('speed')
        self._requests.push_limit = _number(values.get(PERTURB_LIMIT))
        self._update_facts(
            is_paused=values.get(PAUSED) == 'True',
            rate=_number(values.get(RATE)),
            missed_ticks=int(_number(values.get(MISSED_TICKS))),
            commander=values.get(COMMANDERS, '-'),
            push_limit=self._requests.push_limit,
            has_speed=values.get(MODE) != 'lockstep',
        )
        self._yield_to_others()

    def _yield_to_others(self) -> None:
        """Stops to command where somebody else does: two would fight over the robot."""
        others = [each for each in self._facts.commander.split(', ') if each != self._name]
        if self._facts.is_commanding and others not in ([], ['-']):
            self._requests.perform(SetCommanding(False))
            self._update_facts(notice=f'{", ".join(others)} commands: your sliders do not')

    def _update_facts(self, **changes: Any) -> None:
        self._facts = dataclasses.replace(self._facts, **changes)
        self._unread -= changes.keys()
        self._is_new = True

    def _current_facts(self) -> Facts:
        status, spec, facts = self._watch.status, self.spec, self._facts
        assert status is not None and spec is not None
        commander = facts.commander
        if self._commander and 'policy_node' in commander:
            commander = f'{commander}: {self._commander}'
        return dataclasses.replace(
            facts,
            phase=self._phase,
            episode=status.episode,
            seed=status.seed,
            tick=min(facts.tick, spec.episode_ticks),
            ticks=spec.episode_ticks,
            commander=commander,
            actors=(spec.name, 'random', 'resting') if self._requests.has_policy else (),
        )


def _number(text: str | None) -> float:
    try:
        value = float(text or 0.0)
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
