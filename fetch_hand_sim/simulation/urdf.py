"""The robot of a task as URDF, generated from its compiled model.

Links are MuJoCo's bodies with their frames; joints have the names and zero positions of
`joint_states`. A body with several joints, or a joint away from its origin, gets massless links in
between.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from fetch_hand_sim.simulation.models import geom_color, load_spec
from fetch_hand_sim.simulation.tasks import task_asset
from msgs_spec.arrays import Array
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.rotations import (
    IDENTITY,
    quaternion_from_axis_angle,
    quaternion_multiply,
    quaternion_to_matrix,
)
from msgs_spec.tasks import task_spec

JointType = Literal['fixed', 'revolute', 'continuous', 'prismatic']

_GEOM = mujoco.mjtGeom
# Geom groups that MuJoCo draws by default.
_DRAWN_GROUPS = (0, 1, 2)
ROOT = 'world'
# URDF requires limits that MuJoCo does not have: m or rad, N or N m, and per second.
_FAR, _STRONG, _FAST = 1000.0, 1000.0, 100.0


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a frame relative to another one: position (3,) m and quaternion (4,) wxyz."""

    position: Array
    quaternion: Array

    def __matmul__(self, other: Pose) -> Pose:
        """Compose two poses: `other` is relative to the frame of this pose."""
        rotated = quaternion_to_matrix(self.quaternion) @ other.position
        turned = quaternion_multiply(self.quaternion, other.quaternion)
        return Pose(self.position + rotated, turned / np.linalg.norm(turned))


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    """A joint between two links.

    Attributes:
        name: As in `joint_states`; fixed joints have the name of the child link and `/fixed`.
        origin: Pose of the child relative to the parent at joint position 0.
        axis: (3,) axis of the joint in the frame of the child.
    """

    name: str
    kind: JointType
    parent: str
    child: str
    origin: Pose
    axis: Array
    lower: float = 0.0
    upper: float = 0.0

    def pose(self, position: float = 0.0) -> Pose:
        """Return the pose of the child relative to the parent at a joint position, rad or m."""
        if self.kind == 'fixed':
            return self.origin
        if self.kind == 'prismatic':
            return self.origin @ Pose(position * self.axis, IDENTITY)
        turn = quaternion_from_axis_angle(self.axis, position)
        return self.origin @ Pose(np.zeros(3), turn)


