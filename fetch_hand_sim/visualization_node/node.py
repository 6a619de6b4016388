"""The ROS node that follows a robot and publishes its state for standard tools."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.visualization_node import NODE_NAME
from fetch_hand_sim.visualization_node.messages import (
    Camera,
    Scalars,
    camera_info,
    compressed_message,
    image_message,
    marker_array,
    transform_messages,
)
from fetch_hand_sim.visualization_node.transforms import (
    Transform,
    Transforms,
    frame_prefix,
    view_transform,
)
from fetch_hand_sim.watch.robot_watch import RobotWatch, SeenTick, spec_of
from msgs_spec.arrays import Picture
from msgs_spec.parameters import VISUALIZATION_NODE
from msgs_spec.tasks import TaskSpec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, SHOWN, TopicSpec, scalar_topics
from node_runtime.diagnostics import REPORT_PERIOD, Increase, Report, encode_reports, next_report
from node_runtime.event_loop import BEAT, EventLoop
from node_runtime.node_main import NodeFailure, StopSignals
from node_runtime.ros import (
    SubscriberWatch,
    count_publishers,
    open_publisher,
    seldom,
)
from node_runtime.ros_parameters import declare_parameters

_CAMERA_FRAME = 'camera'
_PICTURES: dict[str, Callable[[Picture, str, int], Any]] = {
    'camera/image_raw': image_message,
    'camera/image_raw/compressed': compressed_message,
}
# Seconds without a tick after which a robot counts as standing still.
_STILL = 0.5
# Callbacks before each picture, which takes as long as several ticks.
_SERVED_FIRST = 200


class VisualizationNode(Node):
    """Publishes the topics `msgs_spec.topics.view_topics` for the robot in its namespace."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME, start_parameter_services=False)
        settings = declare_parameters(self, VISUALIZATION_NODE)
        self._robot: tuple[str, str] | None = None
        self._scene: Scene | None = None
        self._transforms: Transforms | None = None
        self._scalars: Scalars | None = None
        self._latest: SeenTick | None = None
        # The same tick until it is sent as markers and as a picture.
        self._unmarked: SeenTick | None = None
        self._undrawn: SeenTick | None = None
        self._ticked_at = 0.0
        self._prefix = frame_prefix(self.get_namespace())
        self._outputs: dict[str, Any] = {}
        for source in SHOWN:
            self._open(source)
        self._diagnostics = open_publisher(self, DIAGNOSTICS)
        self._listeners = SubscriberWatch(self, self._outputs.values())
        self._has_newcomer = False
        self._report_due = time.monotonic() + REPORT_PERIOD
        self._drawn = Increase()
        self._camera = Camera(
            settings['camera_width'],
            settings['camera_height'],
            settings['camera_hz'],
            time.monotonic,
        )
        self._watch = RobotWatch(self, self._on_status, self._on_tick)
        status_name = self.resolve_topic_name('episode_status')
        self.get_logger().info(f'waiting for a robot on {status_name}')

    def run(self, stop: StopSignals) -> None:
        """Follow the robot until a signal arrives."""
        loop = EventLoop(self)
        try:
            while not stop:
                loop.wait(BEAT)
                loop.serve_pending(_SERVED_FIRST)
                self._show_latest()
                self._repeat_for_newcomers()
                self._report_when_due()
        finally:
            self._camera.close()
            loop.close()

    def _open(self, source: TopicSpec) -> None:
        """Open a publisher for `source`; only warn if its message package is not installed."""
        try:
            self._outputs[source.name] = open_publisher(self, source)
        except ImportError:
            package = source.type_name.partition('/')[0]
            self.get_logger().warning(
                f'{package} is not installed: no {source.name}; a sourced ROS has it'
            )

    def _has_listener(self, name: str) -> bool:
        return bool(self._outputs[name].get_subscription_count())

    def _wanted_pictures(self) -> list[str]:
        return [name for name in _PICTURES if self._has_listener(name)]

    def _on_status(self, status: EpisodeStatus) -> None:
        spec = spec_of(status)
        # The URDF contains the names of the joints.
        robot = status.task, status.joint_prefix
        if robot != self._robot:
            self._robot = robot
            self._begin(spec, status.joint_prefix)
        metric = GoalMetric(spec, success_rule=status.success_rule)
        if self._scalars is None or self._scalars.metric != metric:
            self._scalars = Scalars(metric)

    def _begin(self, spec: TaskSpec, joint_prefix: str) -> None:
        """Begin to follow the robot of a task; publish its URDF and fixed transforms."""
        self._camera.close()
        self._latest = self._unmarked = self._undrawn = self._scalars = None
        try:
            self._scene = Scene(spec.name)
            self._transforms = Transforms(spec.name, self._prefix)
        except ValueError as error:
            # The task is installed without its simulation.
            raise NodeFailure(str(error)) from None
        for source in scalar_topics(spec):
            if source.name not in self._outputs:
                self._open(source)
        self._listeners = SubscriberWatch(self, self._outputs.values())
        urdf = self._transforms.description.to_xml(self._prefix, joint_prefix)
        description = self._outputs['robot_description']
        description.publish(description.msg_type(data=urdf))
        camera = view_transform(self._scene.view, self._prefix + _CAMERA_FRAME)
        self._send_transforms('/tf_static', [*self._transforms.fixed(), camera], 0)
        shown = ', '.join(sorted(self._outputs))
        self.get_logger().info(f'{spec.name}: publishes {shown}')

    def _on_tick(self, tick: SeenTick) -> None:
        if self._transforms is None or self._scalars is None:
            return
        if '/tf' in self._outputs:
            self._send_transforms('/tf', self._transforms.moving(tick.frame), tick.stamp_ns)
        for name, data in self._scalars.messages(tick).items():
            self._outputs[name].publish(data)
        self._latest = self._unmarked = self._undrawn = tick
        self._ticked_at = time.monotonic()

    def _send_transforms(self, name: str, transforms: list[Transform], stamp_ns: int) -> None:
        output = self._outputs.get(name)
        if output is not None:
            output.publish(output.msg_type(transforms=transform_messages(transforms, stamp_ns)))

    def _show_latest(self) -> None:
        """Publish markers and, if due, a picture of the newest tick to subscribers."""
        scene = self._scene
        if scene is None:
            return
        tick, self._unmarked = self._unmarked, None
        if tick is not None and self._has_listener('goal_markers'):
            shapes = {
                'goal': scene.markers(tick.frame),
                'object': scene.object_markers(tick.frame),
                'table': scene.table_markers,
            }
            markers = marker_array(shapes, tick.stamp_ns)
            self._outputs['goal_markers'].publish(markers)
        tick = self._undrawn
        if tick is None or not self._camera.is_due:
            return
        self._undrawn = None
        if wanted := self._wanted_pictures():
            self._take_photo(scene, tick, wanted)

    def _repeat_for_newcomers(self) -> None:
        """Repeat the last tick for new subscribers while the robot stands still."""
        if self._latest is None or time.monotonic() - self._ticked_at < _STILL:
            return
        self._has_newcomer |= self._listeners.update()
        if self._has_newcomer and self._listeners.are_connected():
            self._has_newcomer = False
            # A robot that has terminated is not repeated.
            if count_publishers(self, 'joint_states'):
                self._on_tick(self._latest)

    def _report_when_due(self) -> None:
        """Publish diagnostics of the camera once a second."""
        now = time.monotonic()
        if now < self._report_due:
            return
        self._report_due = next_report(self._report_due, now)
        camera, task = self._camera, self._robot[0] if self._robot else 'no robot yet'
        values = {
            'pictures per second': f'{self._drawn.since(camera.pictures) / REPORT_PERIOD:g}',
            **{f'picture time {k} (ms)': v for k, v in camera.picture_time.milliseconds().items()},
        }
        report = Report(self.get_fully_qualified_name(), task, values, f'shows {task}')
        if self._wanted_pictures() and (problem := camera.problem()):
            report.warn(problem)
            self.get_logger().warning(problem, **seldom(60.0))
        self._diagnostics.publish(encode_reports(report))

    def _take_photo(self, scene: Scene, tick: SeenTick, wanted: list[str]) -> None:
        try:
            picture = self._camera.render(scene, tick.frame)
        except RuntimeError as error:
            self.get_logger().error(str(error), **seldom(10.0))
            return
        frame_id = self._prefix + _CAMERA_FRAME
        camera, fovy = self._camera, float(scene.model.vis.global_.fovy)
        info = camera_info(camera.width, camera.height, fovy, frame_id, tick.stamp_ns)
        for name in wanted:
            message = _PICTURES[name](picture, frame_id, tick.stamp_ns)
            self._outputs[name].publish(message)
        self._outputs['camera/camera_info'].publish(info)
