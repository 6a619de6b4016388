"""The batched simulation: reproducible to the bit, deaf to bad input, robust to divergence."""

from __future__ import annotations

import copy
import gc
import logging
import os
import subprocess
import sys
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from mujoco.batch import SimulationError

from fetch_hand_sim.simulation import Simulation, StepResult
from msgs_spec.robots import command_from_action
from msgs_spec.rotations import quaternion_from_axis_angle, quaternion_multiply
from support import peak_memory, reset_peak_memory
from support.same_bits import assert_same
from support.tasks import each_task


def actions(simulation: Simulation, steps: int, seed: int = 0) -> np.ndarray:
    """Random actions (steps, N, action size)."""
    shape = (steps, simulation.num_envs, simulation.spec.robot.action_size)
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def play(step: Callable[[np.ndarray], StepResult], played: np.ndarray) -> np.ndarray:
    """All values that the steps return, (steps, N, values)."""
    rows = []
    for action in played:
        result = step(action)
        parts = [*result.observation.values(), result.reward[:, None], result.success[:, None]]
        rows.append(np.concatenate(parts, axis=1))
    return np.array(rows)


def state_of(simulation: Simulation) -> bytes:
    """All bits that decide what happens next, generators and goals included."""
    # `pickle` stores this.
    generators = simulation.__getstate__()['generators']
    generators = [each and each.bit_generator.state for each in generators]
    state = simulation.task.batch.state.tobytes() + simulation.goals.tobytes()
    return state + repr(generators).encode()


@each_task
def test_neither_number_of_the_episode_nor_neighbours_nor_threads_nor_units_change_a_bit(task):
    batch = Simulation(task, num_envs=24, num_threads=1)
    threaded = Simulation(task, num_envs=24, num_threads=3)
    single = Simulation(task, num_envs=1)
    played = actions(batch, 6)
    first, _, _ = batch.reset(seed=100), threaded.reset(seed=100), single.reset(seed=117)
    state = state_of(batch)
    expected = play(batch.step, played)
    assert_same(play(threaded.step, played), expected)
    commands = command_from_action(single.spec.robot, played[:, 17:18])
    assert_same(play(single.step_commands, commands), expected[:, 17:18])
    batch.reset()
    play(batch.step, actions(batch, 6, seed=1))
    assert_same(batch.reset(seed=100), first)
    assert state_of(batch) == state
    assert_same(play(batch.step, played), expected)


@pytest.mark.parametrize(('may_use', 'num_envs', 'threads'), [(1, 3, 1), (4, 3, 3), (2, 3, 2)])
def test_threads_are_as_many_as_processors_that_may_be_used(
    may_use, num_envs, threads, monkeypatch
):
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: set(range(may_use)))
    assert Simulation('FetchReach', num_envs).task.batch.nthread == threads


def test_seeds_ids_and_goals_come_in_the_order_of_the_simulations():
    simulation = Simulation('FetchPush', num_envs=3, num_threads=1)
    with pytest.raises(ResetNeeded, match=r'simulations \[0, 1, 2\]'):
        simulation.step(np.zeros((3, 4)))
    simulation.reset(seed=0, ids=[0, 2])
    for call in (simulation.step, copy.deepcopy(simulation).step_commands):
        with pytest.raises(ResetNeeded, match=r'simulations \[1\]'):
            call(np.zeros((3, 4)))
    expected = simulation.reset(seed=[5, 0, 6])
    observation = simulation.reset(seed=[6, 5], ids=[2, 0])
    assert_same(observation, expected)
    # A shallow copy shares no generator, and without a seed the generators continue.
    goals = [simulation.reset()['desired_goal'] for _ in range(2)]
    copied = copy.copy(simulation)
    simulation.reset(seed=[5, 0, 6])
    assert not np.array_equal(*goals)
    assert np.array_equal([simulation.reset()['desired_goal'] for _ in range(2)], goals)
    copied.reset(seed=7)
    simulation.set_goal([[1.3, 0.7, 0.6], [1.2, 0.8, 0.5]], ids=[2, 0])
    assert simulation.goals[[2, 0]].tolist() == [[1.3, 0.7, 0.6], [1.2, 0.8, 0.5]]
    simulation.goals = live = np.ones((3, 3))
    live[1] = 2.0
    assert simulation.step(np.zeros((3, 4))).observation['desired_goal'][1].tolist() == [2.0] * 3
    simulation.reset(ids=[2, 0], goal=[None, live[1]])
    assert simulation.goals[:2].tolist() == [[2.0] * 3] * 2