class RobotDescription:
    """Links and joints of the robot of a task."""

    def __init__(self, task: str) -> None:
        self._spec = task_spec(task)
        self._mjcf = load_spec(task_asset(task))
        self._model = self._mjcf.compile()
        bodies = range(1, self._model.nbody)
        self._bodies = [body for body in bodies if self._belongs(body)]
        self.joints = [joint for body in self._bodies for joint in self._joints_of(body)]

    def poses(self, positions: Mapping[str, float]) -> dict[str, Pose]:
        """Return the pose of each link relative to the root link `world`, by link name.

        `positions` are rad or m, by joint name as in `joint_states`; missing ones count as 0.
        """
        found = {ROOT: Pose(np.zeros(3), IDENTITY)}
        for joint in self.joints:
            found[joint.child] = found[joint.parent] @ joint.pose(positions.get(joint.name, 0.0))
        return found

    def to_xml(self, frame_prefix: str = '', joint_prefix: str = JOINT_PREFIX) -> str:
        """Return the URDF.

        Args:
            frame_prefix: Prefix of all links except the root, such as `left/`.
            joint_prefix: Replaces `robot0:` in the joint names of the URDF, as in `joint_states`.
        """
        robot = ElementTree.Element('robot', name=self._spec.robot.name)
        ElementTree.SubElement(robot, 'link', name=ROOT)
        names = {self._model.body(body).name: body for body in self._bodies}
        for joint in self.joints:
            link = ElementTree.SubElement(robot, 'link', name=frame_prefix + joint.child)
            if joint.child in names:
                self._fill_link(link, names[joint.child])
            name = joint_prefix + joint.name.removeprefix(JOINT_PREFIX)
            self._add_joint(robot, joint, name, frame_prefix)
        ElementTree.indent(robot)
        return ElementTree.tostring(robot, encoding='unicode')

    def _belongs(self, body: int) -> bool:
        """Return whether a body is part of the robot; mocap bodies and external cameras are not."""
        model = self._model
        name = model.body(body).name
        is_mocap = int(model.body_mocapid[body]) >= 0
        return name.startswith(JOINT_PREFIX) and not is_mocap and 'external_camera' not in name

    def _joints_of(self, body: int) -> Iterator[UrdfJoint]:
        """Yield the URDF joints that together connect a body's parent with the body, in order."""
        model = self._model
        name = model.body(body).name
        parent_body = int(model.body_parentid[body])
        parent = model.body(parent_body).name if parent_body else ROOT
        origin = Pose(model.body_pos[body].copy(), model.body_quat[body].copy())
        first = int(model.body_jntadr[body])
        moving = range(first, first + int(model.body_jntnum[body]))
        for index in moving:
            # The anchor only matters for hinges.
            is_hinge = int(model.jnt_type[index]) == mujoco.mjtJoint.mjJNT_HINGE.value
            anchor = model.jnt_pos[index] if is_hinge else np.zeros(3)
            start = origin @ Pose(anchor, IDENTITY)
            is_last = index == moving[-1] and not anchor.any()
            child = name if is_last else f'{model.joint(index).name}/moved'
            yield self._moving_joint(index, parent, child, start)
            if is_last:
                return
            parent = child
            origin = Pose(-anchor, IDENTITY)
        yield UrdfJoint(f'{name}/fixed', 'fixed', parent, name, origin, np.zeros(3))

    def _moving_joint(self, index: int, parent: str, child: str, start: Pose) -> UrdfJoint:
        model = self._model
        joint = model.joint(index)
        axis = np.array(model.jnt_axis[index])
        zero = float(model.qpos0[model.jnt_qposadr[index]])
        is_hinge = int(model.jnt_type[index]) == mujoco.mjtJoint.mjJNT_HINGE.value
        lower, upper = model.jnt_range[index] if model.jnt_limited[index] else (-_FAR, _FAR)
        kind: JointType = 'revolute' if is_hinge else 'prismatic'
        if is_hinge and not model.jnt_limited[index]:
            kind = 'continuous'
        limits = float(lower), float(upper)
        moving = UrdfJoint(joint.name, kind, parent, child, start, axis, *limits)
        # The compiled pose belongs to the position `zero`.
        return replace(moving, origin=moving.pose(-zero))

    def _fill_link(self, link: ElementTree.Element, body: int) -> None:
        model = self._model
        mass = float(model.body_mass[body])
        if mass > 0.0:
            inertial = ElementTree.SubElement(link, 'inertial')
            add_origin(inertial, model.body_ipos[body], model.body_iquat[body])
            ElementTree.SubElement(inertial, 'mass', value=f'{mass:.12g}')
            ixx, iyy, izz = (f'{value:.12g}' for value in model.body_inertia[body])
            ElementTree.SubElement(
                inertial, 'inertia', ixx=ixx, iyy=iyy, izz=izz, ixy='0', ixz='0', iyz='0'
            )
        add_shapes(link, self._mjcf, model, body)

    def _add_joint(
        self, robot: ElementTree.Element, joint: UrdfJoint, name: str, frame_prefix: str
    ) -> None:
        parent = joint.parent if joint.parent == ROOT else frame_prefix + joint.parent
        element = ElementTree.SubElement(robot, 'joint', name=name, type=joint.kind)
        ElementTree.SubElement(element, 'parent', link=parent)
        ElementTree.SubElement(element, 'child', link=frame_prefix + joint.child)
        add_origin(element, joint.origin.position, joint.origin.quaternion)
        if joint.kind == 'fixed':
            return
        ElementTree.SubElement(element, 'axis', xyz=numbers(joint.axis))
        limit = {'effort': f'{_STRONG:g}', 'velocity': f'{_FAST:g}'}
        if joint.kind != 'continuous':
            limit |= {'lower': f'{joint.lower:.9g}', 'upper': f'{joint.upper:.9g}'}
        ElementTree.SubElement(element, 'limit', limit)


def numbers(values: ArrayLike) -> str:
    """Return numbers as text for URDF, separated by spaces."""
    return ' '.join(f'{value:.12g}' for value in np.asarray(values, dtype=np.float64))


