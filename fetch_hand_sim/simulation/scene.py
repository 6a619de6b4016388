"""Scenes for pictures: the model of a task with floor, light, markers and a ghost of the goal.

The web page and films use the same scenes. A scene shows the frame of one tick, live or from a
file, and computes no physics.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np

from fetch_hand_sim.simulation.models import free_joint, geom_color, load_spec
from fetch_hand_sim.simulation.tasks import task_asset
from msgs_spec.arrays import Array
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tasks import GoalKind, TaskSpec, task_spec

Color = tuple[float, float, float, float]

# Length of the drawn trail of the object or gripper.
TRAIL_TICKS = 40
REACHED: Color = (0.15, 0.75, 0.25, 0.65)
MISSED: Color = (0.9, 0.2, 0.15, 0.65)
_ACHIEVED: Color = (0.15, 0.4, 0.9, 0.8)
_LINK: Color = (0.35, 0.35, 0.4, 0.5)
_TRAIL: Color = (0.15, 0.4, 0.9, 0.35)
# Opacity around a goal: the ball of its threshold, or the shell of a ghost.
_HALO_OPACITY = 0.16
_SHELL_SCALE = 1.08
# Axis that shows the rotation of a pose without an object, m.
_POINTER = np.array([0.1, 0.0, 0.0])
# If only the rotation counts, the ghost is drawn beside the hand, m, as in Gymnasium-Robotics.
GHOST_OFFSET = np.array([0.15, 0.0, 0.0])
# Name of the body that shows a goal.
GHOST = 'target'
SHOWN_SITES = 0


@dataclass(frozen=True, slots=True)
class View:
    """A free camera: the point looked at (m), distance (m), azimuth and elevation (degrees)."""

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float

    def apply(self, camera: mujoco.MjvCamera) -> None:
        """Set a camera to this view."""
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE.value
        camera.fixedcamid = camera.trackbodyid = -1
        camera.lookat[:] = self.lookat
        camera.distance = self.distance
        camera.azimuth, camera.elevation = self.azimuth, self.elevation


_FETCH_VIEW = View((1.2, 0.75, 0.58), 1.75, 140.0, -18.0)
_SLIDE_VIEW = View((1.4, 0.75, 0.5), 2.2, 140.0, -24.0)
_REACH_VIEW = View((1.0, 0.91, 0.17), 0.43, 55.0, -38.0)
_MANIPULATE_VIEW = View((1.05, 0.89, 0.18), 0.47, 62.0, -38.0)


def default_view(spec: TaskSpec) -> View:
    """Return the default camera view of a task."""
    if spec.robot.has_gripper_command:
        return _SLIDE_VIEW if spec.looks_like == 'FetchSlide' else _FETCH_VIEW
    return _REACH_VIEW if spec.goal is GoalKind.FINGERTIPS else _MANIPULATE_VIEW


def model_view(model: mujoco.MjModel) -> View:
    """Return the view that `<statistic>` and `<visual><global>` of the model define."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    x, y, z = camera.lookat.tolist()
    return View((x, y, z), float(camera.distance), float(camera.azimuth), float(camera.elevation))


@dataclass(frozen=True, slots=True)
class Frame:
    """State of a robot at one tick; goals and poses in the world frame.

    Attributes:
        joint_position: (joints,) in the order of `joint_states`, rad or m.
        desired_goal: (goal size,), m and quaternion wxyz.
        achieved_goal: (goal size,), m and quaternion wxyz.
        object_pose: (7,) m and quaternion wxyz; None for tasks without an object.
        qpos: (nq,) positions of all joints of the model. With None, as in frames from a log, joints
            that are not in `joint_position` keep their positions.
    """

    joint_position: Array
    desired_goal: Array
    achieved_goal: Array
    object_pose: Array | None
    is_success: bool
    qpos: Array | None = None


@dataclass(frozen=True, slots=True)
class Marker:
    """A geometric shape that is drawn at a pose in the world.

    Attributes:
        shape: Value of `mujoco.mjtGeom`.
        size: (3,) MuJoCo's sizes of the shape, m.
        position: (3,) m.
        quaternion: (4,) wxyz.
        color: Red, green, blue and opacity, 0 ... 1 each.
    """

    shape: int
    size: Array
    position: Array
    color: Color
    quaternion: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def draw(self, geom: mujoco.MjvGeom) -> None:
        """Overwrite a geom of a MuJoCo scene with this shape."""
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, self.quaternion)
        color = np.array(self.color, dtype=np.float32)
        mujoco.mjv_initGeom(geom, self.shape, self.size, self.position, rotation, color)