def test_returned_arrays_are_copies():
    simulation = Simulation('HandManipulateEggFull')
    simulation.reset(seed=[0])
    before = state_of(simulation)
    for values in simulation.observe().values():
        values[:] = 7.0
    assert state_of(simulation) == before


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'task': 'FetchJump'}, "unknown task 'FetchJump'; allowed: FetchReach, "),
        ({'num_envs': 0}, 'num_envs 0; allowed: whole numbers 1 ... 2147483647'),
        ({'num_threads': -1}, 'num_threads -1; '),
        ({'reward_type': 'shaped'}, "reward_type 'shaped'; allowed: sparse"),
        ({'success_rule': 'mine'}, "success_rule 'mine'; allowed: gymnasium"),
        ({'timing': 'minutes'}, "timing 'minutes'; allowed: seconds, ticks"),
        ({'control_hz': float('nan')}, 'control_hz nan'),
        ({'control_hz': 10**400}, 'control_hz inf'),
        ({'keeps_data': ''}, "keeps_data ''; allowed: True or False"),
    ],
)
def test_bad_simulations_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Simulation(**({'task': 'FetchReach'} | arguments))


class GivesUp:
    """A batch whose third simulation diverges at the next step."""

    def __init__(self, batch):
        self._batch, self._errors = batch, [SimulationError(np.array([2]), 'no room')]

    def __getattr__(self, name):
        return getattr(self._batch, name)

    def step(self, *args, **kwargs):
        self._batch.step(*args, **kwargs)
        if self._errors:
            raise self._errors.pop()


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach', 'HandManipulateBlockFull'])
def test_a_diverged_simulation_starts_again_and_the_others_go_on(
    task, caplog, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    simulation = Simulation(task, num_envs=4, num_threads=2)
    undisturbed = Simulation(task, num_envs=4, num_threads=2)
    for each in (simulation, undisturbed):
        each.reset(seed=0)
    simulation.task.batch.bind('qvel')[2, 3] = np.nan
    action = actions(simulation, 1)[0]
    with caplog.at_level(logging.WARNING):
        result = simulation.step(action)
    expected = undisturbed.step(action)
    assert result.diverged.tolist() == [False, False, True, False]
    assert simulation.divergences == 1
    assert f'{task}: MuJoCo reports simulations [2] as diverged' in caplog.text
    others = [0, 1, 3]
    for name, values in result.observation.items():
        assert values[others].tobytes() == expected.observation[name][others].tobytes()
    # Its new episode is what its generator gives next.
    fresh = undisturbed.reset(ids=[2])
    for name, values in result.observation.items():
        assert values[2].tobytes() == fresh[name][2].tobytes()
    undisturbed.step(action)
    assert not simulation.step(action).diverged.any()
    # A full stack of MuJoCo: the batch steps the others and raises an error at its end.
    with monkeypatch.context() as patch:
        patch.setattr(simulation.task, 'batch', GivesUp(simulation.task.batch))
        result, expected = simulation.step(action), undisturbed.step(action)
    assert result.diverged.tolist() == [False, False, True, False]
    for name, values in result.observation.items():
        assert values[others].tobytes() == expected.observation[name][others].tobytes()
    # MuJoCo counts each loss as the first: the state that it throws away has the counter.
    for number, lost in enumerate((np.nan, 1e12, np.nan), 3):
        simulation.task.batch.bind('qvel')[2, 1] = lost
        assert simulation.step(action).diverged.tolist() == [False, False, True, False]
        assert simulation.divergences == number
        assert not simulation.step(action).diverged.any()
    assert not list(tmp_path.iterdir()), 'MuJoCo wrote a file into the working directory'


def step(place: tuple[int, ...], value: float) -> Any:
    def call(simulation: Simulation) -> None:
        actions = np.zeros((2, 4))
        actions[place] = value
        simulation.step(actions)

    return call


def push(body: Any = 'object0', wrench: Any = (1, 0, 0, 0, 0, 0), index: Any = 0) -> Any:
    return lambda one: one.perturb(body, wrench, index)


BAD_CALLS = [
    (lambda one: one.step(np.zeros((2, 3))), r'actions: shape .2, 3. given; .*\(2, 4\)'),
    (lambda one: one.step(np.full((2, 4), 'left')), 'actions: .*left.* given'),
    (step((1, 2), np.nan), r'actions\[1, 2\] is nan'),
    (step((1, 2), 1.5), r'actions\[1, 2\] is 1\.5; .*\[-1, 1\]'),
    (lambda one: one.reset(seed=[3, -2]), 'seed -2; allowed'),
    (lambda one: one.reset(seed=[1, 2, 3]), '3 seeds for 2 sim'),
    (lambda one: one.reset(ids=[2]), 'ids .2.; allowed: distinct indices below 2'),
    (lambda one: one.reset(ids=[1, 1]), 'ids .1, 1.; allowed'),
    (lambda one: one.reset(ids=[0.5]), 'ids .0.5.; allowed'),
    (push(index=-1), 'index -1; allowed: whole numbers 0 ... 1'),
    (push(index=True), 'index True; '),
    (push(None), "no body 'None' that"),
    (push(wrench='abcdef'), "wrench: 'abcdef' given"),
    (lambda one: one.write_data(-1, one.data(0)), 'index -1; allowed'),
    (lambda one: one.generator(2), 'index 2; allowed'),
    (lambda one: one.variation('a'), "index 'a'; allowed"),
    (lambda one: one.write_data(0, None), 'data NoneType; allowed: a mujoco.MjData'),
    (
        # Its `qpos` has the same shape, but it has two controls more.
        lambda one: one.write_data(0, Simulation('FetchPickAndPlace', num_threads=1).data(0)),
        'data MjData; allowed: .* of FetchPush, with a state of',
    ),
    (lambda one: one.compute_reward('', np.zeros(3)), "achieved_goal ''; allowed: numbers"),
    (lambda one: one.compute_reward(np.zeros(4), np.zeros(3)), r'last axis, not shape \(4,\)'),
    (lambda one: one.compute_reward(np.zeros((2, 3)), np.zeros(3)), r'\(2, 3\) and desired_goal'),
    (lambda one: setattr(one, 'goals', np.zeros(3)), r'shape \(3,\) given; .*\(2, 3\)'),
    (lambda one: one.set_goal(np.zeros((1, 3))), r'shape \(1, 3\) given; .* \(2, 3\)'),
    (lambda one: one.set_goal(np.full((2, 3), np.nan)), 'is nan'),
]


@pytest.mark.parametrize(('call', 'message'), BAD_CALLS)
def test_a_bad_argument_is_named_and_nothing_moves(call, message):
    simulation = Simulation('FetchPush', num_envs=2, num_threads=1)
    simulation.reset(seed=0)
    before = state_of(simulation)
    with pytest.raises((ValueError, TypeError), match=message):
        call(simulation)
    assert state_of(simulation) == before


def test_a_goal_is_taken_in_the_hemisphere_of_the_object():
    simulation = Simulation('HandManipulateBlockFull')
    pose = simulation.reset(seed=[0])['achieved_goal'][0]
    turn = quaternion_from_axis_angle([0.0, 0.0, 1.0], 0.05)
    quaternion = quaternion_multiply(turn, pose[3:])
    for sign in (1.0, -3.0):
        simulation.set_goal([[*pose[:3], *(sign * quaternion)]])
        observation = simulation.observe()
        assert observation['desired_goal'][0, 3:] == pytest.approx(quaternion)
        achieved, desired = observation['achieved_goal'], observation['desired_goal']
        assert simulation.compute_success(achieved, desired).all()


@pytest.mark.parametrize(
    'task', [pytest.param('FetchPush', marks=pytest.mark.release), 'HandReach']
)
def test_memory_does_not_grow_with_episodes(task):
    simulation = Simulation(task, num_envs=8)
    played = actions(simulation, 2)

    def run_episodes() -> int:
        reset_peak_memory()
        for _ in range(60):
            simulation.reset()
            play(simulation.step, played)
        return peak_memory()

    before = run_episodes()
    assert run_episodes() - before < 1_600_000, 'bytes that 60 more episodes took'


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach', 'HandManipulateEggFull'])
def test_a_simulation_without_references_frees_its_memory(task):
    gc.disable()
    try:
        simulation = Simulation(task, num_threads=1)
        simulation.reset(seed=0)
        simulation.step(np.zeros((1, simulation.spec.robot.action_size)))
        physics = weakref.ref(simulation.task)
        del simulation
        assert physics() is None
    finally:
        gc.enable()


FORKED = """
import copy, os, signal
import numpy as np
from fetch_hand_sim.simulation import Simulation

def play(simulation):
    for call in (lambda: simulation.step(np.zeros((2, 4))), lambda: simulation.reset(seed=1)):
        try:
            call()
            print('goes on', flush=True)
        except RuntimeError as error:
            print(str(error)[:23], flush=True)

for threads in (1, 2):
    simulation = Simulation('FetchReach', num_envs=2, num_threads=threads)
    simulation.reset(seed=0)
    if os.fork() == 0:
        signal.alarm(60)
        play(simulation)
        simulation = copy.deepcopy(simulation)
        play(simulation)
        # A new batch replaces the copy.
        simulation = Simulation('FetchReach', num_envs=2, num_threads=2)
        simulation.reset(seed=1)
        break
    assert os.wait()[1] == 0
"""


def test_threads_that_a_fork_leaves_behind_are_not_waited_for():
    result = subprocess.run([sys.executable, '-c', FORKED], capture_output=True, text=True)
    forked = 'this process was forked'
    expected = ['goes on'] * 4 + [forked, forked, 'goes on', 'goes on']
    assert (result.returncode, result.stdout.splitlines()) == (0, expected), result.stderr
