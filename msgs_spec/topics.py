"""Topics and services as data: names, types, quality of service, units, frames and order."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal

from msgs_spec.robots import FINGERTIPS
from msgs_spec.tasks import GoalKind, TaskSpec, VectorPart
from msgs_spec.text import one_of


@dataclass(frozen=True, slots=True)
class QosSpec:
    """Quality of service; if `transient_local`, late subscribers get the last `depth` messages."""

    depth: int
    reliability: Literal['reliable', 'best_effort']
    durability: Literal['volatile', 'transient_local']


# All publishers are reliable, because reliable subscribers receive nothing from best-effort ones.
STATE = QosSpec(depth=10, reliability='reliable', durability='volatile')
LATCHED = QosSpec(depth=1, reliability='reliable', durability='transient_local')
# Named joint commands add up, and rejected ones are counted, so none may be overwritten.
COMMAND = QosSpec(depth=10, reliability='reliable', durability='volatile')
CLOCK = QosSpec(depth=1, reliability='reliable', durability='volatile')


# Meaning of the messages of an episode. In version 1, which recorded no number, a robot ignored
# frame and stamp of a goal, and the orientations of `fingertip_poses` were identity.
INTERFACE_VERSION = 2
WORLD = 'world'
# A namespace without the slashes around it, or the name of a node.
NAMESPACE = re.compile(r'(?:[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*)?', re.ASCII)

_POSITION = VectorPart('position', 3, 'm')
_QUATERNION = VectorPart('orientation', 4, 'quaternion')
_POSE = (_POSITION, _QUATERNION)
_TWIST = (VectorPart('linear', 3, 'm/s'), VectorPart('angular', 3, 'rad/s'))
_WRENCH = (VectorPart('force', 3, 'N'), VectorPart('torque', 3, 'N m'))
_FREE_JOINT = (
    *_POSE,
    VectorPart('linear', 3, 'm/s'),
    VectorPart('angular, object frame', 3, 'rad/s'),
)
_FINGERTIPS = tuple(VectorPart(name, 3, 'm') for name in FINGERTIPS)
_FINGERTIP_POSES = tuple(VectorPart(name, 7, 'm, quaternion') for name in FINGERTIPS)

_GOAL_TYPES = {
    GoalKind.POINT: ('geometry_msgs/msg/PointStamped', (_POSITION,)),
    GoalKind.FINGERTIPS: ('geometry_msgs/msg/PoseArray', _FINGERTIPS),
    GoalKind.POSE: ('geometry_msgs/msg/PoseStamped', _POSE),
}


@dataclass(frozen=True, slots=True)
class TopicSpec:
    """One topic.

    Attributes:
        name: Name relative to the namespace of the node; `/clock` is absolute.
        layout: Parts of the float64 vector that the message is converted to; () if it has none.
            Quaternions are wxyz in the vector and xyzw in the message.
        frame: `header.frame_id` of the message; empty if it has none.
        names: Joint names in the message; empty for types without joints.
        direction: `subscribed` if `sim_node` subscribes to the topic, else `published`.
        since: First `INTERFACE_VERSION` whose episode files contain the topic.
    """

    name: str
    type_name: str
    description: str
    layout: tuple[VectorPart, ...] = ()
    frame: str = ''
    names: tuple[str, ...] = ()
    qos: QosSpec = STATE
    direction: Literal['published', 'subscribed'] = 'published'
    since: int = 1

    @property
    def size(self) -> int:
        """Length of the float64 vector."""
        return sum(part.size for part in self.layout)

    @property
    def unit(self) -> str:
        """The units of the parts without repetitions, such as `m, quaternion`."""
        return ', '.join(dict.fromkeys(part.unit for part in self.layout if part.unit))


_subscribed = partial(TopicSpec, direction='subscribed', qos=COMMAND)


def _command_layout(task: TaskSpec) -> tuple[VectorPart, ...]:
    return tuple(VectorPart(part.name, 1, part.unit) for part in task.robot.command)


def _joint_topic(task: TaskSpec) -> TopicSpec:
    joints = task.robot.joints
    units = ('rad', 'rad/s', 'N m')
    if 'm' in task.robot.joint_units:
        units = ('rad or m', 'rad/s or m/s', 'N m or N')
    return TopicSpec(
        'joint_states',
        'sensor_msgs/msg/JointState',
        'All scalar joints of the robot.',
        (
            VectorPart('position', len(joints), units[0]),
            VectorPart('velocity', len(joints), units[1]),
            VectorPart('effort', len(joints), units[2]),
        ),
        names=joints,
    )


def _body_topics(task: TaskSpec) -> list[TopicSpec]:
    """Return the topics of the end effector (Fetch) or fingertips (hand), then of the object."""
    pose, twist = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
    if task.robot.has_gripper_command:
        specs = [
            TopicSpec('end_effector_pose', pose, 'Site between the fingers.', _POSE, frame=WORLD),
            TopicSpec(
                'end_effector_twist',
                twist,
                'Velocity of the site between the fingers.',
                _TWIST,
                frame=WORLD,
            ),
        ]
    else:
        text = 'Sites at the fingertips, oriented as the distal segments.'
        array = 'geometry_msgs/msg/PoseArray'
        specs = [TopicSpec('fingertip_poses', array, text, _FINGERTIP_POSES, frame=WORLD)]
    if task.has_object:
        specs += [
            TopicSpec('object_pose', pose, 'Centre of the object.', _POSE, frame=WORLD),
            TopicSpec('object_twist', twist, 'The same, in world axes.', _TWIST, frame=WORLD),
        ]
    if task.has_object and 'object_joint' in task.observed_topics:
        joint = f'{task.object_name}:joint'
        text = 'Free joint of the object as MuJoCo holds it: angular velocity in the object frame.'
        dof = 'sensor_msgs/msg/MultiDOFJointState'
        specs.append(TopicSpec('object_joint', dof, text, _FREE_JOINT, frame=WORLD, names=(joint,)))
    return specs


def _goal_topics(task: TaskSpec) -> list[TopicSpec]:
    type_name, layout = _GOAL_TYPES[task.goal]
    desired, achieved = 'Goal of the episode.', 'Present value that the goal is compared with.'
    return [
        TopicSpec('desired_goal', type_name, desired, layout, frame=WORLD, qos=LATCHED),
        TopicSpec('achieved_goal', type_name, achieved, layout, frame=WORLD),
    ]


def _result_topics(task: TaskSpec) -> list[TopicSpec]:
    number, array = 'std_msgs/msg/Float64', 'std_msgs/msg/Float64MultiArray'
    return [
        TopicSpec('reward', number, 'Reward of the tick.', (VectorPart('reward', 1, ''),)),
        TopicSpec(
            'is_success',
            'std_msgs/msg/Bool',
            'True if the goal is reached now.',
            (VectorPart('is_success', 1, ''),),
        ),
        TopicSpec(
            'applied_command',
            array,
            'The command this tick applied, after clipping.',
            _command_layout(task),
        ),
        TopicSpec(
            'episode_status',
            'diagnostic_msgs/msg/DiagnosticArray',
            'Task, episode, seed, tick, phase and settings as key/value pairs.',
            qos=LATCHED,
        ),
    ]


def _command_topics(task: TaskSpec) -> list[TopicSpec]:
    array = 'std_msgs/msg/Float64MultiArray'
    layout = _command_layout(task)
    specs = [_subscribed('commands', array, 'Command, all values in order.', layout)]
    if not task.robot.has_gripper_command:
        names = tuple(part.name for part in task.robot.command)
        specs.append(
            _subscribed(
                'joint_commands',
                'sensor_msgs/msg/JointState',
                'Joint positions by name, any order and subset; the rest holds.',
                (VectorPart('position', len(names), 'rad'),),
                names=names,
            )
        )
    type_name, goal_layout = _GOAL_TYPES[task.goal]
    text = 'Replaces the goal of the running episode from the next tick on.'
    specs.append(_subscribed('set_goal', type_name, text, goal_layout, frame=WORLD))
    wrench = 'geometry_msgs/msg/WrenchStamped'
    text = (
        'Pushes the body `frame_id` during the next tick, up to `perturb_limit`, in world axes at '
        'its centre of mass.'
    )
    specs.append(_subscribed('perturb', wrench, text, _WRENCH))
    text = 'Checkpoint of the policy and its SHA-256 as key/value pairs, for the log.'
    status = 'diagnostic_msgs/msg/DiagnosticArray'
    specs.append(_subscribed('policy_status', status, text, (), qos=LATCHED))
    return specs


# Published once per second of wall time, not at every tick, and never logged.
DIAGNOSTICS = TopicSpec(
    '/diagnostics',
    'diagnostic_msgs/msg/DiagnosticArray',
    'Health of the nodes, 1 Hz wall time; not logged.',
)
REAL_TIME_FACTOR = TopicSpec(
    'real_time_factor',
    'std_msgs/msg/Float64',
    'Achieved in the last second, 1 Hz wall time; not logged.',
    (VectorPart('real_time_factor', 1, ''),),
)
LATEST_TICKS_PER_SECOND = 30
LATEST_TICK = TopicSpec(
    'latest_tick',
    'std_msgs/msg/UInt8MultiArray',
    'All messages of the latest tick, for viewers; at most '
    f'{LATEST_TICKS_PER_SECOND} Hz wall time while subscribed; not logged.',
)
MONITORING = (DIAGNOSTICS, REAL_TIME_FACTOR, LATEST_TICK)


def sensor_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Return the topics of the sensors, from which observations are computed."""
    return (_joint_topic(task), *_body_topics(task))