class Scene:
    """Shows robot, object and goal of a task in the state of a frame.

    Attributes:
        spec: The task. A caller that changes thresholds assigns another `TaskSpec`.
        model: The compiled `mujoco.MjModel`, for pictures only.
        data: Its `mujoco.MjData`; `show` sets `qpos` and computes no kinematics.
    """

    def __init__(self, task: str) -> None:
        self.spec = task_spec(task)
        mjcf = load_spec(task_asset(task))
        _dress(mjcf)
        self.model = mjcf.compile()
        self.data = mujoco.MjData(self.model)
        is_own = self.spec.looks_like is None and Path(task_asset(task)).is_absolute()
        self.view = model_view(self.model) if is_own else default_view(self.spec)
        joints = [self.model.joint(name) for name in self.spec.robot.joints]
        self._joints = np.array([int(joint.qposadr[0]) for joint in joints])
        self._object = free_joint(self.model, self.spec.object_name)[0]
        self._ghost = free_joint(self.model, GHOST)[0]

    @property
    def has_ghost(self) -> bool:
        """True if the model contains a ghost of the object that shows the goal."""
        is_pose = self.spec.goal is GoalKind.POSE
        return is_pose and self.spec.has_object and self._ghost is not None

    def show(self, frame: Frame) -> None:
        """Set `data.qpos` of robot, object and ghost; of other joints if the frame has `qpos`."""
        if frame.qpos is not None and frame.qpos.shape == self.data.qpos.shape:
            self.data.qpos[:] = frame.qpos
        self.data.qpos[self._joints] = frame.joint_position
        if self._object is not None and frame.object_pose is not None:
            self.data.qpos[self._object] = frame.object_pose
        if self._ghost is not None and self.has_ghost:
            self.data.qpos[self._ghost] = ghost_pose(self.spec, frame.desired_goal)

    def markers(self, frame: Frame, trail: Sequence[Array] = ()) -> list[Marker]:
        """Return the markers of goal, achieved goal and trail; see `trail_of` for `trail`."""
        color = REACHED if frame.is_success else MISSED
        if self.has_ghost:
            shapes = self._shell(frame, color)
        elif self.spec.goal is GoalKind.FINGERTIPS:
            shapes = _fingertip_markers(frame, color)
        else:
            shapes = _point_markers(self.spec, frame, color)
        width = 0.004 if self.spec.robot.has_gripper_command else 0.0012
        return [*shapes, *_line(trail, width)]

    def object_markers(self, frame: Frame) -> list[Marker]:
        """Return the markers of the object for viewers without the model; [] if no object."""
        if self._object is None or frame.object_pose is None:
            return []
        body = self.model.body(self.spec.object_name)
        first, count = int(body.geomadr[0]), int(body.geomnum[0])
        return [self._geom_marker(geom, frame.object_pose) for geom in range(first, first + count)]

    @cached_property
    def table_markers(self) -> list[Marker]:
        """Markers of all fixed geoms except robot and floor, such as the table (Fetch)."""
        model, data = self.model, mujoco.MjData(self.model)
        mujoco.mj_kinematics(model, data)
        markers = []
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            is_robot = model.body(body).name.startswith(JOINT_PREFIX)
            # The floor belongs to body 0, the world.
            if body and not is_robot and int(model.body_weldid[body]) == 0:
                pose = np.concatenate([data.xpos[body], data.xquat[body]])
                markers.append(self._geom_marker(geom, pose))
        return markers

    def _geom_marker(self, geom: int, pose: Array) -> Marker:
        """Return the marker of the geom with the id `geom`, whose body has `pose` (7,)."""
        model = self.model
        position, quaternion = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(
            position, quaternion, pose[:3], pose[3:], model.geom_pos[geom], model.geom_quat[geom]
        )
        red, green, blue, opacity = geom_color(model, geom).tolist()
        shape, size = int(model.geom_type[geom]), model.geom_size[geom].copy()
        return Marker(shape, size, position, (red, green, blue, opacity), quaternion)

    def _shell(self, frame: Frame, color: Color) -> list[Marker]:
        """Return a list with one marker, a transparent shell of this colour around the ghost."""
        geom = self.model.geom(GHOST)
        pose = ghost_pose(self.spec, frame.desired_goal)
        tint = (*color[:3], 2.0 * _HALO_OPACITY)
        size = _SHELL_SCALE * np.asarray(geom.size)
        return [Marker(int(geom.type[0]), size, pose[:3], tint, pose[3:])]


def ghost_pose(spec: TaskSpec, goal: Array) -> Array:
    """Return the pose (7,) of the ghost, which is `goal`, 0.15 m aside if only rotation counts."""
    pose = np.array(goal)
    if not spec.position_counts:
        pose[:3] += GHOST_OFFSET
    return pose


