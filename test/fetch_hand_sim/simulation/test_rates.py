"""Other rates than 25 Hz: the same seconds, speeds and starts; at 25 Hz the same bits."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import fetch_hand_sim
from fetch_hand_sim.gym_envs.registration import environment_id
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.tasks.fetch import lead_scale
from msgs_spec.tasks import TASKS
from support.tasks import each_task

RATES = [12.5, 125.0, 250.0, 500.0]


def play(simulation: Simulation, ticks: int) -> list[bytes]:
    """Every bit of some ticks under random actions, float32 and float64 in turns."""
    generator = np.random.default_rng(0)
    rows = list(simulation.reset(seed=1).values())
    for tick in range(ticks):
        action = generator.uniform(-1.0, 1.0, (simulation.num_envs, 20))
        action = action[:, : simulation.spec.robot.action_size]
        result = simulation.step(action.astype(np.float32) if tick % 2 else action)
        rows += result.observation.values()
    return [row.tobytes() for row in (*rows, simulation.task.batch.state)]


@each_task
def test_at_25_hz_nothing_depends_on_the_timing(task):
    simulations = [
        Simulation(task, num_threads=1, timing=timing) for timing in ('seconds', 'ticks')
    ]
    first, second = (play(simulation, 10) for simulation in simulations)
    assert first == second
    assert simulations[0].spec == TASKS[task]
    assert lead_scale(25.0) == 1.0
    copied = pickle.loads(pickle.dumps(simulations[1]))
    assert copied.timing == 'ticks'
    in_ticks = Simulation(task, control_hz=250, timing='ticks').spec
    assert in_ticks.episode_ticks == TASKS[task].episode_ticks


def speed(control_hz: float, timing: str, command: float = 1.0) -> float:
    """Metres per second of the gripper along y, after it has gathered speed."""
    simulation = Simulation('FetchReach', num_threads=1, control_hz=control_hz, timing=timing)
    simulation.reset(seed=0)
    places = []
    for _ in range(round(0.4 * control_hz)):
        result = simulation.step([[0.0, command, 0.0, 0.0]])
        places.append(result.observation['achieved_goal'][0, 1])
    return (places[-1] - places[round(0.16 * control_hz) - 1]) / 0.24


@pytest.mark.parametrize('control_hz', RATES)
def test_the_gripper_is_as_fast_at_every_rate(control_hz):
    for command in (1.0, -0.3):
        wanted = speed(25.0, 'seconds', command)
        assert speed(control_hz, 'seconds', command) == pytest.approx(wanted, rel=0.02)


def test_the_same_step_was_another_speed_and_a_tenth_of_it_would_be_a_seventh():
    assert speed(250.0, 'ticks') / speed(25.0, 'ticks') == pytest.approx(1.45, abs=0.02)
    assert speed(250.0, 'ticks', 0.1) / speed(25.0, 'ticks') == pytest.approx(0.145, abs=0.01)


@pytest.mark.parametrize('task', ['HandManipulateEggFull', 'FetchPush', 'HandReach'])
def test_a_seed_starts_the_same_episode_at_every_rate(task):
    starts = [Simulation(task, num_threads=1, control_hz=hz) for hz in (25.0, 500.0, 12.5)]
    observations = [simulation.reset(seed=5) for simulation in starts]
    states = [simulation.task.batch.state.tobytes() for simulation in starts]
    assert states[0] == states[1] == states[2]
    for observation in observations[1:]:
        np.testing.assert_array_equal(observation['desired_goal'], observations[0]['desired_goal'])


def test_environments_are_truncated_after_the_seconds_of_an_episode():
    name = environment_id('FetchReach')
    for made, ticks in (
        (fetch_hand_sim.make(name, control_hz=25), 50),
        (fetch_hand_sim.make(name, control_hz=500 / 3), 333),
        (fetch_hand_sim.make(name, control_hz=250, max_episode_steps=None), 500),
        (fetch_hand_sim.make(f'fetch_hand_sim:{name}', control_hz=250, max_episode_steps=3), 3),
        (slow := fetch_hand_sim.make(name, control_hz=12.5), 25),
        (fetch_hand_sim.make(slow.spec), 25),
        (fetch_hand_sim.make(slow.spec, control_hz=25), 50),
        (fetch_hand_sim.make_vec(slow.spec, 2), 25),
        (fast := fetch_hand_sim.make_vec(name, 2, control_hz=50), 100),
        (fetch_hand_sim.make_vec(fast.spec), 100),
        (fetch_hand_sim.make_vec(name, 2, max_episode_steps=3), 3),
        (fetch_hand_sim.make_vec(name, 2, max_episode_steps=-1), None),
    ):
        assert made.spec.max_episode_steps == ticks
    with pytest.warns(UserWarning, match='latest versioned environment'):
        unversioned = fetch_hand_sim.make(name.removesuffix('-v0'), control_hz=12.5)
    assert unversioned.spec.max_episode_steps == 25
    env, ended = fetch_hand_sim.make_vec(name, num_envs=2, control_hz=12.5), []
    env.reset(seed=0)
    for _ in range(25):
        *_, truncated, _ = env.step(np.zeros((2, 4), np.float32))
        ended.append(truncated.all())
    assert ended == [False] * 24 + [True]