# Namespace of the sensor readings without disturbances.
GROUND_TRUTH = 'ground_truth'


def ground_truth_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Return the `ground_truth/` topics, the undisturbed sensor values of a disturbed robot."""
    return tuple(
        replace(
            spec,
            name=f'{GROUND_TRUTH}/{spec.name}',
            description=f'`{spec.name}` without disturbances; only from a disturbed robot.',
        )
        for spec in sensor_topics(task)
    )


def relative_name(resolved: str) -> str:
    """Return the name of a topic without the namespace of its robot: `/left/reward` -> `reward`."""
    namespace, _, name = resolved.rpartition('/')
    is_true_state = namespace.rpartition('/')[2] == GROUND_TRUTH
    return f'{GROUND_TRUTH}/{name}' if is_true_state else name


# Each joint prefix makes another task, so the cache needs a limit.
@lru_cache(maxsize=256)
def topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Return the topics of `sim_node` for a task, without `ground_truth_topics` and `MONITORING`.

    The order is part of the contract. Published topics come first, in the order of publication:
    `applied_command` is the last topic of a step, and `episode_status` follows at some ticks.
    Subscribed topics come next.

    To add a topic of every tick, insert it before `applied_command`, add its value to
    `tick.TickEncoder.encode`, and increase `INTERFACE_VERSION`, which is the `since` of the topic.
    Then run `make tables` to update the documentation.
    """
    clock = TopicSpec(
        '/clock', 'rosgraph_msgs/msg/Clock', 'Simulated time, once per tick.', qos=CLOCK
    )
    return (
        clock,
        *sensor_topics(task),
        *_goal_topics(task),
        *_result_topics(task),
        *_command_topics(task),
    )


