"""The tuned models against the published ones: the same contacts, the same trajectories."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.model_tuning import FETCH_NEVER_TOUCHING
from fetch_hand_sim.simulation.models import load_model
from fetch_hand_sim.simulation.tasks.registry import task_asset

# One of each model.
TASKS = (
    *('FetchReach', 'FetchPush', 'FetchSlide', 'FetchPickAndPlace', 'HandReach'),
    *('HandManipulateBlockFull', 'HandManipulateEggFull', 'HandManipulatePenFull'),
)
# Joints that hold the Fetch base, with damping 1e11: they do not move.
FIXED = ('robot0:slide0', 'robot0:slide1', 'robot0:slide2')
CLEARANCE = 0.01
# How far beyond their limits, which are soft, joints are tried: metres and radians.
OVERSHOOT = {mujoco.mjtJoint.mjJNT_SLIDE: 0.1, mujoco.mjtJoint.mjJNT_HINGE: 0.3}


def published_model(task: str, tuned: mujoco.MjModel) -> mujoco.MjModel:
    """The model as published, with the weld of the mocap body set as the simulation sets it."""
    model = load_model(task_asset(task))
    model.eq_data[:] = tuned.eq_data
    return model


def contacts(model: mujoco.MjModel, state: np.ndarray) -> list[bytes]:
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)
    c = data.contact
    fields = (
        c.geom,
        c.dist,
        c.pos,
        c.frame,
        c.friction,
        c.solref,
        c.solimp,
        c.includemargin,
        c.dim,
    )
    return [field.tobytes() for field in fields]


@pytest.mark.parametrize('task', TASKS)
def test_contacts_and_trajectories_are_those_of_the_published_model(task):
    simulation = Simulation(task, num_envs=48, num_threads=2)
    simulation.reset(seed=0)
    batch = simulation.task.batch
    published = published_model(task, simulation.model)
    reference = Batch(published, 48, 2)
    generator = np.random.default_rng(0)
    kinds = set()
    # Each robot has a direction of its own, so that they go far and touch much.
    drift, noise = generator.uniform(-1.0, 1.0, (2, 48, simulation.spec.robot.action_size))
    for tick in range(25):
        noise = generator.permuted(noise)
        actions = np.clip(drift + 0.5 * noise, -1.0, 1.0)
        before = batch.state.copy()
        simulation.step(actions)
        if tick % 8 == 0:
            for state in batch.state[::6]:
                found = contacts(simulation.model, state)
                assert found == contacts(published, state)
                kinds.add(found[0])
        reference.state[:] = before
        applied = {'ctrl', 'mocap_pos', 'mocap_quat'} if published.nmocap else {'ctrl'}
        for name in applied:
            reference.bind(name)[:] = batch.bind(name)
        reference.step(nstep=20)
        ours = batch.bind('qvel')
        assert reference.bind('qvel').tobytes() == np.ascontiguousarray(ours).tobytes()
    assert len(kinds) > 1, 'contacts must come and go'


def moving_joints(model: mujoco.MjModel, bodies: tuple[str, str]) -> list[int]:
    """Joints on which the pose of one body relative to the other depends."""
    chains = []
    for name in bodies:
        body, joints = model.body(name).id, set()
        while body:
            first = model.body_jntadr[body]
            joints |= set(range(first, first + model.body_jntnum[body])) if first >= 0 else set()
            body = model.body_parentid[body]
        chains.append(joints)
    return [j for j in sorted(chains[0] ^ chains[1]) if model.joint(j).name not in FIXED]


@pytest.mark.parametrize('bodies', FETCH_NEVER_TOUCHING, ids='-'.join)
def test_excluded_bodies_keep_their_distance_in_all_positions(bodies):
    model = load_model('fetch/push.xml')
    data = mujoco.MjData(model)
    data.qpos[:] = Simulation('FetchPush').data(0).qpos
    joints = moving_joints(model, bodies)
    assert len(joints) <= 4
    points = {0: 1, 1: 400, 2: 40, 3: 14, 4: 8}[len(joints)]
    ranges = [
        model.jnt_range[j] + OVERSHOOT[int(model.jnt_type[j])] * np.array([-1.0, 1.0])
        if model.jnt_limited[j]
        else [-np.pi, np.pi]
        for j in joints
    ]
    geoms = [
        [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body(name).id]
        for name in bodies
    ]
    for positions in itertools.product(*(np.linspace(*limits, points) for limits in ranges)):
        data.qpos[model.jnt_qposadr[joints]] = positions
        mujoco.mj_kinematics(model, data)
        for first, second in itertools.product(*geoms):
            distance = mujoco.mj_geomDistance(model, data, first, second, 2 * CLEARANCE, None)
            assert distance > CLEARANCE, dict(zip(joints, positions, strict=True))


@pytest.mark.parametrize('task', TASKS)
def test_nothing_else_differs_from_the_published_model(task):
    tuned = Simulation(task).model
    published = published_model(task, tuned)
    for name in ('nq', 'nv', 'nu', 'nbody', 'ngeom', 'neq', 'ntendon', 'nmocap'):
        assert getattr(tuned, name) == getattr(published, name), name
    for name in ('body_mass', 'body_inertia', 'dof_damping', 'geom_size', 'actuator_gainprm'):
        assert getattr(tuned, name).tobytes() == getattr(published, name).tobytes(), name
