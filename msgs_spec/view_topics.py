"""Topics of `visualization_node`: what standard tools want of a robot. None of them is logged."""

from __future__ import annotations

from functools import lru_cache

from msgs_spec.tasks import TaskSpec, VectorPart
from msgs_spec.topics import LATCHED, WORLD, TopicSpec

# Robots that are remembered: whoever publishes chooses names of joints.
_ROBOTS = 256
# Before the scalars of a tick, so that tools group them.
_SCALARS = 'scalars/'

_FRAMES = 'tf2_msgs/msg/TFMessage'
_IMAGES = 'sensor_msgs/msg/'
SHOWN = (
    TopicSpec(
        'robot_description',
        'std_msgs/msg/String',
        'URDF, generated from the model.',
        qos=LATCHED,
    ),
    TopicSpec('/tf', _FRAMES, 'Links, object and goal; where `tf2_msgs` is installed.'),
    TopicSpec('/tf_static', _FRAMES, 'What never moves, the camera too.', qos=LATCHED),
    TopicSpec(
        'goal_markers',
        'visualization_msgs/msg/MarkerArray',
        'Goal, achieved goal, object, table; while somebody subscribes.',
        frame=WORLD,
    ),
    TopicSpec('camera/image_raw', f'{_IMAGES}Image', 'A picture; while somebody subscribes.'),
    TopicSpec(
        'camera/image_raw/compressed',
        f'{_IMAGES}CompressedImage',
        'The same as JPEG, where `image_transport` looks for it; while somebody subscribes.',
    ),
    TopicSpec('camera/camera_info', f'{_IMAGES}CameraInfo', 'Its calibration, of the same stamp.'),
)


def _scalar(name: str, unit: str, text: str) -> TopicSpec:
    """A number with a stamp, which no message of ROS has by itself: the x of a vector."""
    layout = (VectorPart(name, 1, unit),)
    return TopicSpec(f'{_SCALARS}{name}', 'geometry_msgs/msg/Vector3Stamped', text, layout)


@lru_cache(maxsize=_ROBOTS)
def scalar_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Returns the numbers of a tick that are worth a plot, stamped with it."""
    found = []
    if task.position_counts:
        found.append(_scalar('distance', 'm', 'From the achieved to the desired position.'))
    if task.rotation_threshold is not None:
        found.append(
            _scalar(
                'rotation',
                'rad',
                'From the achieved to the desired rotation, by the success rule: up to 2 pi by '
                '`gymnasium`.',
            )
        )
    return (
        *found,
        _scalar('reward', '', 'As `reward`; from the first step of an episode on.'),
        _scalar('is_success', '', 'As `is_success`, 0 or 1.'),
    )


@lru_cache(maxsize=_ROBOTS)
def view_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Returns all topics of the node, for a robot that does a task."""
    return (*SHOWN, *scalar_topics(task))


def view_topic(task: TaskSpec, name: str) -> TopicSpec:
    """Returns a topic by name.

    Raises:
        ValueError: If the node has no such topic for the task; the message lists those it has.
    """
    found = {spec.name: spec for spec in view_topics(task)}
    if name not in found:
        raise ValueError(f'{task.name} has no topic {name!r} to view; allowed: {", ".join(found)}')
    return found[name]
