"""The tuned models against the published ones: the same contacts, the same trajectories."""

from __future__ import annotations

import copy
import itertools
import pickle

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.models import FETCH_NEVER_TOUCHING, load_model
from fetch_hand_sim.simulation.tasks.registry import task_asset
from msgs_spec.robots import FETCH
from support.tasks import each_task

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
    names = ('geom', 'dist', 'pos', 'frame', 'friction', 'solref', 'solimp', 'includemargin', 'dim')
    return [getattr(data.contact, name).tobytes() for name in names]


@each_task
def test_contacts_and_trajectories_are_those_of_the_published_model(task):
    simulation = Simulation(task, num_envs=32, num_threads=2)
    simulation.reset(seed=0)
    batch = simulation.task.batch
    published = published_model(task, simulation.model)
    reference = Batch(published, 32, 2)
    generator = np.random.default_rng(0)
    kinds = set()
    # Each robot has a direction of its own, so that they go far and touch much.
    drift, noise = generator.uniform(-1.0, 1.0, (2, 32, simulation.spec.robot.action_size))
    for tick in range(25):
        noise = generator.permuted(noise)
        actions = np.clip(drift + 0.5 * noise, -1.0, 1.0)
        before = batch.state.copy()
        simulation.step(actions)
        if tick % 8 == 0:
            for state in batch.state[::4]:
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


def test_excluded_bodies_keep_their_distance_in_all_positions():
    model = load_model('fetch/push.xml')
    data = mujoco.MjData(model)
    data.qpos[:] = Simulation('FetchPush', num_threads=1).data(0).qpos
    joints = [model.joint(name) for name in FETCH.joints if name not in FIXED]
    lower, upper = np.transpose(
        [
            each.range + OVERSHOOT[each.type.item()] * np.array([-1.0, 1.0])
            if each.limited
            else [-np.pi, np.pi]
            for each in joints
        ]
    )
    ids = [[model.body(name).id for name in bodies] for bodies in FETCH_NEVER_TOUCHING]
    geoms = [[np.flatnonzero(model.geom_bodyid == body) for body in pair] for pair in ids]
    pairs = [pair for each in geoms for pair in itertools.product(*each)]
    generator = np.random.default_rng(0)
    for _ in range(2000):
        # Every second joint is at a limit.
        share = generator.uniform(-0.5, 1.5, len(joints)).clip(0.0, 1.0)
        data.qpos[[each.qposadr[0] for each in joints]] = lower + share * (upper - lower)
        mujoco.mj_kinematics(model, data)
        for pair in pairs:
            distance = mujoco.mj_geomDistance(model, data, *pair, 2 * CLEARANCE, None)
            assert distance > CLEARANCE, [model.body(model.geom_bodyid[geom]).name for geom in pair]


# Not larger geoms, margins and gaps: the published model compares bodies first, with the bounding
# volumes and margins of the compiler, and misses contacts (docs/gymnasium_robotics.md).
CHANGES = {
    'friction': 0.01,
    'solref': [0.05, 0.7],
    'solimp': [0.5, 0.9, 0.01, 0.4, 1.5],
    'condim': 1,
    'solmix': 3.0,
    'priority': 1,
    'size': 0.004,
    'gap': 0.0003,
}


def write(model: mujoco.MjModel, field: str, geoms: np.ndarray) -> None:
    """Change friction, or another contact field, of some geoms."""
    getattr(model, f'geom_{field}')[geoms] = CHANGES[field]
    if field in ('solmix', 'priority'):
        # These alone change nothing where both geoms have the same.
        model.geom_friction[geoms] = 0.3
        model.geom_solref[geoms] = [0.03, 0.8]


@pytest.fixture(scope='module', params=['HandManipulatePenFull', 'HandManipulateBlockFull'])
def touching(request):
    """A pickled simulation with many contacts, and the published model."""
    simulation = Simulation(request.param, num_envs=16, num_threads=1)
    simulation.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(10):
        simulation.step(generator.uniform(-1.0, 1.0, (16, 20)))
    return pickle.dumps(simulation), published_model(request.param, simulation.model)


@pytest.mark.parametrize('field', CHANGES)
def test_contacts_are_of_what_is_written_into_geoms(field, touching):
    """As in the published model, which has no list of pairs to look at first."""
    simulation, published = pickle.loads(touching[0]), copy.copy(touching[1])
    states = simulation.task.batch.state
    before = [contacts(simulation.model, state) for state in states]
    geoms = np.arange(0, simulation.model.ngeom, 2)
    for model in (simulation.model, published):
        write(model, field, geoms)
    simulation.apply_model_changes()
    found = [contacts(simulation.model, state) for state in states]
    assert found == [contacts(published, state) for state in states]
    assert found != before


def test_pairs_written_by_the_user_stay_until_their_geoms_change():
    simulation = Simulation('HandManipulateEggFull', num_threads=1)
    model = simulation.model
    simulation.apply_model_changes()
    model.pair_margin[:] = 0.001
    simulation.apply_model_changes()
    assert (model.pair_margin == 0.001).all()
    twin = pickle.loads(pickle.dumps(simulation))
    assert (twin.model.pair_margin == 0.001).all()
    for each in (model, twin.model):
        each.geom_margin[:], each.geom_gap[:] = 0.002, 0.001
    for each in (simulation, twin):
        each.apply_model_changes()
        assert set(each.model.pair_margin.tolist()) == {0.001, 0.004}
        assert set(each.model.pair_gap.tolist()) == {0.0, 0.002}
    model.geom_friction[:, 0] = 0.1
    copied = pickle.loads(pickle.dumps(simulation))
    simulation.apply_model_changes()
    copied.apply_model_changes()
    assert copied.model.pair_friction.tobytes() == model.pair_friction.tobytes()
