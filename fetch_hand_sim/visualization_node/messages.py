"""Make messages for standard tools: transforms, markers, numbers for plots, camera images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO

import mujoco
import numpy as np
import PIL.Image
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion, TransformStamped, Vector3
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame, Scene
from fetch_hand_sim.simulation.scene import Marker as Shape
from fetch_hand_sim.simulation.urdf import ROOT
from fetch_hand_sim.visualization_node.transforms import Transform
from fetch_hand_sim.watch.robot_watch import SeenTick
from msgs_spec.arrays import Array, Picture
from msgs_spec.codecs import TopicCodec
from msgs_spec.topics import scalar_topics
from node_runtime.diagnostics import Durations

_GEOM = mujoco.mjtGeom
_SHAPES = {
    _GEOM.mjGEOM_SPHERE.value: Marker.SPHERE,
    _GEOM.mjGEOM_ELLIPSOID.value: Marker.SPHERE,
    _GEOM.mjGEOM_BOX.value: Marker.CUBE,
    _GEOM.mjGEOM_CYLINDER.value: Marker.CYLINDER,
    # ROS has no capsule.
    _GEOM.mjGEOM_CAPSULE.value: Marker.CYLINDER,
}
# Shapes whose size is a radius and half a length.
_ROUND_RODS = (_GEOM.mjGEOM_CYLINDER.value, _GEOM.mjGEOM_CAPSULE.value)

_JPEG_QUALITY = 85
# As in `compressed_image_transport`: encodings of the raw and of the decoded picture.
_JPEG_FORMAT = 'rgb8; jpeg compressed bgr8'


def stamp(nanoseconds: int) -> Time:
    """Convert nanoseconds to a time message."""
    seconds, rest = divmod(nanoseconds, 10**9)
    return Time(sec=seconds, nanosec=rest)


def transform_messages(transforms: Iterable[Transform], stamp_ns: int) -> list[TransformStamped]:
    """Convert transforms to messages that all have the stamp `stamp_ns`."""
    time = stamp(stamp_ns)
    messages = []
    for each in transforms:
        message = TransformStamped(
            header=Header(stamp=time, frame_id=each.parent), child_frame_id=each.child
        )
        x, y, z = each.pose.position.tolist()
        message.transform.translation = Vector3(x=x, y=y, z=z)
        message.transform.rotation = _quaternion(each.pose.quaternion)
        messages.append(message)
    return messages


def marker_array(shapes: Mapping[str, Sequence[Shape]], stamp_ns: int) -> MarkerArray:
    """Convert shapes, by marker namespace, to markers in `world` that replace all earlier ones."""
    header = Header(stamp=stamp(stamp_ns), frame_id=ROOT)
    first = Marker(header=header, action=Marker.DELETEALL)
    markers = [first]
    drawn = [(ns, each) for ns, group in shapes.items() for each in group if each.shape in _SHAPES]
    for number, (ns, shape) in enumerate(drawn, start=1):
        marker = Marker(header=header, ns=ns, id=number, type=_SHAPES[shape.shape])
        x, y, z = shape.position.tolist()
        marker.pose.position = Point(x=x, y=y, z=z)
        marker.pose.orientation = _quaternion(shape.quaternion)
        marker.scale = _scale(shape)
        red, green, blue, opacity = map(float, shape.color)
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
        markers.append(marker)
    return MarkerArray(markers=markers)


def image_message(picture: Picture, frame_id: str, stamp_ns: int) -> Image:
    """Convert an RGB picture (height, width, 3) to an uncompressed image message."""
    height, width = picture.shape[:2]
    message = Image(
        header=Header(stamp=stamp(stamp_ns), frame_id=frame_id),
        height=height,
        width=width,
        encoding='rgb8',
        step=3 * width,
    )
    message.data.frombytes(np.ascontiguousarray(picture).tobytes())
    return message


def compressed_message(picture: Picture, frame_id: str, stamp_ns: int) -> CompressedImage:
    """Convert an RGB picture (height, width, 3) to a JPEG image message."""
    file = BytesIO()
    PIL.Image.fromarray(picture).save(file, 'JPEG', quality=_JPEG_QUALITY)
    message = CompressedImage(
        header=Header(stamp=stamp(stamp_ns), frame_id=frame_id), format=_JPEG_FORMAT
    )
    message.data.frombytes(file.getvalue())
    return message


def camera_info(width: int, height: int, fovy: float, frame_id: str, stamp_ns: int) -> CameraInfo:
    """Return the calibration message of a camera without distortion.

    Args:
        fovy: Vertical field of view, degrees.
        frame_id: Optical frame of the camera.
    """
    focal = height / 2.0 / np.tan(np.radians(fovy) / 2.0)
    x, y = width / 2.0, height / 2.0
    return CameraInfo(
        header=Header(stamp=stamp(stamp_ns), frame_id=frame_id),
        height=height,
        width=width,
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=[focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _quaternion(wxyz: Array) -> Quaternion:
    w, x, y, z = wxyz.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _scale(shape: Shape) -> Vector3:
    """Return the full side lengths of a shape, m; MuJoCo stores radii and half lengths."""
    size = shape.size
    if shape.shape in _ROUND_RODS:
        size = np.array([size[0], size[0], size[1]])
    x, y, z = (2.0 * size).tolist()
    return Vector3(x=x, y=y, z=z)


class Scalars:
    """Encodes the topics `scalars/*` of one task: distances to the goal, reward and success."""

    def __init__(self, metric: GoalMetric) -> None:
        self.metric = metric
        self._codecs = {source.name: TopicCodec(source) for source in scalar_topics(metric.spec)}

    def messages(self, tick: SeenTick) -> dict[str, bytes]:
        """Return CDR bytes by topic; at a reset, the topic of the reward is missing."""
        frame = tick.frame
        distance, rotation = self.metric.distances(frame.achieved_goal, frame.desired_goal)
        numbers = {
            'distance': float(distance),
            'rotation': float(rotation),
            'reward': tick.reward,
            'is_success': float(frame.is_success),
        }
        found = {}
        for name, codec in self._codecs.items():
            number = numbers[codec.topic.layout[0].name]
            if number is not None:
                found[name] = codec.encode(tick.stamp_ns, [number])
        return found


class Camera:
    """Draws `width` x `height` pictures, at most `hz` per second of `clock`; `hz` 0 draws none."""

    def __init__(self, width: int, height: int, hz: float, clock: Callable[[], float]) -> None:
        self.width, self.height = width, height
        self.pictures = 0
        self.picture_time = Durations()
        self._hz = hz
        self._period = 1.0 / hz if hz else np.inf
        self._clock = clock
        self._due = clock()
        self._renderer: SceneRenderer | None = None

    @property
    def is_due(self) -> bool:
        """True if a picture is due; False if the last one is too recent or `hz` is 0."""
        return np.isfinite(self._period) and self._clock() >= self._due

    def render(self, scene: Scene, frame: Frame) -> Picture:
        """Return a picture of `frame`, (height, width, 3); the first call opens OpenGL."""
        began = self._clock()
        self._due = max(self._due + self._period, began)
        if self._renderer is None:
            self._renderer = SceneRenderer(scene, self.width, self.height)
            # The time to open OpenGL is not that of a picture.
            began = self._clock()
        picture = self._renderer.render(frame)
        self.pictures += 1
        self.picture_time.add(self._clock() - began)
        return picture

    def problem(self) -> str:
        """Return a warning if the median time to draw a picture exceeds 1 / `hz`, else ''."""
        seconds = self.picture_time.median()
        if seconds <= self._period:
            return ''
        return (
            f'a picture takes {seconds:.2g} s, so that {1.0 / seconds:.2g} of the {self._hz:g} '
            'pictures per second are possible; reduce camera_width and camera_height, or use a GPU'
        )

    def close(self) -> None:
        """Free the OpenGL context; the camera opens it again at the next picture."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
