"""Frames, markers and pictures for standard tools agree with MuJoCo."""

from __future__ import annotations

import itertools
from io import BytesIO

import mujoco
import numpy as np
import PIL.Image
import pytest
from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image
from visualization_msgs.msg import Marker, MarkerArray

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rendering import simulation_frame
from fetch_hand_sim.simulation.scene import Scene, _dress
from fetch_hand_sim.simulation.urdf import ROOT
from fetch_hand_sim.view.page.ray import MousePlace, mouse_ray
from fetch_hand_sim.visualization_node.messages import (
    Camera,
    camera_info,
    compressed_message,
    image_message,
    marker_array,
    transform_messages,
)
from fetch_hand_sim.visualization_node.transforms import Transforms, frame_prefix, view_transform
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.tasks import TASKS
from support.frames import tree
from support.tasks import each_task

STAMP = 3_000_000_007


def moved_frame(task):
    """A frame after a few random steps."""
    simulation = Simulation(task, num_threads=1)
    simulation.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(5):
        simulation.step(rng.uniform(-1, 1, (1, simulation.spec.robot.action_size)))
    return simulation_frame(simulation)


def test_a_camera_that_is_too_slow_for_its_rate_reports_it():
    now = itertools.count(100.0, 0.5)
    frame, scene = moved_frame('FetchReach'), Scene('FetchReach')
    fast, slow = (Camera(16, 16, hz, lambda: next(now)) for hz in (1.0, 10.0))
    for camera in (fast, slow):
        assert camera.problem() == ''
        camera.render(scene, frame)
        camera.close()
    assert fast.problem() == ''
    assert '2 of the 10 pictures per second are possible' in slow.problem()


@pytest.mark.parametrize('task', ['FetchReach', 'FetchPush', 'HandReach', 'HandManipulateEggFull'])
@pytest.mark.parametrize('namespace', ['/', '/left'])
def test_transforms_put_every_frame_where_mujoco_has_it(task, namespace):
    prefix = frame_prefix(namespace)
    frame, transforms, scene = moved_frame(task), Transforms(task, prefix), Scene(task)
    messages = transform_messages([*transforms.fixed(), *transforms.moving(frame)], STAMP)
    assert all(each.header.stamp == Time(sec=3, nanosec=7) for each in messages)
    poses = tree(messages)
    scene.show(frame)
    mujoco.mj_kinematics(scene.model, scene.data)
    bodies = [scene.model.body(index).name for index in range(1, scene.model.nbody)]
    checked = [name for name in bodies if prefix + name in poses]
    assert len(checked) > 15
    for name in checked:
        pose, body = poses[prefix + name], scene.data.body(name)
        np.testing.assert_allclose(pose.position, body.xpos, atol=1e-6)
        matrix = quaternion_to_matrix(pose.quaternion)
        np.testing.assert_allclose(matrix.ravel(), body.xmat, atol=1e-6)
    goals = [name for name in poses if name.startswith(f'{prefix}goal')]
    assert len(goals) == (5 if task == 'HandReach' else 1)
    if TASKS[task].has_object:
        np.testing.assert_allclose(
            poses[prefix + TASKS[task].object_name].position, frame.object_pose[:3]
        )


@each_task
def test_markers_are_the_shapes_of_the_scene(task):
    scene, frame = Scene(task), moved_frame(task)
    drawn = {'goal': scene.markers(frame), 'object': scene.object_markers(frame)}
    shapes = [shape for group in drawn.values() for shape in group]
    array = deserialize_message(serialize_message(marker_array(drawn, STAMP)), MarkerArray)
    assert array.markers[0].action == Marker.DELETEALL
    assert len(array.markers) == len(shapes) + 1 > 1
    assert [marker.ns for marker in array.markers].count('object') == len(drawn['object'])
    for marker, shape in zip(array.markers[1:], shapes, strict=True):
        assert marker.header.frame_id == ROOT
        p = marker.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], shape.position)
        assert min(marker.scale.x, marker.scale.y, marker.scale.z) > 0.0
    assert len({marker.id for marker in array.markers[1:]}) == len(shapes)


