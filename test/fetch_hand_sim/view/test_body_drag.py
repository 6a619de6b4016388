"""Pulling at bodies with the mouse: who is taken, how hard, and what the robot gets of it."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from mujoco.studio import messages

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rendering import make_options, simulation_frame
from fetch_hand_sim.simulation.scene import GHOST, Scene
from fetch_hand_sim.view.page.body_drag import BodyDrag, can_be_pulled, pulls
from fetch_hand_sim.view.page.ray import MousePlace, mouse_ray
from fetch_hand_sim.view.requests import Push
from fetch_hand_sim.view.session import Requests
from msgs_spec.tasks import TASKS
from support.tasks import each_task

ASPECT = 1.5
LIMIT = 10.0


class Window:
    """The parts of a viewer: a model with its state, a camera, a perturbation."""

    def __init__(self, task):
        self.scene = Scene(task)
        simulation = Simulation(task, num_threads=1)
        simulation.reset(seed=1)
        self.scene.show(simulation_frame(simulation))
        self.model, self.data = self.scene.model, self.scene.data
        mujoco.mj_forward(self.model, self.data)
        self.camera = mujoco.MjvCamera()
        self.scene.view.apply(self.camera)
        self.perturb, self.vis_options = mujoco.MjvPerturb(), make_options()
        self.drag = BodyDrag(self)

    def ray_at(self, point):
        center = mouse_ray(self.scene.view, 45.0, MousePlace(0.5, 0.5, ASPECT))
        toward = point - center.origin
        return dataclasses.replace(center, direction=toward / np.linalg.norm(toward))

    def begin_at(self, point):
        return self.drag.begin(self.ray_at(point), LIMIT)


@pytest.mark.parametrize('task', ['FetchPush', 'FetchSlide', 'HandManipulateBlockFull'])
def test_the_object_is_taken_where_it_is_seen_and_follows_the_mouse(task):
    window = Window(task)
    assert not window.begin_at(np.array([1.3, 0.7, 3.0])), 'nothing is there'
    assert not window.drag.is_pulling
    assert window.begin_at(window.data.body(TASKS[task].object_name).xpos)
    assert window.drag.is_pulling
    ((body, still),) = pulls(window.model, window.drag.move((0.0, 0.0))) or (('', np.zeros(6)),)
    assert body in ('', TASKS[task].object_name) and np.abs(still).max() < 1e-6
    ((body, wrench),) = pulls(window.model, window.drag.move((0.0, -0.02)))
    assert body == TASKS[task].object_name
    assert wrench[2] > 0.0 and wrench[2] > 0.5 * np.linalg.norm(wrench[:3])
    ((_, harder),) = pulls(window.model, window.drag.move((0.0, -0.02)))
    assert np.linalg.norm(harder[:3]) > 1.5 * np.linalg.norm(wrench[:3])
    window.drag.end()
    assert not window.drag.is_pulling and not window.data.xfrc_applied.any()


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach'])
def test_the_pull_reaches_the_limit_a_tenth_of_the_view_away(task):
    """The pull does not depend on the mass of the body, so fingers are as easy to pull as arms."""
    window = Window(task)
    name = 'robot0:gripper_link' if task == 'FetchReach' else 'robot0:palm'
    assert window.begin_at(window.data.body(name).xpos)
    total = 0.0
    for _ in range(40):
        # The picture is as high as what is seen of the world at that distance.
        total += 0.01
        ((_, wrench),) = pulls(window.model, window.drag.move((0.0, -0.01)))
        if np.linalg.norm(wrench[:3]) >= LIMIT:
            break
    assert total * 2.0 * np.tan(np.radians(22.5)) == pytest.approx(0.1, rel=0.4)


@each_task
def test_world_table_and_ghost_cannot_be_pulled(task):
    model = Scene(task).model
    names = {model.body(i).name for i in range(model.nbody) if can_be_pulled(model, i)}
    assert not names & {'world', 'table0', 'floor0', GHOST, '', 'robot0:mocap'}
    expected = 'robot0:gripper_link' if task.startswith('Fetch') else 'robot0:ffdistal'
    assert expected in names
    assert TASKS[task].object_name is None or TASKS[task].object_name in names


@pytest.mark.parametrize('kind', ['other size', 'other state', 'nan'])
def test_what_is_no_pull_at_this_model_is_none(kind):
    model = Scene('FetchPush').model
    forces = mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
    state = np.ones(6 * model.nbody)
    if kind == 'other size':
        state = state[:-6]
    if kind == 'other state':
        forces = mujoco.mjtState.mjSTATE_QPOS.value
    if kind == 'nan':
        state[:] = np.nan
    assert pulls(model, messages.PerturbSnapshot(state, forces)) == []


def test_the_viewers_message_becomes_a_push():
    scene, asked = Scene('FetchPush'), []
    requests = Requests(asked.append)
    requests.handle = type('Handle', (), {'model': scene.model})()
    state = np.zeros((scene.model.nbody, 6))
    state[scene.model.body('object0').id] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    forces = mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
    assert requests.on_message(messages.PerturbSnapshot(state.ravel(), forces))
    (push,) = asked
    assert isinstance(push, Push) and push.body == 'object0'
    np.testing.assert_array_equal(push.wrench, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
