"""The URDF is the model: same kinematics, masses, limits, colors, meshes where they are."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from io import StringIO
from urllib.parse import unquote, urlsplit

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.simulation.urdf import ROOT, RobotDescription, roll_pitch_yaw
from msgs_spec.rotations import quaternion_to_matrix

COLORS = {'FetchReach': 5, 'HandReach': 2}


def path_of(fname: str) -> str:
    """The file of a mesh."""
    assert fname.startswith('file:///') and 'gymnasium_robotics' in fname
    return unquote(urlsplit(fname).path)


@pytest.fixture(scope='module', params=COLORS)
def robot(request):
    """The description and the scene of a robot, and its URDF as a library reads it."""
    yourdfpy = pytest.importorskip('yourdfpy')
    description = RobotDescription(request.param)
    urdf = yourdfpy.URDF.load(StringIO(description.to_xml()), filename_handler=path_of)
    return description, Scene(request.param), urdf


def bodies(description, scene):
    names = {scene.model.body(index).name for index in range(scene.model.nbody)}
    return [joint.child for joint in description.joints if joint.child in names]


def drawn_colors(urdf):
    """The color of each visual, by the number of its geom."""
    visuals = [visual.material for link in urdf.link_map.values() for visual in link.visuals]
    return [(int(each.name.removeprefix('geom')), each.color.rgba) for each in visuals]


def test_every_body_and_mesh_is_where_mujoco_has_it(robot):
    """By a library that reads the URDF, and by our own kinematics."""
    description, scene, urdf = robot
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
    graph = urdf.scene.graph
    for node, (geom, _) in zip(graph.nodes_geometry, drawn_colors(urdf), strict=True):
        if (mesh := int(model.geom_dataid[geom])) >= 0:
            pose, name = graph.get(node)
            start = model.mesh_vertadr[mesh]
            corners = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
            corners = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            found = urdf.scene.geometry[name].copy().apply_transform(pose).bounds
            np.testing.assert_allclose(found, [corners.min(0), corners.max(0)], atol=1e-6)


def test_masses_and_limits_are_those_of_the_model(robot):
    description, scene, urdf = robot
    for name in bodies(description, scene):
        inertial = urdf.link_map[name].inertial
        expected = pytest.approx(float(scene.model.body(name).mass[0]))
        assert (inertial.mass if inertial else 0.0) == expected
    for name in scene.spec.robot.joints:
        known, limit = scene.model.joint(name), urdf.joint_map[name].limit
        if known.limited:
            np.testing.assert_allclose([limit.lower, limit.upper], known.range, atol=1e-7)


def test_links_and_joints_take_prefixes(robot):
    description, scene, _ = robot
    root = ElementTree.fromstring(description.to_xml('left/', 'rh_'))
    first, *names = [link.get('name') for link in root.findall('link')]
    assert first == ROOT and all(name.startswith('left/') for name in names)
    moving = {each.get('name') for each in root.findall('joint') if each.get('type') != 'fixed'}
    assert moving == set(scene.spec.with_joint_prefix('rh_').robot.joints)


def test_links_have_the_colors_that_mujoco_draws(robot):
    _, scene, urdf = robot
    model, drawn = scene.model, mujoco.MjvScene(scene.model, maxgeom=1000)
    everything, free = mujoco.MjvOption(), mujoco.MjvCamera()
    mujoco.mjv_updateScene(
        model, mujoco.MjData(model), everything, None, free, mujoco.mjtCatBit.mjCAT_ALL.value, drawn
    )
    is_geom = mujoco.mjtObj.mjOBJ_GEOM
    shapes = [each for each in drawn.geoms[: drawn.ngeom] if each.objtype == is_geom]
    expected = {each.objid: each.rgba for each in shapes}
    found = drawn_colors(urdf)
    for geom, color in found:
        assert color == pytest.approx(expected[geom])
    # The Fetch has them beside its materials, which are all white.
    assert len({tuple(color) for _, color in found}) == COLORS[scene.spec.name]


@pytest.mark.parametrize('seed', range(20))
def test_angles_give_the_rotation_back(seed):
    quaternion = np.random.default_rng(seed).normal(size=4)
    if seed < 2:
        quaternion = np.array([1.0, 0.0, 1.0 - 2.0 * seed, 0.0])
    quaternion /= np.linalg.norm(quaternion)
    turned = np.empty(4)
    # About fixed axes: first x, then y, then z.
    mujoco.mju_euler2Quat(turned, roll_pitch_yaw(quaternion), 'XYZ')
    expected = quaternion_to_matrix(quaternion)
    np.testing.assert_allclose(quaternion_to_matrix(turned), expected, atol=1e-7)
