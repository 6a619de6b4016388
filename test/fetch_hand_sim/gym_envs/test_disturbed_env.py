"""Environments with `disturbances` and the reset option `variation`."""

from __future__ import annotations

import copy
import json
import pickle

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import fetch_hand_sim
from fetch_hand_sim.simulation import Simulation
from msgs_spec.disturbances import Disturbances

LATE = {'action': {'latency': 1}, 'physics': {'friction': [0.5, 2.0]}}


def rollout(env, seed=3, ticks=8, **options):
    observation, _ = env.reset(seed=seed, **options)
    shape = env.action_space.shape
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (ticks, *shape)).astype(np.float32)
    found = [observation['observation']]
    found += [env.step(action)[0]['observation'] for action in actions]
    return np.array(found)


def forms_of(path):
    file = path / 'late.json'
    file.write_text(json.dumps(LATE))
    return [LATE, str(file), Disturbances.from_dict(LATE)]


def test_environments_take_every_form_and_equal_the_simulation(tmp_path):
    simulation = Simulation('FetchPush', disturbances=LATE)
    expected = [simulation.reset(seed=3)['observation'][0]]
    single = fetch_hand_sim.make('FetchPush')
    generator = np.random.default_rng(3)
    for action in generator.uniform(-1.0, 1.0, (8, 4)).astype(np.float32):
        expected.append(simulation.step(action[None]).observation['observation'][0])
    for given in forms_of(tmp_path):
        env = fetch_hand_sim.make('FetchPush', disturbances=given)
        assert np.array_equal(rollout(env), expected)
    batch = fetch_hand_sim.make_vec('FetchPush', 1, disturbances=LATE)
    assert np.array_equal(rollout(batch)[:, 0], expected)
    assert not np.array_equal(rollout(single), expected)
    off = fetch_hand_sim.make('FetchPush', disturbances=None)
    assert np.array_equal(rollout(off), rollout(single))


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach'])
def test_a_disturbed_environment_passes_gymnasiums_check(task):
    check_env(fetch_hand_sim.make(task, disturbances='hardware').unwrapped, skip_render_check=True)


@pytest.mark.parametrize('task', ['FetchPush', 'HandManipulateBlockFull'])
def test_looking_at_model_and_data_changes_nothing(task):
    plain = fetch_hand_sim.make(task, disturbances='hardware')
    expected = rollout(plain)
    looked_at = fetch_hand_sim.make(task, disturbances='hardware')
    assert looked_at.unwrapped.data is not None
    assert looked_at.unwrapped.model is not None
    assert np.array_equal(rollout(looked_at), expected)
    looked_at.unwrapped.model.opt.timestep = 0.001
    with pytest.raises(ValueError, match='cannot be changed while disturbances vary'):
        looked_at.step(looked_at.action_space.sample())


def test_physics_cannot_vary_after_the_model_was_changed():
    env = fetch_hand_sim.make('FetchPush', disturbances={'action': {'latency': 1}})
    env.unwrapped.model.geom_friction[:] *= 0.5
    env.reset(seed=0)
    with pytest.raises(ValueError, match='object_mass cannot vary'):
        env.reset(options={'variation': {'object_mass': 2.0}})
    env.reset(options={'variation': {'action_latency': 2}})


def test_an_episode_has_the_variation_that_was_asked_for():
    env = fetch_hand_sim.make('FetchPush', disturbances=LATE)
    asked = {'friction': 0.7, 'object_mass': 2.0, 'action_latency': 3}
    asked |= {'gravity_tilt': 0.3, 'gravity_direction': 0.0}
    env.reset(seed=1, options={'variation': asked})
    found = env.unwrapped.simulation.variation(0)
    assert {name: found[name] for name in asked} == asked
    for again in (copy.deepcopy(env.unwrapped), pickle.loads(pickle.dumps(env.unwrapped))):
        action = np.ones(4, np.float32)
        expected = copy.deepcopy(env.unwrapped).step(action)[0]['observation']
        assert np.array_equal(again.step(action)[0]['observation'], expected)
    varied, plain = env.step(action)[0], fetch_hand_sim.make('FetchPush', disturbances=LATE)
    env.reset(seed=1)
    assert env.unwrapped.simulation.variation(0)['object_mass'] == 1.0
    plain.reset(seed=1)
    plain = plain.step(action)[0]
    assert not np.array_equal(plain['observation'], varied['observation'])
    assert np.array_equal(env.step(action)[0]['observation'], plain['observation'])
