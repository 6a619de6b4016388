"""Every task against Gymnasium-Robotics 1.4.2 in fresh instances, on the same MuJoCo."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import TASKS, substeps_per_tick
from support import SUPPORT
from support.gymnasium_robotics_oracle import random_actions

STEPS = 100
TOLERANCE = 1e-9
ORACLE = SUPPORT / 'gymnasium_robotics_oracle.py'


@pytest.fixture(scope='module')
def play_reference(tmp_path_factory):
    """Plays episodes of a task in the reference; keeps the last answer."""
    directory = tmp_path_factory.mktemp('oracle')

    def play(task: str, seeds: int, control_hz: float = 25.0) -> dict[str, np.ndarray]:
        path = directory / f'{task}_{seeds}_{control_hz}.npz'
        if not path.exists():
            substeps = substeps_per_tick(control_hz)
            arguments = [TASKS[task].reference_id, seeds, STEPS, substeps, path]
            command = [sys.executable, '-O', ORACLE, *arguments]
            subprocess.run(
                [str(part) for part in command], check=True, cwd=directory, capture_output=True
            )
        with np.load(path) as arrays:
            return dict(arrays)

    return play


def play(simulation: Simulation, seeds: list[int]) -> dict[str, np.ndarray]:
    """Plays the oracle's actions: arrays (seeds, steps + 1, ...), rewards of both kinds."""
    observation = simulation.reset(seed=seeds)
    size = simulation.spec.robot.action_size
    actions = np.stack([random_actions(seed, STEPS, size) for seed in seeds], axis=1)
    kind = simulation.metric.reward_type
    rows = [observation | {kind: np.zeros(len(seeds)), 'is_success': np.zeros(len(seeds))}]
    for action in actions:
        result = simulation.step(action)
        assert not result.diverged.any()
        rows.append(result.observation | {kind: result.reward, 'is_success': result.success})
    return {name: np.stack([row[name] for row in rows], axis=1) for name in rows[0]}


def assert_equal(ours: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> None:
    for name, values in ours.items():
        assert values.shape == reference[name].shape, name
        assert np.abs(values.astype(float) - reference[name]).max() <= TOLERANCE, name


@pytest.mark.parametrize('task', TASKS)
def test_a_single_simulation_and_a_batch_equal_the_reference(task, twin_seeds, play_reference):
    reference = play_reference(task, len(twin_seeds))
    simulation = Simulation(task, num_envs=1, num_threads=1)
    for seed in twin_seeds:
        assert_equal(
            play(simulation, [seed]), {name: a[seed : seed + 1] for name, a in reference.items()}
        )
    # The compared episodes are the last ones of a larger batch.
    count = 8 * len(twin_seeds)
    simulation = Simulation(task, num_envs=count, num_threads=3, reward_type='dense')
    ours = play(simulation, list(reversed(range(count))))
    seeds = count - 1 - np.array(twin_seeds)
    assert_equal({name: rows[seeds] for name, rows in ours.items()}, reference)


@pytest.mark.parametrize('task', ['HandReach', 'HandManipulateEggFull'])
def test_half_the_action_frequency_equals_the_reference(task, play_reference):
    reference = play_reference(task, 1, control_hz=12.5)
    simulation = Simulation(task, control_hz=12.5, timing='ticks')
    assert simulation.tick_duration == pytest.approx(0.08)
    assert_equal(play(simulation, [0]), reference)


def test_the_comparison_can_fail(play_reference):
    reference = play_reference('FetchReach', 1)
    other = play(Simulation('FetchReach', control_hz=500 / 21), [0])
    with pytest.raises(AssertionError):
        assert_equal(other, reference)