@pytest.mark.parametrize('task', [name for name, spec in TASKS.items() if spec.has_object])
def test_the_object_is_drawn_where_mujoco_has_it(task):
    scene, frame = Scene(task), moved_frame(task)
    scene.show(frame)
    mujoco.mj_kinematics(scene.model, scene.data)
    geom = scene.data.geom(scene.spec.object_name)
    marker = scene.object_markers(frame)[0]
    np.testing.assert_allclose(marker.position, geom.xpos, atol=1e-9)
    matrix = quaternion_to_matrix(marker.quaternion)
    np.testing.assert_allclose(matrix.ravel(), geom.xmat, atol=1e-6)
    (message,) = marker_array({'object': [marker]}, STAMP).markers[1:]
    longest = max(message.scale.x, message.scale.y, message.scale.z)
    assert longest == pytest.approx(2.0 * scene.model.geom(geom.id).size.max())


@each_task
def test_the_table_of_a_fetch_is_drawn(task):
    scene = Scene(task)
    mujoco.mj_kinematics(scene.model, scene.data)
    markers = scene.table_markers
    assert len(markers) == scene.spec.robot.has_gripper_command
    for marker in markers:
        np.testing.assert_allclose(marker.position, scene.data.body('table0').xpos)
        # Its top, metres above the floor.
        assert marker.position[2] + marker.size[2] == pytest.approx(0.4)


def test_obstacles_that_mocap_moves_are_drawn():
    """But not what leads the gripper."""
    world = mujoco.MjSpec()
    for name in ('robot0:mocap', 'obstacle'):
        body = world.worldbody.add_body(name=name, mocap=True)
        body.add_geom(name=name, size=[0.1, 0.1, 0.1])
    _dress(world)
    assert [world.geom(name).group for name in ('robot0:mocap', 'obstacle')] == [5, 0]


def test_a_shelf_on_a_table_is_marked_where_it_is(monkeypatch):
    world = mujoco.MjSpec()
    table = world.worldbody.add_body(name='table', pos=[1.0, 0.0, 0.4], quat=[0.0, 0.0, 0.0, 1.0])
    table.add_body(name='shelf', pos=[0.1, 0.0, 0.5]).add_geom(size=[0.1, 0.1, 0.1])
    scene = Scene('FetchReach')
    monkeypatch.setattr(scene, 'model', world.compile())
    (marker,) = scene.table_markers
    np.testing.assert_allclose(marker.position, [0.9, 0.0, 0.9], atol=1e-9)


def test_an_image_keeps_its_pixels():
    picture = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    message = deserialize_message(serialize_message(image_message(picture, 'camera', STAMP)), Image)
    assert (message.height, message.width, message.step) == (6, 8, 24)
    np.testing.assert_array_equal(np.array(message.data).reshape(6, 8, 3), picture)


def test_a_compressed_image_is_the_same_picture():
    shades = np.linspace(0.0, 255.0, 64)
    colors = np.stack([shades, shades[::-1], np.full(64, 90.0)], axis=1)
    picture = np.tile(colors.astype(np.uint8), (48, 1, 1))
    data = serialize_message(compressed_message(picture, 'camera', STAMP))
    message = deserialize_message(data, CompressedImage)
    assert message.format == 'rgb8; jpeg compressed bgr8'
    assert message.header.stamp == Time(sec=3, nanosec=7)
    found = np.asarray(PIL.Image.open(BytesIO(bytes(message.data))))
    assert len(message.data) < picture.nbytes / 4
    np.testing.assert_allclose(found.astype(int), picture, atol=16)


def test_camera_info_projects_points_correctly():
    """Projection by camera_info and transform against the ray of that pixel."""
    view = Scene('FetchReach').view
    width, height, point = 640, 480, np.array([1.3, 0.7, 0.5])
    info = camera_info(width, height, 45.0, 'camera', STAMP)
    pose = view_transform(view, 'camera').pose
    x, y, z = quaternion_to_matrix(pose.quaternion).T @ (point - pose.position)
    u, v = info.k[0] * x / z + info.k[2], info.k[4] * y / z + info.k[5]
    ray = mouse_ray(view, 45.0, MousePlace(u / width, v / height, width / height))
    assert ray.distance_to(point) < 1e-6


@pytest.mark.parametrize(('hz', 'due'), [(10.0, [True, False, True]), (0.0, [False] * 3)])
def test_the_camera_has_a_rate_of_its_own(hz, due, monkeypatch):
    now = [0.0]
    camera = Camera(8, 8, hz, lambda: now[0])
    monkeypatch.setattr(
        'fetch_hand_sim.visualization_node.messages.SceneRenderer',
        lambda *_: type('R', (), {'render': lambda self, frame: None, 'close': lambda self: 0})(),
    )
    seen = []
    for at in (0.0, 0.05, 0.1):
        now[0] = at
        seen.append(bool(camera.is_due))
        if camera.is_due:
            camera.render(None, None)
    assert seen == due