def tracked_position(frame: Frame) -> Array:
    """Return the position (3,) of the object; without object, of gripper or first fingertip."""
    if frame.object_pose is not None:
        return frame.object_pose[:3].copy()
    return frame.achieved_goal[:3].copy()


def trail_of(frames: Sequence[Frame], index: int) -> list[Array]:
    """Return `tracked_position` of up to `TRAIL_TICKS` frames before `index`, then of `index`."""
    return [tracked_position(frame) for frame in frames[max(0, index - TRAIL_TICKS) : index + 1]]


def _sphere(position: Array, radius: float, color: Color) -> Marker:
    return Marker(mujoco.mjtGeom.mjGEOM_SPHERE.value, np.full(3, radius), position, color)


def _point_markers(spec: TaskSpec, frame: Frame, color: Color) -> list[Marker]:
    halo = (*color[:3], _HALO_OPACITY)
    goal, achieved = frame.desired_goal[:3], frame.achieved_goal[:3]
    shapes = [_sphere(goal, 0.02, color), _sphere(goal, spec.distance_threshold, halo)]
    if not spec.has_object:
        shapes.append(_sphere(achieved, 0.012, _ACHIEVED))
    if spec.goal is GoalKind.POSE:
        # The x axes show both rotations.
        for pose, tint in ((frame.desired_goal, color), (frame.achieved_goal, _ACHIEVED)):
            axis = np.zeros(3)
            mujoco.mju_rotVecQuat(axis, _POINTER, pose[3:])
            shapes += _line([pose[:3], pose[:3] + axis], 0.005, tint)
    return [*shapes, *_line([achieved, goal], 0.002, _LINK)]


def _fingertip_markers(frame: Frame, color: Color) -> list[Marker]:
    shapes = []
    pairs = zip(frame.desired_goal.reshape(-1, 3), frame.achieved_goal.reshape(-1, 3), strict=True)
    for goal, finger in pairs:
        shapes += [_sphere(goal, 0.006, color), _sphere(finger, 0.004, _ACHIEVED)]
        shapes += _line([finger, goal], 0.001, _LINK)
    return shapes


def _line(points: Iterable[Array], width: float, color: Color = _TRAIL) -> list[Marker]:
    """Return capsules that connect consecutive points; `width` is the radius, m."""
    return [
        _capsule(start, end, width, color)
        for start, end in pairwise(points)
        if np.linalg.norm(end - start) > 1e-6
    ]


def _capsule(start: Array, end: Array, width: float, color: Color) -> Marker:
    along = end - start
    length = float(np.linalg.norm(along))
    quaternion = np.zeros(4)
    mujoco.mju_quatZ2Vec(quaternion, along / length)
    size = np.array([width, length / 2.0, 0.0])
    shape = mujoco.mjtGeom.mjGEOM_CAPSULE.value
    return Marker(shape, size, (start + end) / 2.0, color, quaternion)


def _dress(mjcf: mujoco.MjSpec) -> None:
    """Set floor, sky and light of a model in place; hide mocap body and sites, except pen ends."""
    for texture in mjcf.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = [0.93, 0.95, 0.97], [0.66, 0.73, 0.8]
            texture.width = texture.height = 64
    mjcf.add_texture(
        name='view:floor',
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.55, 0.58, 0.62],
        rgb2=[0.48, 0.51, 0.55],
        width=256,
        height=256,
    )
    floor = mjcf.add_material(name='view:floor', texrepeat=[8, 8], texuniform=False)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB.value] = 'view:floor'
    for geom in mjcf.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.material = 'view:floor'
            geom.rgba = [1.0, 1.0, 1.0, 1.0]
    for body in mjcf.bodies:
        # Hide the robot's mocap body; other mocap bodies may be obstacles.
        if body.mocap and body.name.startswith(JOINT_PREFIX):
            for geom in body.geoms:
                geom.group = 5
    for site in mjcf.sites:
        # Only the sites at the ends of the pen are shown: they show its direction.
        is_end = site.name.endswith((':top', ':bottom'))
        site.group = SHOWN_SITES if is_end else 5
    for light in mjcf.lights:
        light.castshadow = True
        light.dir = [0.3, 0.25, -1.0]
        light.diffuse = [0.5, 0.5, 0.5]
        light.ambient = [0.1, 0.1, 0.1]
    mjcf.visual.headlight.ambient = [0.2, 0.2, 0.2]
    mjcf.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    mjcf.visual.headlight.specular = [0.1, 0.1, 0.1]
    mjcf.visual.map.shadowclip = 1.5
    mjcf.visual.quality.offsamples = 4
    # Small textures, because the page downloads the model.
    mjcf.visual.quality.shadowsize = 2048
