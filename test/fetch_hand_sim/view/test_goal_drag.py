"""The mouse over the scene: rays, what they hit, where a goal goes."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.episodes.runner import FARTHEST_GOAL
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.scene import Scene, View, ghost_pose
from fetch_hand_sim.view.page import goal_panel
from fetch_hand_sim.view.page.goal_drag import find_handle, handles, moved_goal
from fetch_hand_sim.view.page.goal_panel import GoalPanel, position_ranges
from fetch_hand_sim.view.page.ray import MousePlace, mouse_ray
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.tasks import TASKS

VIEW = View((1.3, 0.75, 0.5), 1.8, 132.0, -20.0)
ASPECT = 1.5


def project(point, view=VIEW, aspect=ASPECT):
    """Where a point appears, 0 ... 1 from the left and top: the inverse of `mouse_ray`."""
    center = mouse_ray(view, 45.0, MousePlace(0.5, 0.5, aspect))
    offset = point - center.origin
    depth = offset @ center.forward
    half = np.tan(np.radians(45.0) / 2.0)
    x, y = offset @ center.right / depth / half / aspect, offset @ center.up / depth / half
    return (x + 1.0) / 2.0, (1.0 - y) / 2.0


def ray_at(point):
    return mouse_ray(VIEW, 45.0, MousePlace(*project(point), ASPECT))


def test_rays_agree_with_the_camera_of_mujoco():
    model = Scene('FetchReach').model
    scene, camera = mujoco.MjvScene(model, 1000), mujoco.MjvCamera()
    VIEW.apply(camera)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    category = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), camera, category, scene
    )
    eyes = scene.camera
    ray = mouse_ray(VIEW, 45.0, MousePlace(0.5, 0.5, ASPECT))
    np.testing.assert_allclose(ray.direction, eyes[0].forward, atol=1e-6)
    np.testing.assert_allclose(ray.up, eyes[0].up, atol=1e-6)
    middle = (np.array(eyes[0].pos) + np.array(eyes[1].pos)) / 2.0
    np.testing.assert_allclose(ray.origin, middle, atol=1e-4)


def example_goal(spec):
    rng = np.random.default_rng(0)
    if spec.goal.size == 7:
        return np.array([1.0, 0.87, 0.2, 1.0, 0.0, 0.0, 0.0])
    return rng.uniform([1.2, 0.6, 0.45], [1.4, 0.9, 0.6], (spec.goal.size // 3, 3)).ravel()


@pytest.mark.parametrize('task', TASKS)
def test_every_handle_can_be_taken_and_moves_only_its_own_part(task):
    spec = TASKS[task]
    goal = example_goal(spec)
    for handle in handles(spec, goal):
        ray = ray_at(handle.position)
        assert find_handle(spec, goal, ray).index == handle.index
        moved = moved_goal(
            spec, goal, handle, ray_at(handle.position + 0.01), True, np.array([0.1, 0.05])
        )
        assert np.abs(moved - goal).max() > 1e-3
        assert np.isfinite(moved).all()
        if spec.goal.size == 7:
            np.testing.assert_array_equal(moved[:3], goal[:3])
            assert np.linalg.norm(moved[3:]) == pytest.approx(1.0)
        else:
            others = np.delete(np.arange(goal.size), np.arange(3) + 3 * handle.index)
            np.testing.assert_array_equal(moved[others], goal[others])


@pytest.mark.parametrize('task', ['FetchPush', 'FetchSlide'])
@pytest.mark.parametrize('name', [None, 'OfMyOwn'])
def test_goals_on_the_table_stay_on_it(task, name):
    spec = replace(TASKS[task], name=name or task)
    goal = np.array([1.3, 0.7, 0.42])
    assert find_handle(spec, goal, ray_at(goal + np.array([0.0, 0.0, 0.2]))) is None
    (handle,) = handles(spec, goal)
    place = np.array([1.2, 0.8, 0.42])
    moved = moved_goal(spec, goal, handle, ray_at(place), True, np.zeros(2))
    np.testing.assert_allclose(moved, place, atol=1e-9)


@pytest.mark.parametrize('name', ['HandManipulateBlockRotateZ', 'OfMyOwn'])
def test_the_block_of_rotate_z_turns_about_z_alone(name):
    spec = replace(TASKS['HandManipulateBlockRotateZ'], name=name)
    goal = example_goal(spec)
    (handle,) = handles(spec, goal)
    moved = moved_goal(spec, goal, handle, ray_at(handle.position), True, np.array([0.3, 0.4]))
    np.testing.assert_allclose(quaternion_to_matrix(moved[3:])[2], [0.0, 0.0, 1.0], atol=1e-12)


def test_a_pose_moves_only_where_its_position_counts():
    delta, full = np.array([0.2, 0.2]), TASKS['HandManipulateBlockFull']
    goal = example_goal(full)
    (handle,) = handles(full, goal)
    np.testing.assert_array_equal(handle.position, ghost_pose(full, goal)[:3])
    moved = moved_goal(full, goal, handle, ray_at(goal[:3] + 0.02), False, delta)
    np.testing.assert_array_equal(moved[3:], goal[3:])
    assert np.abs(moved[:3] - goal[:3]).max() > 1e-3


class Hands:
    """Stands for ImGui: the user chooses a finger and moves one slider by 1 cm."""

    def __init__(self, finger, axis):
        self.finger, self.axis = finger, axis
        self.sliders = {}

    def __getattr__(self, name):
        return lambda *arguments: None

    def Checkbox(self, label, value):
        return False, value

    def Combo(self, label, index, names):
        return index != self.finger, self.finger

    def SliderFloat(self, label, value, lower, upper):
        self.sliders[label] = value, lower, upper
        return label[0] == self.axis, value + 0.01 * (label[0] == self.axis)


@pytest.mark.parametrize('finger', range(5))
@pytest.mark.parametrize('axis', 'xyz')
def test_each_fingertip_has_sliders_for_its_goal(monkeypatch, finger, axis):
    spec, sent = TASKS['HandReach'], []
    goal = np.linspace(0.1, 1.5, spec.goal.size)
    monkeypatch.setattr(goal_panel, 'imgui', hands := Hands(finger, axis))
    GoalPanel(sent.append).draw(spec, goal)
    assert list(hands.sliders) == ['x (m)', 'y (m)', 'z (m)']
    assert [value for value, _, _ in hands.sliders.values()] == list(goal.reshape(5, 3)[finger])
    (request,) = sent
    moved = np.zeros(spec.goal.size)
    moved[3 * finger + 'xyz'.index(axis)] = 0.01
    np.testing.assert_allclose(request.values - goal, moved, atol=1e-12)
    assert request.is_kept


def test_sliders_for_fingertips_reach_the_goals_of_the_task():
    simulation = Simulation('HandReach', num_threads=1)
    goals = [simulation.reset(seed=seed)['desired_goal'].reshape(5, 3) for seed in range(100)]
    for axis, (lower, upper) in enumerate(position_ranges(TASKS['HandReach'])):
        values = np.array(goals)[..., axis]
        assert -FARTHEST_GOAL <= lower < values.min() and values.max() < upper <= FARTHEST_GOAL
