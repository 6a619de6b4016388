"""Compute the poses of the coordinate frames of a robot's links, its object and its goal."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from fetch_hand_sim.simulation.scene import Frame, View
from fetch_hand_sim.simulation.urdf import ROOT, Pose, RobotDescription
from fetch_hand_sim.view.page.ray import camera_axes
from msgs_spec.arrays import Array
from msgs_spec.robots import FINGERTIPS
from msgs_spec.rotations import IDENTITY
from msgs_spec.tasks import GoalKind, task_spec


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of the frame `child` in the frame `parent`."""

    parent: str
    child: str
    pose: Pose


class Transforms:
    """Computes the transforms of one robot for `/tf` and `/tf_static`."""

    def __init__(self, task: str, prefix: str = '') -> None:
        self.description = RobotDescription(task)
        self._spec = task_spec(task)
        self._prefix = prefix
        self._index = {name: number for number, name in enumerate(self._spec.robot.joints)}

    def fixed(self) -> list[Transform]:
        """Return the transforms of fixed joints, which never change."""
        joints = (joint for joint in self.description.joints if joint.kind == 'fixed')
        return [self._between(joint.parent, joint.child, joint.pose()) for joint in joints]

    def moving(self, frame: Frame) -> list[Transform]:
        """Return the transforms of moving links, object and goal; HandReach has five goals."""
        found = [
            self._between(
                joint.parent,
                joint.child,
                joint.pose(self._position(joint.name, frame)),
            )
            for joint in self.description.joints
            if joint.kind != 'fixed'
        ]
        if frame.object_pose is not None and self._spec.object_name is not None:
            found.append(self._pose(self._spec.object_name, frame.object_pose))
        return [*found, *self._goal(frame.desired_goal)]

    def _position(self, joint: str, frame: Frame) -> float:
        """Return the position of a joint, rad or m; 0 for a joint missing in `joint_states`."""
        index = self._index.get(joint)
        return 0.0 if index is None else float(frame.joint_position[index])

    def _goal(self, goal: Array) -> list[Transform]:
        if self._spec.goal is GoalKind.POSE:
            return [self._pose('goal', goal)]
        is_point = self._spec.goal is GoalKind.POINT
        names = ['goal'] if is_point else [f'goal_{name}' for name in FINGERTIPS]
        points = zip(names, goal.reshape(-1, 3), strict=True)
        return [self._pose(name, np.concatenate([point, IDENTITY])) for name, point in points]

    def _pose(self, name: str, pose: Array) -> Transform:
        return self._between(ROOT, name, Pose(pose[:3], pose[3:]))

    def _between(self, parent: str, child: str, pose: Pose) -> Transform:
        known = parent if parent == ROOT else self._prefix + parent
        return Transform(known, self._prefix + child, pose)


def frame_prefix(namespace: str) -> str:
    """Return the frame prefix of a namespace: `left/` for `/left`, empty for `/`."""
    name = namespace.strip('/')
    return f'{name}/' if name else ''


def view_transform(view: View, name: str) -> Transform:
    """Return the pose in the world of the camera frame `name` (x right, y down, z ahead)."""
    ahead, right, up = camera_axes(view)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, -up, ahead], axis=1).ravel())
    position = np.array(view.lookat) - view.distance * ahead
    return Transform(ROOT, name, Pose(position, quaternion))
