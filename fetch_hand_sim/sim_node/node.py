"""The ROS node of a simulated robot.

One thread does all work except writing log files; at 25 Hz a tick takes 2 of 40 ms.
"""

from __future__ import annotations

import errno
import gc
import sys
import time
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from fetch_hand_sim.episode_log import EpisodeLogError, find_leftovers
from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.recorder import EpisodeRecorder, LoggedEpisode, RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.sim_node import NODE_NAME
from fetch_hand_sim.sim_node.graph_watch import GraphWatch
from fetch_hand_sim.sim_node.health import WAITING_PERIOD, Health
from fetch_hand_sim.sim_node.robot import Receivers, Robot
from fetch_hand_sim.sim_node.schedule import LatestTick, Messages, TickSchedule
from fetch_hand_sim.sim_node.services import open_services
from fetch_hand_sim.simulation import Simulation
from msgs_spec.disturbances import read_disturbances
from msgs_spec.parameters import SIM_NODE
from msgs_spec.robots import read_joint_prefix
from msgs_spec.tick import EpisodeStatus, Tick, TickEncoder
from msgs_spec.topics import LATEST_TICK, MONITORING, ground_truth_topics, topics
from node_runtime.diagnostics import REPORT_PERIOD, next_report
from node_runtime.event_loop import BEAT, EventLoop
from node_runtime.node_main import NodeFailure, StopSignals
from node_runtime.ros import await_acknowledgements, open_publisher, subscribe
from node_runtime.ros_parameters import declare_parameters, set_callback

_WARN_PERIOD = 1.0
_MILLISECOND = 1e-3
# Seconds that a beat may take. No beat begins that close to a tick.
_BEAT_TIME = 0.01
# Maximum number of callbacks before a due tick, far more than in normal operation.
_SERVED_FIRST = 100
# Errors of a disk that stop logging but not the simulation.
_DISK_ERRORS = (errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO)
# Seconds to wait for the latched `policy_status` of a new policy.
_POLICY_STATUS_TIME = 1.0


