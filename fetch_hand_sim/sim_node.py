"""`sim_node`: one simulated robot on the network.

A thin shell: `EpisodeRunner` makes ticks, `CommandBuffer` says what they apply, `RealTimePacer`
when they are due, `EpisodeRecorder` logs them. One thread does everything but completing files,
because a tick takes 2 ms of 40.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger

from fetch_hand_sim.command_buffer import CommandBuffer, CommandRejected
from fetch_hand_sim.episode_log import find_leftovers
from fetch_hand_sim.episode_recorder import EpisodeRecorder, LoggedEpisode
from fetch_hand_sim.episode_runner import EpisodeRunner
from fetch_hand_sim.pacing import RealTimePacer
from fetch_hand_sim.recording_context import RecordingContext
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import decode, decode_status
from msgs_spec.parameters import SIM_NODE, set_callback
from msgs_spec.qos import rclpy_profile
from msgs_spec.ros import (
    StopSignals,
    UsageError,
    declare_parameters,
    ros_message_class,
    run_node,
)
from msgs_spec.schemas import from_ros, serialize
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import TopicSpec, topics

NODE_NAME = 'sim_node'
# Seconds between looks at the stop flag while nothing arrives.
_SPIN = 0.1
_WARN_PERIOD = 1.0
_LAST_WORDS_TIMEOUT = 1.0


class SimNode(Node):
    """Publishes the state of one robot at every tick and applies the commands it receives."""

    def __init__(self) -> None:
        """Compiles the model and opens all topics and services.

        Raises:
            UsageError: If a parameter is not allowed.
        """
        super().__init__(NODE_NAME)
        self._settings = declare_parameters(self, SIM_NODE)
        self._runner = self._make_runner()
        spec = self._runner.spec
        self._encoder = TickEncoder(spec)
        self._buffer = CommandBuffer(spec.robot, self._settings['command_timeout'])
        self._pacer = RealTimePacer(
            self._runner.simulation.tick_duration,
            self._settings['real_time_factor'],
            time.monotonic(),
        )
        self._publishers_by_topic = self._open_topics()
        self._open_services()
        self._recording_context: RecordingContext | None = None
        self._recorder = self._make_recorder()
        self._is_paused = False
        self._steps_while_paused = 0
        self.add_on_set_parameters_callback(set_callback(SIM_NODE))
        self.add_post_set_parameters_callback(self._apply_changes)

    # Set-up

    def _make_runner(self) -> EpisodeRunner:
        values = self._settings
        try:
            simulation = Simulation(
                values['task'],
                num_envs=1,
                num_threads=1,
                reward_type=values['reward_type'],
                success_rule=values['success_rule'],
                control_hz=values['control_hz'],
            )
        except ValueError as error:
            raise UsageError(str(error)) from None
        return EpisodeRunner(simulation, first_seed=values['seed'], episodes=values['episodes'])

    def _open_topics(self) -> dict[str, Publisher]:
        publishers = {}
        for spec in topics(self._runner.spec):
            message_class = ros_message_class(spec.type_name)
            profile = rclpy_profile(spec.qos)
            if spec.direction == 'published':
                publishers[spec.name] = self.create_publisher(message_class, spec.name, profile)
            else:
                self.create_subscription(message_class, spec.name, self._receiver(spec), profile)
        return publishers

    def _open_services(self) -> None:
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)

    def _make_recorder(self) -> EpisodeRecorder | None:
        directory = self._settings['episode_dir']
        if not directory:
            return None
        self._recording_context = context = RecordingContext(
            self._runner.simulation,
            with_compiled_model=self._settings['log_compiled_model'],
        )
        for leftover in find_leftovers(Path(directory)):
            self.get_logger().warning(str(leftover))
        return EpisodeRecorder(
            Path(directory),
            namespace=self.get_namespace(),
            attachments=context.attachments,
            metadata=context.metadata,
            on_error=lambda line: self.get_logger().error(line),
            on_logged=self._on_logged,
        )

    # Running

    def run(self, stop: StopSignals) -> None:
        """Runs episodes until all are done or the signals say stop."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            self._wait_for_commander(executor, stop)
            gc.collect()
            gc.freeze()
            self._pacer.restart(time.monotonic())
            while not stop and not self._runner.is_done:
                if self._wait_for_tick(executor, stop):
                    self._tick()
        finally:
            self._close(stop)
            executor.remove_node(self)

    def _wait_for_commander(self, executor: SingleThreadedExecutor, stop: StopSignals) -> None:
        """Announces the robot; with `wait_for_commands`, lets nothing move until one may answer."""
        names = [s.name for s in topics(self._runner.spec) if s.name.endswith('commands')]
        self._announce()
        while (
            self._settings['wait_for_commands']
            and not stop
            and not any(self.count_publishers(name) for name in names)
        ):
            executor.spin_once(timeout_sec=_SPIN)
            self._publish_clock()

    def _announce(self) -> None:
        """Says which robot this is before its first episode, for policies to choose an actor."""
        stamp_ns = self._runner.stamp_ns
        self._publish_clock()
        status_topic, data = self._encoder.encode_status(stamp_ns, self._runner.waiting_status())
        self._publishers_by_topic[status_topic.name].publish(data)

    def _publish_clock(self) -> None:
        clock, data = self._encoder.encode_clock(self._runner.stamp_ns)
        self._publishers_by_topic[clock.name].publish(data)

    def _wait_for_tick(self, executor: SingleThreadedExecutor, stop: StopSignals) -> bool:
        """Serves callbacks until the next tick is due; False when there is to be none."""
        if self._is_paused:
            return self._wait_while_paused(executor)
        if self._settings['mode'] == 'lockstep':
            return self._wait_for_command(executor, stop)
        served = False
        while not stop and not self._is_paused:
            remaining = self._pacer.remaining(time.monotonic())
            if remaining <= 0.0 and served:
                self._pacer.advance(time.monotonic())
                return True
            executor.spin_once(timeout_sec=max(0.0, min(remaining, _SPIN)))
            served = True
        return False

    def _wait_for_command(self, executor: SingleThreadedExecutor, stop: StopSignals) -> bool:
        """Lockstep: a tick per valid command; the first reset needs none."""
        while not stop and not self._is_paused:
            if self._buffer.has_fresh_command or not self._runner.has_started:
                return True
            executor.spin_once(timeout_sec=_SPIN)
        return False

    def _wait_while_paused(self, executor: SingleThreadedExecutor) -> bool:
        executor.spin_once(timeout_sec=_SPIN)
        self._publish_clock()
        if self._steps_while_paused:
            self._steps_while_paused -= 1
            return True
        return False

    def _tick(self) -> None:
        """Applies the latest command, advances, publishes and logs."""
        command = self._buffer.take(time.monotonic())
        tick = self._runner.advance(command.values)
        messages = self._encoder.encode(tick, latched=tick.status.phase != 'running')
        for spec, data in messages:
            self._publishers_by_topic[spec.name].publish(data)
        if self._recorder is not None:
            self._recorder.record(tick, messages)
        if tick.status.phase == 'reset':
            self._buffer.start_episode(self._runner.resting_command())
        elif tick.status.phase == 'finished':
            self._report_end(self._runner.has_diverged)

    def _report_end(self, has_diverged: bool) -> None:
        if has_diverged:
            self.get_logger().error(
                f'MuJoCo reports divergence; the episode ends early (so far '
                f'{self._runner.simulation.divergences} times)'
            )

    def _close(self, stop: StopSignals) -> None:
        if self._recorder is not None:
            self._recorder.close(stop.received or 'end of the run')
        for publisher in self._publishers_by_topic.values():
            publisher.wait_for_all_acked(_duration(_LAST_WORDS_TIMEOUT))

    def _on_logged(self, episode: LoggedEpisode) -> None:
        status = episode.status
        outcome = 'success' if status.is_success else 'failure'
        self.get_logger().info(
            f'episode {status.episode} seed {status.seed}: {status.tick} steps, return '
            f'{status.episode_return:g}, {outcome if episode.is_complete else "cut short"}, '
            f'{episode.path}'
        )

    # Receiving

    def _receiver(self, spec: TopicSpec) -> Callable[[Any], None]:
        handlers: dict[str, Callable[[TopicSpec, Any], None]] = {
            'commands': self._on_command,
            'joint_commands': self._on_joint_command,
            'set_goal': self._on_goal,
            'policy_status': self._on_policy_status,
        }
        handler = handlers[spec.name]

        def on_message(message: Any) -> None:
            if self._recorder is not None:
                data = serialize(spec.type_name, from_ros(message))
                self._recorder.record_received(spec, data)
            handler(spec, message)

        return on_message

    def _on_command(self, spec: TopicSpec, message: Any) -> None:
        del spec
        self._accept(lambda now: self._buffer.accept(message.data, now))

    def _on_joint_command(self, spec: TopicSpec, message: Any) -> None:
        del spec
        self._accept(lambda now: self._buffer.accept_named(message.name, message.position, now))

    def _accept(self, accept: Callable[[float], None]) -> None:
        try:
            accept(time.monotonic())
        except CommandRejected as error:
            self.get_logger().warning(str(error), throttle_duration_sec=_WARN_PERIOD)

    def _on_goal(self, spec: TopicSpec, message: Any) -> None:
        try:
            if self._runner.is_between_episodes:
                raise ValueError('no episode is running')
            self._runner.set_goal(decode(spec, message))
        except ValueError as error:
            self.get_logger().warning(f'goal dropped: {error}', throttle_duration_sec=_WARN_PERIOD)

    def _on_policy_status(self, spec: TopicSpec, message: Any) -> None:
        del spec
        if self._recording_context is not None:
            sha256 = decode_status(message).get('checkpoint_sha256')
            self._recording_context.checkpoint_sha256 = sha256 or None

    # Services and parameters

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        if self._runner.is_between_episodes:
            response.message = f'episode {self._runner.episode} is about to start anyway'
        else:
            response.message = f'episode {self._runner.episode} ends; the next tick starts another'
            self._runner.end_episode()
        response.success = True
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data == self._is_paused:
            response.message = 'already paused' if self._is_paused else 'already running'
        else:
            response.message = 'paused' if request.data else 'running'
        self._is_paused = request.data
        self._pacer.restart(time.monotonic())
        response.success = True
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        response.success = self._is_paused
        if self._is_paused:
            self._steps_while_paused += 1
            response.message = 'one tick follows'
        else:
            response.message = 'a running simulation cannot be stepped; pause it first'
        return response

    def _apply_changes(self, changes: list[Any]) -> None:
        for change in changes:
            self._settings[change.name] = change.value
            if change.name == 'real_time_factor':
                self._pacer.real_time_factor = change.value
                self._pacer.restart(time.monotonic())
            elif change.name == 'command_timeout':
                self._buffer.timeout = change.value


def _duration(seconds: float) -> Any:
    from rclpy.duration import Duration

    return Duration(seconds=seconds)


def main(args: list[str] | None = None) -> int:
    """Runs `sim_node`; returns the exit code."""

    def run(stop: StopSignals) -> None:
        node = SimNode()
        try:
            node.run(stop)
        finally:
            node.destroy_node()

    return run_node(NODE_NAME, run, args)


if __name__ == '__main__':
    sys.exit(main())
