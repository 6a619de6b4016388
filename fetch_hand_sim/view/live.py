"""Follow a running robot for the page, and send it the requests of the page."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.view.curves import History
from fetch_hand_sim.view.picture import ONLY_WATCHED, Facts, Picture
from fetch_hand_sim.view.requests import Request, SetCommand, SetCommanding, SetGoal
from fetch_hand_sim.view.robot_requests import RobotRequests
from fetch_hand_sim.view.web import FOLLOWING, OVERLOOKING
from fetch_hand_sim.watch.replay_watch import ReplayWatch, status_publishers
from fetch_hand_sim.watch.robot_watch import ANY_TASK, WATCHING, RobotWatch, SeenTick, spec_of
from msgs_spec.codecs import decode_status
from msgs_spec.tasks import TaskSpec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, topic
from node_runtime.diagnostics import (
    ASKED_RATE,
    COMMANDERS,
    MISSED_TICKS,
    MODE,
    PAUSED,
    PERTURB_LIMIT,
    RATE,
)
from node_runtime.ros import full_name, subscribe

# A robot counts as fast above its real-time rate times this factor.
_HURRY = 1.5
# Seconds between two checks of the graph and of the settings of nodes.
_LOOK_PERIOD = 0.5
# Seconds without a message after which a robot is silent; a robot reports every second.
_SILENCE = 4.0
# Seconds for which a notice stays at least, even if its episode is shorter.
_NOTICE_TIME = 3.0


class LiveRobot:
    """Follows the robot in the namespace of `node` and sends it the requests of the page.

    Args:
        may_command: False for a page that can only watch (`--read-only`).
    """

    def __init__(self, node: Node, may_command: bool) -> None:
        self._node = node
        self._sim_name = full_name(node.get_namespace(), 'sim_node')
        self._facts = Facts(may_command=may_command)
        self._history: History | None = None
        self._is_new = False
        self._policy = ''
        self._asked_rate: str | None = None
        self._heard = time.monotonic()
        self._noticed = ((0, 0), 0.0)
        # Identities of the publishers of `episode_status`.
        self._publishers: frozenset[bytes] = frozenset()
        # Settings of nodes that may have changed, by the name of the fact.
        self._unread: set[str] = set()
        self._requests = RobotRequests(node, self._update_facts)
        self._watch = RobotWatch(node, self._on_status, self._on_tick, every_tick=False)
        subscribe(node, DIAGNOSTICS, self._on_diagnostics, qos=WATCHING)
        subscribe(node, topic(ANY_TASK, 'policy_status'), self._on_policy)
        self._replays = ReplayWatch(node)
        # Steady time, because simulated time stops with a paused robot.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_LOOK_PERIOD, self._look, clock=clock)

    @property
    def spec(self) -> TaskSpec | None:
        """The robot's task; None before the first status."""
        return self._watch.spec

    @property
    def picture_period(self) -> float:
        """Frame period, s, for an idle user: 1/12 if the robot exceeds 1.5 x real time, or 1/30."""
        status = self._watch.status
        is_fast = status is not None and self._facts.rate > _HURRY * status.control_hz
        return OVERLOOKING if is_fast else FOLLOWING

    def picture(self) -> Picture | None:
        """Return all that the page shows now; None if nothing has changed since the last call."""
        if not self._is_new or self._history is None:
            return None
        self._is_new = False
        history, facts, spec = self._history, self._facts, self._history.metric.spec
        commander = facts.commander
        if self._policy and 'policy_node' in commander:
            commander = f'{commander}: {self._policy}'
        facts = dataclasses.replace(
            facts,
            tick=min(facts.tick, spec.episode_ticks),
            ticks=spec.episode_ticks,
            commander=commander,
            actors=(spec.name, 'random', 'resting') if self._requests.has_policy else (),
        )
        return dataclasses.replace(history.picture, graphs=history.curves.graphs(), facts=facts)

    def perform(self, request: Request) -> None:
        """Perform a request, unless the page may only watch."""
        if not self._facts.may_command:
            self._update_facts(notice=ONLY_WATCHED)
            return
        if isinstance(request, SetCommand):
            self._notice_other_robot()
        if request == SetCommanding(True) and self._facts.is_silent:
            self._update_facts(notice='the robot is silent: the sliders cannot command it')
            return
        self._requests.perform(request, self._facts)
        history, is_replay = self._history, self._facts.is_replay
        is_goal = isinstance(request, SetGoal) and self._requests.fits(request)
        if is_goal and history is not None and not is_replay:
            # At once: a robot that stands still publishes no tick with it.
            history.show_goal(request.values)
            self._is_new = True

    def leave(self) -> None:
        """Stop the commands of the page, because its user has left."""
        self._stop_commanding('the visitor left: the sliders no longer command')

    def _stop_commanding(self, notice: str) -> None:
        if self._facts.is_commanding:
            self._requests.perform(SetCommanding(False), self._facts)
            self._update_facts(notice=notice)

    def _notice_other_robot(self) -> None:
        """Stop commanding and drop the user's goal if the robot has shut down or restarted."""
        publishers = status_publishers(self._node)
        if publishers != self._publishers:
            self._publishers = publishers
            self._forget_requests()

    def _forget_requests(self) -> None:
        self._stop_commanding('the robot shut down or restarted: the sliders no longer command')
        self._requests.forget_goal()

    def _on_status(self, status: EpisodeStatus) -> None:
        self._hear()
        spec = spec_of(status)
        if self._history is not None and self._history.metric.spec.name != spec.name:
            self._forget_requests()
        metric = GoalMetric(spec, success_rule=status.success_rule)
        history = self._history
        # A waiting robot has no episode yet.
        if history is None or history.metric != metric or status.phase == 'waiting':
            history = self._history = History(metric)
        self._requests.take_task(spec)
        # The reset itself may be missing among the ticks of a fast robot.
        facts = self._facts
        is_same = (status.episode, status.seed) == (facts.episode, facts.seed)
        if status.phase == 'reset' or not is_same or status.tick < facts.tick:
            history.begin_episode()
            self._update_facts(tick=status.tick, episode_return=status.episode_return)
            self._notice_other_robot()
            self._requests.begin_episode()
        self._update_facts(episode=status.episode, seed=status.seed)

    def _on_tick(self, tick: SeenTick) -> None:
        history, facts = self._history, self._facts
        if history is None:
            return
        self._hear()
        self._replays.count_tick()
        goal = self._requests.shown_goal(tick.frame.desired_goal)
        frame = dataclasses.replace(tick.frame, desired_goal=goal)
        history.add(tick.stamp_ns, frame, tick.reward, tick.command)
        if tick.status is not None:
            count, total = tick.status.tick, tick.status.episode_return
        else:
            # `episode_status` is published only when an episode begins or ends.
            count = facts.tick + int(tick.command is not None)
            total = facts.episode_return + (tick.reward or 0.0)
        self._update_facts(tick=count, episode_return=total)

    def _on_policy(self, message: Any) -> None:
        self._policy = decode_status(message).get('commander', '')
        self._unread.add('actor')
        self._is_new = True

    def _hear(self) -> None:
        self._heard = time.monotonic()
        if self._facts.is_silent:
            self._update_facts(is_silent=False)

    def _look(self) -> None:
        """Update the page for a restarted, replayed or silent robot; a timer calls this method.

        Also request the speed and the active actor if they may have changed.
        """
        self._notice_other_robot()
        is_other = self._replays.look()
        replay = self._replays.replay
        if is_other:
            self._requests.take_replay(replay)
            self._update_facts(
                is_replay=replay is not None, is_paused=False, commander='', rate=0.0
            )
        if replay is not None:
            self._follow_replay(replay.name)
        elif self.spec is not None and time.monotonic() - self._heard > _SILENCE:
            self._stop_commanding('the robot is silent: the sliders no longer command')
            if not self._facts.is_silent:
                self._update_facts(is_silent=True, is_paused=False, commander='', rate=0.0)
        self._end_notice()
        # `_update_facts` removes a name when the answer arrives.
        if 'speed' in self._unread:
            self._requests.read_speed()
        if 'actor' in self._unread:
            self._requests.read_actor()

    def _end_notice(self) -> None:
        """Clear the notice on the page once it is over 3 s old and another episode has begun."""
        episode, since = self._noticed
        is_over = episode != (self._facts.episode, self._facts.seed)
        if self._facts.notice and is_over and time.monotonic() - since > _NOTICE_TIME:
            self._update_facts(notice='')

    def _follow_replay(self, name: str) -> None:
        """Show rate and pause of the replay node `name`, and stop the commands of the page."""
        self._hear()
        self._asked_rate = None
        self._unread.add('speed')
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
            # The report rounds the speed, and leaves it out while paused or in lockstep.
            self._asked_rate = asked
            self._unread.add('speed')
        self._update_facts(
            is_paused=values.get(PAUSED) == 'True',
            rate=_number(values.get(RATE)),
            missed_ticks=int(_number(values.get(MISSED_TICKS))),
            commander=values.get(COMMANDERS, '-'),
            push_limit=_number(values.get(PERTURB_LIMIT)),
            has_speed=values.get(MODE) != 'lockstep',
        )
        self._yield_to_others()

    def _yield_to_others(self) -> None:
        """Stop the commands of the page if another node commands the robot."""
        own = self._node.get_fully_qualified_name()
        others = [each for each in self._facts.commander.split(', ') if each != own]
        if others not in ([], ['-']):
            self._stop_commanding(f'{", ".join(others)} commands: your sliders do not')

    def _update_facts(self, **changes: Any) -> None:
        if changes.get('notice'):
            self._noticed = (self._facts.episode, self._facts.seed), time.monotonic()
        self._facts = dataclasses.replace(self._facts, **changes)
        self._unread -= changes.keys()
        self._is_new = True


def _number(text: str | None) -> float:
    try:
        value = float(text or 0.0)
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