class SimNode(Node):
    """Publishes the state of one robot at every tick and applies the commands it receives."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME, start_parameter_services=False)
        self._settings = declare_parameters(self, SIM_NODE)
        self._reject_simulated_time()
        self._robot = self._make_robot()
        self._warn_after: dict[str, float] = {}
        self._recording_context: RecordingContext | None = None
        self._recorder = self._make_recorder()
        self._outputs = self._open_topics()
        self._open_ground_truth()
        encoder = TickEncoder(self._robot.runner.spec)
        self._latest_tick = LatestTick(self._outputs[LATEST_TICK.name], encoder)
        self._watch = GraphWatch(self, self._robot.runner.spec, self._outputs)
        open_services(self, self._robot)
        now = time.monotonic()
        self._health = Health(self, self._robot, self._watch, self._recorder, now)
        self._has_policy_status = False
        self._beat_due = self._ticked_at = now
        self._report_due = now + REPORT_PERIOD
        self.add_on_set_parameters_callback(set_callback(SIM_NODE, makes_time=True))
        self.add_post_set_parameters_callback(self._apply_changes)

    # Set-up

    def _reject_simulated_time(self) -> None:
        """Set `use_sim_time` back to false, with a warning; launch files may set it to true."""
        if self.get_parameter('use_sim_time').value:
            self.set_parameters([Parameter('use_sim_time', value=False)])
            self.get_logger().warning(
                'use_sim_time is set back to false: sim_node itself publishes simulated time'
            )

    def _make_robot(self) -> Robot:
        values = self._settings
        simulation = Simulation(
            values['task'],
            num_envs=1,
            num_threads=1,
            reward_type=values['reward_type'],
            success_rule=values['success_rule'],
            control_hz=values['control_hz'],
            disturbances=values['disturbances'],
        )
        runner = EpisodeRunner(
            simulation,
            first_seed=values['seed'],
            episodes=values['episodes'],
            joint_prefix=read_joint_prefix(simulation.spec.robot, values['joint_prefix']),
        )
        schedule = TickSchedule(
            values['mode'],
            simulation.tick_duration,
            values['real_time_factor'],
            time.monotonic(),
            values['answer_wait'] * _MILLISECOND,
        )
        robot = Robot(
            runner,
            CommandBuffer(runner.spec.robot, values['command_timeout']),
            schedule,
            self._emit,
        )
        robot.perturb_limit = values['perturb_limit']
        return robot

    def _open_topics(self) -> dict[str, Publisher]:
        receivers = Receivers(self._robot, self._recorder, self._on_commander, self._warn)
        publishers = {}
        # `latest_tick` comes before the topics of the task, so that viewers never miss it.
        for spec in (*MONITORING, *topics(self._robot.runner.spec)):
            if spec.direction == 'subscribed':
                subscribe(self, spec, receivers.callback(spec), raw=True)
            elif spec.name != '/clock' or self._settings['publish_clock']:
                publishers[spec.name] = open_publisher(self, spec)
        return publishers

    def _open_ground_truth(self) -> None:
        """Open the topics for the undisturbed state, if disturbances are on."""
        if read_disturbances(self._settings['disturbances']).is_off:
            return
        for spec in ground_truth_topics(self._robot.runner.spec):
            if spec.name not in self._outputs:
                self._outputs[spec.name] = open_publisher(self, spec)

    def _make_recorder(self) -> EpisodeRecorder | None:
        directory = self._settings['episode_dir']
        if not directory:
            return None
        self._recording_context = context = RecordingContext(
            self._robot.runner.simulation,
            with_compiled_model=self._settings['log_compiled_model'],
            perturb_limit=self._settings['perturb_limit'],
        )
        try:
            Path(directory).mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            pass
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise ValueError(f'episode_dir: {directory}: {error.strerror}') from None
        try:
            leftovers = find_leftovers(Path(directory))
        except EpisodeLogError as error:
            raise ValueError(f'episode_dir: {error}') from None
        for leftover in leftovers:
            self.get_logger().warning(str(leftover))
        return EpisodeRecorder(
            Path(directory),
            namespace=self.get_namespace(),
            attachments=context.attachments,
            metadata=context.metadata,
            on_error=lambda line: self.get_logger().error(line),
            on_logged=self._on_logged,
            on_slow=lambda line: self.get_logger().warning(line),
        )

    # Running

    def run(self, stop: StopSignals) -> None:
        """Run until all episodes are done or a signal arrives; NodeFailure if logging failed."""
        loop = EventLoop(self)
        self.get_logger().info(self._description())
        try:
            self._publish(self._robot.waiting_status())
            if self._settings['wait_for_commands']:
                self._wait_for_commander(loop, stop)
                self._robot.has_commander = True
            gc.collect()
            gc.freeze()
            self._robot.schedule.restart(time.monotonic())
            while not stop and not self._robot.runner.is_done:
                self._serve_until_due(loop, stop)
                self._beat_when_due()
        finally:
            self._close(stop)
            loop.close()
        if self._robot.runner.is_done and self._health.has_log_failed:
            raise NodeFailure(f'not all episodes are in {self._settings["episode_dir"]}')

    def _description(self) -> str:
        """Return a log line with the task, the pace, the namespace and the log folder."""
        values = self._settings
        pace = 'as fast as possible'
        if values['mode'] == 'lockstep':
            pace = 'in lockstep'
        elif values['real_time_factor']:
            pace = f'at {values["real_time_factor"]:g} x real time'
        return (
            f'{values["task"]}, {values["control_hz"]:g} ticks per simulated second, {pace}; '
            f'topics in {self.get_namespace()}; log: {values["episode_dir"] or "off"}; '
            + ('waits for commands' if values['wait_for_commands'] else 'no commands yet')
        )

    def _wait_for_commander(self, loop: EventLoop, stop: StopSignals) -> None:
        """Wait until a commander is connected, a service starts the episode or a signal arrives."""
        watch = self._watch
        while not (watch.inputs.commanders and watch.are_subscribers_connected()):
            if stop or self._robot.runner.has_started:
                return
            loop.wait(BEAT)
            watch.update()
            if self._robot.is_reset_due:
                self._robot.tick_when_due()
            self._beat_when_due()
        # The log names the policy, whose latched status comes a little after its publisher.
        end = time.monotonic() + _POLICY_STATUS_TIME
        while not stop and watch.has_policy_status() and not self._has_policy_status:
            if time.monotonic() > end:
                return
            loop.wait(BEAT)

    def _serve_until_due(self, loop: EventLoop, stop: StopSignals) -> None:
        """Run the tick if it is due; otherwise wait at most `BEAT` s for a callback and run it.

        Except in lockstep, callbacks that already wait run before the tick.
        """
        remaining = self._robot.wait()
        if remaining > 0.0:
            loop.wait(min(remaining, BEAT))
            return
        # In lockstep every command brings a tick of its own.
        if self._robot.schedule.mode != 'lockstep':
            loop.serve_pending(_SERVED_FIRST)
        # A callback may have paused the robot.
        if not stop and self._robot.wait() <= 0.0:
            self._robot.tick_when_due()
            self._ticked_at = time.monotonic()

    def _beat_when_due(self) -> None:
        """Publish `latest_tick` every `BEAT` seconds; check the ROS graph every second.

        Every second, also publish diagnostics. If a tick is due within 10 ms, the tick runs first.
        """
        now = time.monotonic()
        if now < self._beat_due or (
            self._robot.wait() < _BEAT_TIME and now < self._beat_due + BEAT
        ):
            return
        self._beat_due = now + BEAT
        self._latest_tick.publish_when_due()
        if now - self._ticked_at >= BEAT:
            self._stand_still(now)
        if now >= self._report_due:
            self._report_due = next_report(self._report_due, now)
            self._watch.update()
            self._clear_departed_policy()
            self._publish(self._health.messages(now))

    def _stand_still(self, now: float) -> None:
        """Repeat the last tick for new subscribers while no tick runs; log missing commands.

        While paused or before the first tick, also publish `/clock`. `now` is monotonic time, s.
        """
        robot, watch = self._robot, self._watch
        has_started = robot.runner.has_started
        if robot.schedule.is_paused or not has_started:
            self._publish([robot.clock_message()])
        is_waiting = robot.schedule.waits_for_commands and robot.misses_commands
        if robot.stands_still:
            watch.update()
            if watch.has_newcomer and watch.are_subscribers_connected():
                watch.has_newcomer = False
                self._publish(robot.last_messages)
                self._latest_tick.repeat()
        elif not has_started:
            is_waiting = now - self._ticked_at > WAITING_PERIOD
        if is_waiting:
            self._health.log_waiting()

    def _emit(self, tick: Tick, messages: Messages) -> None:
        if self._watch.has_newcomer and self._watch.are_subscribers_connected():
            self._watch.has_newcomer = False
        self._publish(messages)
        self._latest_tick.take(tick, messages)
        if tick.status.phase == 'reset':
            self._clear_departed_policy()
        if self._recorder is not None:
            self._recorder.record(tick, messages)
        if tick.status.phase == 'finished':
            self._report_episode(tick)

    def _report_episode(self, tick: Tick) -> None:
        if self._recorder is None or self._recorder.has_failed:
            self.get_logger().info(_episode_line(tick.status, tick.late_commands))
        if self._robot.runner.current.has_diverged:
            count = self._robot.runner.simulation.divergences
            self.get_logger().error(
                f'MuJoCo reports divergence; the episode ends early (so far {count} times)'
            )

    def _publish(self, messages: Messages) -> None:
        for spec, data in messages:
            publisher = self._outputs.get(spec.name)
            # None for `/clock` where another robot publishes it.
            if publisher is not None:
                publisher.publish(data)

    def _close(self, stop: StopSignals) -> None:
        if self._recorder is not None:
            error = sys.exception()
            reason = 'end of the run' if error is None else f'error: {type(error).__name__}'
            self._recorder.close(stop.received or reason, stop.watch())
        await_acknowledgements(self._outputs.values())

    # Callbacks

    def _on_logged(self, episode: LoggedEpisode) -> None:
        end = '' if episode.is_complete else ', cut short'
        line = _episode_line(episode.status, episode.late_commands)
        self.get_logger().info(f'{line}{end}, {episode.path}')

    def _warn(self, topic: str, line: str) -> None:
        # The logger's own throttle would let one topic silence the others.
        now = time.monotonic()
        if now >= self._warn_after.get(topic, 0.0):
            self._warn_after[topic] = now + _WARN_PERIOD
            self.get_logger().warning(f'{topic} dropped: {line}')

    def _on_commander(self, checkpoint_sha256: str | None) -> None:
        self._has_policy_status = True
        if self._recording_context is not None:
            self._recording_context.checkpoint_sha256 = checkpoint_sha256

    def _clear_departed_policy(self) -> None:
        """Remove the policy's checkpoint hash from the metadata to log once it has disconnected."""
        context = self._recording_context
        if (
            context is not None
            and context.checkpoint_sha256
            and not self._watch.has_policy_status()
        ):
            context.checkpoint_sha256 = None

    def _apply_changes(self, changes: list[Any]) -> None:
        for change in changes:
            self._settings[change.name] = change.value
            if change.name == 'real_time_factor':
                self._robot.set_real_time_factor(float(change.value))
            elif change.name == 'seed':
                self._robot.runner.set_next_seed(int(change.value))
                if not self._robot.runner.has_started:
                    # The latched status contains the seed of the first episode.
                    self._publish(self._robot.waiting_status())
            elif change.name == 'command_timeout':
                self._robot.buffer.timeout = float(change.value)
            elif change.name == 'answer_wait':
                self._robot.schedule.answer_wait = float(change.value) * _MILLISECOND
            elif change.name == 'disturbances':
                self._robot.runner.set_next_disturbances(read_disturbances(change.value))
                self._open_ground_truth()


def _episode_line(status: EpisodeStatus, late_commands: int | None) -> str:
    late = f', {late_commands} late commands' if late_commands else ''
    return (
        f'episode {status.episode} seed {status.seed}: {status.tick} steps, return '
        f'{status.episode_return:g}, {"success" if status.is_success else "failure"}{late}'
    )
