"""The URDF is the model: same kinematics, masses, limits, meshes where they are."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from io import StringIO
from pathlib import Path
from urllib.parse import unquote, urlsplit

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.simulation.urdf import ROOT, RobotDescription, roll_pitch_yaw
from msgs_spec.rotations import quaternion_to_matrix

TASKS_OF_ROBOTS = ['FetchReach', 'HandReach']
COLORS = {'FetchReach': 5, 'HandReach': 2}


@pytest.fixture(scope='module', params=TASKS_OF_ROBOTS)
def robot(request):
    return RobotDescription(request.param), Scene(request.param)


def test_every_body_is_where_mujoco_has_it(robot):
    """By a library that reads the URDF, and by our own kinematics."""
    yourdfpy = pytest.importorskip('yourdfpy')
    description, scene = robot
    urdf = yourdfpy.URDF.load(
        StringIO(description.to_xml()), load_meshes=False, build_scene_graph=True
    )
    assert set(urdf.actuated_joint_names) == set(scene.spec.robot.joints)
    names = bodies(description, scene)
    assert len(names) > 15
    rng, model, data = np.random.default_rng(0), scene.model, scene.data
    joints = [model.joint(name) for name in scene.spec.robot.joints]
    for _ in range(8):
        positions = {
            joint.name: rng.uniform(*(joint.range if joint.limited else (-1.0, 1.0)))
            for joint in joints
        }
        for joint in joints:
            data.qpos[joint.qposadr[0]] = positions[joint.name]
        mujoco.mj_kinematics(model, data)
        urdf.update_cfg(positions)
        poses = description.poses(positions)
        for name in names:
            found, body = urdf.get_transform(name, ROOT), data.body(name)
            np.testing.assert_allclose(found[:3, 3], body.xpos, atol=1e-6)
            np.testing.assert_allclose(found[:3, :3].ravel(), body.xmat, atol=1e-6)
            np.testing.assert_allclose(poses[name].position, body.xpos, atol=1e-9)
            turn = quaternion_to_matrix(poses[name].quaternion)
            np.testing.assert_allclose(turn.ravel(), body.xmat, atol=1e-9)


def bodies(description, scene):
    names = {scene.model.body(index).name for index in range(scene.model.nbody)}
    return [joint.child for joint in description.joints if joint.child in names]


def test_masses_and_limits_are_those_of_the_model(robot):
    description, scene = robot
    root = ElementTree.fromstring(description.to_xml())
    names = bodies(description, scene)
    masses = {link.get('name'): link.find('inertial/mass') for link in root.findall('link')}
    for name in names:
        expected = float(scene.model.body(name).mass[0])
        found = masses[name]
        assert (0.0 if found is None else float(found.get('value'))) == pytest.approx(expected)
    for joint in root.findall('joint'):
        if joint.get('type') in ('revolute', 'prismatic'):
            known = scene.model.joint(joint.get('name'))
            if scene.model.jnt_limited[known.id]:
                limit = joint.find('limit')
                found = [float(limit.get('lower')), float(limit.get('upper'))]
                np.testing.assert_allclose(found, known.range, atol=1e-7)


def test_links_and_joints_take_prefixes_and_meshes_are_the_installed_files(robot):
    description, scene = robot
    root = ElementTree.fromstring(description.to_xml('left/', 'rh_'))
    first, *names = [link.get('name') for link in root.findall('link')]
    assert first == ROOT and all(name.startswith('left/') for name in names)
    moving = {each.get('name') for each in root.findall('joint') if each.get('type') != 'fixed'}
    assert moving == set(scene.spec.with_joint_prefix('rh_').robot.joints)
    files = {mesh.get('filename') for mesh in root.iter('mesh')}
    assert files
    for file in files:
        assert file.startswith('file:///') and 'gymnasium_robotics' in file
        assert Path(unquote(urlsplit(file).path)).is_file()


def test_links_have_the_colors_that_mujoco_draws(robot):
    description, scene = robot
    model = scene.model
    drawn = mujoco.MjvScene(model, maxgeom=1000)
    everything, free = mujoco.MjvOption(), mujoco.MjvCamera()
    mujoco.mjv_updateScene(
        model, mujoco.MjData(model), everything, None, free, mujoco.mjtCatBit.mjCAT_ALL.value, drawn
    )
    shapes = [
        each for each in drawn.geoms[: drawn.ngeom] if each.objtype == mujoco.mjtObj.mjOBJ_GEOM
    ]
    expected = {f'geom{each.objid}': each.rgba.tolist() for each in shapes}
    root = ElementTree.fromstring(description.to_xml())
    found = {
        each.get('name'): [float(value) for value in each.find('color').get('rgba').split()]
        for each in root.iter('material')
    }
    assert found == {name: pytest.approx(expected[name]) for name in found}
    # The Fetch has them beside its materials, which are all white.
    assert len({tuple(color) for color in found.values()}) == COLORS[scene.spec.name]


def test_a_mesh_is_drawn_where_mujoco_draws_it():
    """Corners of the palm's mesh, read from its file, against the compiled vertices."""
    trimesh = pytest.importorskip('trimesh')
    description, scene = RobotDescription('HandReach'), Scene('HandReach')
    root = ElementTree.fromstring(description.to_xml())
    (visual,) = root.findall("link[@name='robot0:palm']/visual")
    mesh, origin = visual.find('geometry/mesh'), visual.find('origin')
    corners = trimesh.load(unquote(urlsplit(mesh.get('filename')).path)).bounds
    scale = np.array([float(value) for value in mesh.get('scale').split()])
    xyz = np.array([float(value) for value in origin.get('xyz').split()])
    roll, pitch, yaw = (float(value) for value in origin.get('rpy').split())
    turn = rotation('z', yaw) @ rotation('y', pitch) @ rotation('x', roll)
    model = scene.model
    geom = next(
        index
        for index in range(model.ngeom)
        if model.geom_bodyid[index] == model.body('robot0:palm').id
        and model.geom_dataid[index] >= 0
    )
    start, count = (
        int(array[model.geom_dataid[geom]]) for array in (model.mesh_vertadr, model.mesh_vertnum)
    )
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
    compiled = model.mesh_vert[start : start + count] @ matrix.reshape(3, 3).T
    compiled = compiled + model.geom_pos[geom]
    in_file = (compiled - xyz) @ turn
    np.testing.assert_allclose(in_file.min(axis=0), scale * corners[0], atol=1e-6)
    np.testing.assert_allclose(in_file.max(axis=0), scale * corners[1], atol=1e-6)


def rotation(axis, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    index = 'xyz'.index(axis)
    others = [(index + 1) % 3, (index + 2) % 3]
    matrix = np.eye(3)
    matrix[np.ix_(others, others)] = [[cosine, -sine], [sine, cosine]]
    return matrix


@pytest.mark.parametrize('seed', range(20))
def test_angles_give_the_rotation_back(seed):
    quaternion = np.random.default_rng(seed).normal(size=4)
    if seed < 2:
        quaternion = np.array([1.0, 0.0, 1.0 - 2.0 * seed, 0.0])
    quaternion /= np.linalg.norm(quaternion)
    roll, pitch, yaw = roll_pitch_yaw(quaternion)
    turn = rotation('z', yaw) @ rotation('y', pitch) @ rotation('x', roll)
    np.testing.assert_allclose(turn, quaternion_to_matrix(quaternion), atol=1e-7)