def add_shapes(
    link: ElementTree.Element, mjcf: mujoco.MjSpec, model: mujoco.MjModel, body: int
) -> None:
    """Add `visual` and `collision` elements for the geoms of a body."""
    first = int(model.body_geomadr[body])
    for geom in range(first, first + int(model.body_geomnum[body])):
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        is_drawn = int(model.geom_group[geom]) in _DRAWN_GROUPS
        for shape, position, quaternion in _shapes(mjcf, model, geom):
            for kind in [*(['visual'] if is_drawn else []), *(['collision'] if touches else [])]:
                element = ElementTree.SubElement(link, kind)
                add_origin(element, position, quaternion)
                ElementTree.SubElement(element, 'geometry').append(shape)
                if kind == 'visual':
                    _add_color(element, model, geom)


def _shapes(
    mjcf: mujoco.MjSpec, model: mujoco.MjModel, geom: int
) -> Iterator[tuple[ElementTree.Element, Array, Array]]:
    """Yield each URDF shape of a geom with its pose in the body's frame; a capsule has three."""
    position, quaternion = model.geom_pos[geom].copy(), model.geom_quat[geom].copy()
    size = model.geom_size[geom]
    kind = int(model.geom_type[geom])
    if kind == _GEOM.mjGEOM_MESH.value:
        yield _mesh(mjcf, model, int(model.geom_dataid[geom]), position, quaternion)
    elif kind == _GEOM.mjGEOM_BOX.value:
        yield ElementTree.Element('box', size=numbers(2.0 * size)), position, quaternion
    elif kind == _GEOM.mjGEOM_SPHERE.value:
        yield _sphere(size[0]), position, quaternion
    elif kind in (_GEOM.mjGEOM_CYLINDER.value, _GEOM.mjGEOM_CAPSULE.value):
        length = {'radius': f'{size[0]:.9g}', 'length': f'{2.0 * size[1]:.9g}'}
        yield ElementTree.Element('cylinder', length), position, quaternion
        if kind == _GEOM.mjGEOM_CAPSULE.value:
            along = quaternion_to_matrix(quaternion)[:, 2] * size[1]
            yield _sphere(size[0]), position + along, quaternion
            yield _sphere(size[0]), position - along, quaternion


def _sphere(radius: float) -> ElementTree.Element:
    return ElementTree.Element('sphere', radius=f'{radius:.9g}')


def _mesh(
    mjcf: mujoco.MjSpec, model: mujoco.MjModel, mesh: int, position: Array, quaternion: Array
) -> tuple[ElementTree.Element, Array, Array]:
    """Return a `mesh` element, and the position and quaternion of its file's frame in the body.

    `position` and `quaternion` belong to the inertia frame, in which MuJoCo stores the mesh.
    """
    source: Any = mjcf.mesh(model.mesh(mesh).name)
    path = (Path(mjcf.modelfiledir) / mjcf.meshdir / source.file).resolve()
    back = np.array([1.0, -1.0, -1.0, -1.0]) * model.mesh_quat[mesh]
    turn = quaternion_multiply(quaternion, back)
    place = position - quaternion_to_matrix(turn) @ model.mesh_pos[mesh]
    element = ElementTree.Element('mesh', filename=path.as_uri(), scale=numbers(source.scale))
    return element, place, turn


def _add_color(element: ElementTree.Element, model: mujoco.MjModel, geom: int) -> None:
    named = ElementTree.SubElement(element, 'material', name=f'geom{geom}')
    ElementTree.SubElement(named, 'color', rgba=numbers(geom_color(model, geom)))


def add_origin(element: ElementTree.Element, position: ArrayLike, quaternion: ArrayLike) -> None:
    """Add an `origin` element: position, m, and quaternion wxyz as roll, pitch and yaw, rad."""
    ElementTree.SubElement(
        element, 'origin', xyz=numbers(position), rpy=numbers(roll_pitch_yaw(quaternion))
    )


def roll_pitch_yaw(quaternion: ArrayLike) -> Array:
    """Return (roll, pitch, yaw), rad, of a quaternion wxyz: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    m = quaternion_to_matrix(quaternion)
    cosine = np.hypot(m[0, 0], m[1, 0])
    if cosine > 1e-9:
        roll, yaw = np.arctan2(m[2, 1], m[2, 2]), np.arctan2(m[1, 0], m[0, 0])
    else:
        roll, yaw = np.arctan2(-m[1, 2], m[1, 1]), 0.0
    return np.array([roll, np.arctan2(-m[2, 0], cosine), yaw])
