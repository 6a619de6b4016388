"""The ROS node: follows a robot and says the same for standard tools."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from fetch_hand_sim.simulation.scene import Frame, Scene
from fetch_hand_sim.view.live import LiveRobot
from fetch_hand_sim.view.messages import Picture
from fetch_hand_sim.visualization_node import NODE_NAME
from fetch_hand_sim.visualization_node.camera import Camera
from fetch_hand_sim.visualization_node.messages import (
    camera_info,
    image_message,
    marker_array,
    transform_messages,
)
from fetch_hand_sim.visualization_node.transforms import Transforms, frame_prefix, view_transform
from msgs_spec.parameters import VISUALIZATION_NODE
from msgs_spec.ros import (
    BEAT,
    EventLoop,
    StopSignals,
    declare_parameters,
    rclpy_profile,
)
from msgs_spec.topics import LATCHED, STATE

_CAMERA_FRAME = 'camera'


class VisualizationNode(Node):
    """Publishes `robot_description`, `/tf`, `/tf_static`, `goal_markers` and `camera/*`."""

    def __init__(self) -> None:
        """Opens its topics and listens for a robot.

        Raises:
            UsageError: If a parameter is not allowed.
        """
        super().__init__(NODE_NAME)
        settings = declare_parameters(self, VISUALIZATION_NODE)
        self._robot = LiveRobot(self, may_command=False)
        self._scene: Scene | None = None
        self._transforms: Transforms | None = None
        self._shown = -1
        self._prefix = frame_prefix(self.get_namespace())
        latched, state = rclpy_profile(LATCHED), rclpy_profile(STATE)
        self._description = self.create_publisher(String, 'robot_description', latched)
        self._markers = self.create_publisher(MarkerArray, 'goal_markers', state)
        self._image = self.create_publisher(Image, 'camera/image_raw', state)
        self._camera_info = self.create_publisher(CameraInfo, 'camera/camera_info', state)
        self._camera = Camera(
            settings['camera_width'],
            settings['camera_height'],
            settings['camera_hz'],
            time.monotonic,
        )
        self._tf, self._tf_static = self._open_transforms()

    def run(self, stop: StopSignals) -> None:
        """Serves until told to stop."""
        loop = EventLoop(self)
        try:
            while not stop:
                loop.wait(BEAT)
                picture = self._robot.picture()
                if picture is not None:
                    self._take(picture)
        finally:
            self._camera.close()
            loop.close()

    def _open_transforms(self) -> tuple[Any, Any]:
        """Publishers of transforms; None where tf2_msgs is missing, as it is on PyPI."""
        try:
            message = import_module('tf2_msgs.msg').TFMessage
        except ImportError:
            self.get_logger().warning('tf2_msgs is not installed: no /tf; a sourced ROS has it')
            return None, None
        return (
            self.create_publisher(message, '/tf', rclpy_profile(STATE)),
            self.create_publisher(message, '/tf_static', rclpy_profile(LATCHED)),
        )

    def _take(self, picture: Picture) -> None:
        if self._scene is None or self._scene.spec.name != picture.task:
            self._begin(picture.task)
        # A picture may also tell something new about the same tick.
        if picture.frame is not None and picture.stamp_ns != self._shown:
            self._shown = picture.stamp_ns
            self._show(picture.frame, picture.stamp_ns)

    def _begin(self, task: str) -> None:
        self._camera.close()
        self._scene = Scene(task)
        self._transforms = Transforms(task, self._prefix)
        urdf = self._transforms.description.to_xml(self._prefix, self._robot.joint_prefix)
        self._description.publish(String(data=urdf))
        if self._tf_static is not None:
            camera = view_transform(self._scene.view, self._prefix + _CAMERA_FRAME)
            messages = transform_messages([*self._transforms.fixed(), camera], 0)
            self._tf_static.publish(self._tf_static.msg_type(transforms=messages))

    def _show(self, frame: Frame, stamp_ns: int) -> None:
        assert self._scene is not None and self._transforms is not None
        if self._tf is not None:
            messages = transform_messages(self._transforms.moving(frame), stamp_ns)
            self._tf.publish(self._tf.msg_type(transforms=messages))
        if self._markers.get_subscription_count():
            self._markers.publish(marker_array(self._scene.markers(frame), stamp_ns))
        if self._image.get_subscription_count() and self._camera.is_due:
            self._take_photo(self._scene, frame, stamp_ns)

    def _take_photo(self, scene: Scene, frame: Frame, stamp_ns: int) -> None:
        try:
            picture = self._camera.render(scene, frame)
        except RuntimeError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        name = self._prefix + _CAMERA_FRAME
        camera, fovy = self._camera, float(scene.model.vis.global_.fovy)
        self._image.publish(image_message(picture, name, stamp_ns))
        self._camera_info.publish(camera_info(camera.width, camera.height, fovy, name, stamp_ns))