def topic(task: TaskSpec, name: str) -> TopicSpec:
    """Return the one of `topics` with this name; ValueError, which lists all names, if missing."""
    found = {spec.name: spec for spec in topics(task)}
    return found[one_of(name, list(found), f'{task.name} has no topic')]


# Topics of `visualization_node`, for standard tools; none of them is logged.

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
    TopicSpec('/tf_static', _FRAMES, 'Fixed frames, including the camera.', qos=LATCHED),
    TopicSpec(
        'goal_markers',
        'visualization_msgs/msg/MarkerArray',
        'Goal, achieved goal, object, table; while it has subscribers.',
        frame=WORLD,
    ),
    TopicSpec('camera/image_raw', f'{_IMAGES}Image', 'A picture; while it has subscribers.'),
    TopicSpec(
        'camera/image_raw/compressed',
        f'{_IMAGES}CompressedImage',
        'The same as JPEG for `image_transport`; while it has subscribers.',
    ),
    TopicSpec('camera/camera_info', f'{_IMAGES}CameraInfo', 'Its calibration, of the same stamp.'),
)


def _scalar(name: str, unit: str, text: str) -> TopicSpec:
    """Return topic `scalars/<name>`, a number in `vector.x` of a `Vector3Stamped` message."""
    layout = (VectorPart(name, 1, unit),)
    return TopicSpec(f'scalars/{name}', 'geometry_msgs/msg/Vector3Stamped', text, layout)


def scalar_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Return the `scalars/` topics, for plots of distance, rotation, reward and success.

    A task has `distance` and `rotation` only if they count for success. Stamps are those of ticks.
    """
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


def view_topics(task: TaskSpec) -> tuple[TopicSpec, ...]:
    """Return all topics of `visualization_node` for a task."""
    return (*SHOWN, *scalar_topics(task))


# Services


@dataclass(frozen=True, slots=True)
class ServiceSpec:
    """One service of a node; `~/` in its name stands for the name of the node."""

    name: str
    type_name: str
    description: str
    node: str = 'sim_node'


# A call blocks the robot while it steps; the slowest task needs a few seconds for this many ticks.
MAX_STEPS = 1000

RESET = ServiceSpec(
    '~/reset', 'std_srvs/srv/Trigger', 'Ends the running episode; the next tick starts another.'
)
PAUSE = ServiceSpec(
    '~/pause',
    'std_srvs/srv/SetBool',
    'Stops the ticks and simulated time (true) or continues (false).',
)
STEP = ServiceSpec(
    '~/step', 'std_srvs/srv/Trigger', 'Runs one tick now; while paused, or in lockstep.'
)
STANDARD_SERVICES = (RESET, PAUSE, STEP)


# Only where the package simulation_interfaces is installed, which is not on PyPI.
INTERFACE_SERVICES = tuple(
    ServiceSpec(f'~/{name}', f'simulation_interfaces/srv/{type_name}', description)
    for name, type_name, description in (
        ('get_simulator_features', 'GetSimulatorFeatures', 'Lists the features below.'),
        ('get_simulation_state', 'GetSimulationState', 'Playing or paused.'),
        ('set_simulation_state', 'SetSimulationState', 'As `~/pause`.'),
        (
            'reset_simulation',
            'ResetSimulation',
            'As `~/reset` (scope state), or begins the series again, with the `seed` as it is set '
            'then; time is never set back.',
        ),
        (
            'step_simulation',
            'StepSimulation',
            f'Runs the given number of ticks, 1 ... {MAX_STEPS}; while paused.',
        ),
    )
)
SERVICES = (*STANDARD_SERVICES, *INTERFACE_SERVICES)
