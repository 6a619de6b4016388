"""The reset option `start`, and arguments of `reset` that are rejected."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import fetch_hand_sim
from fetch_hand_sim.simulation import Simulation
from support.tasks import each_task

POSE = [1.25, 0.65, 0.45, 0.6, 0.0, 0.0, 0.8]
PUSH = {'object_pose': POSE, 'object_velocity': [0.1, 0.0, 0.0, 0.0, 0.0, 2.0]}


def row(env, topic, index=0):
    return env.unwrapped.simulation.true_readings()[topic][index]


def test_an_object_starts_where_it_was_placed_with_its_velocity():
    env = fetch_hand_sim.make('FetchPush')
    drawn, _ = env.reset(seed=1)
    observation, _ = env.reset(seed=1, options={'start': PUSH})
    assert observation['achieved_goal'] == pytest.approx(POSE[:3])
    assert row(env, 'object_pose') == pytest.approx(POSE)
    assert row(env, 'object_twist') == pytest.approx(PUSH['object_velocity'], abs=1e-9)
    assert (observation['desired_goal'] == drawn['desired_goal']).all(), 'the goal of the seed'
    env.step(np.zeros(4, np.float32))
    assert row(env, 'object_pose')[0] > POSE[0]
    env.reset(options={'start': {'object_pose': POSE}})
    assert row(env, 'object_twist') == pytest.approx(np.zeros(6))
    again, _ = env.reset(seed=1)
    assert (again['observation'] == drawn['observation']).all(), 'the next start is drawn again'


@each_task
def test_the_same_start_gives_the_same_bits_and_a_state_can_be_given_again(task):
    simulation = Simulation(task, 2)
    simulation.reset(seed=4)
    joints, readings = simulation.spec.robot.joints, simulation.true_readings()
    count = len(joints)
    start = {
        'joints': readings['joint_states'][0, :count],
        'joint_velocities': dict(
            zip(joints, readings['joint_states'][0, count : 2 * count], strict=True)
        ),
    }
    if 'object_pose' in readings:
        start['object_pose'] = readings['object_pose'][0]
        start['object_velocity'] = readings['object_twist'][0]
    first = simulation.reset(seed=[7, 7], start=start)['observation']
    assert (first[0] == first[1]).all()
    assert (simulation.reset(seed=7, start=start)['observation'][0] == first[0]).all()
    found = simulation.true_readings()
    for name in {'joint_states', 'object_pose'} & found.keys():
        size = 2 * count if name == 'joint_states' else None
        assert found[name][0, :size] == pytest.approx(readings[name][0, :size], abs=1e-12)


@pytest.mark.parametrize('disturbances', [None, 'hardware'])
def test_a_batch_takes_one_start_or_a_list(disturbances):
    env = fetch_hand_sim.make_vec('FetchPush', 3, disturbances=disturbances)
    drawn, _ = env.reset(seed=0)
    placed, _ = env.reset(seed=0, options={'start': {'object_pose': POSE}})
    near = 0.0 if disturbances is None else 0.01
    assert placed['achieved_goal'] == pytest.approx(np.tile(POSE[:3], (3, 1)), abs=near + 1e-9)
    mixed, _ = env.reset(seed=0, options={'start': [None, {'object_pose': POSE}, None]})
    assert (mixed['achieved_goal'][[0, 2]] == drawn['achieved_goal'][[0, 2]]).all()
    assert (mixed['achieved_goal'][1] == placed['achieved_goal'][1]).all()
    mask = np.array([False, False, True])
    last, _ = env.reset(options={'reset_mask': mask, 'start': [None, None, {'object_pose': POSE}]})
    assert last['achieved_goal'][2] == pytest.approx(POSE[:3], abs=near + 1e-9)
    with pytest.raises(ValueError, match='start: 2 values; allowed: one, or 3'):
        env.reset(options={'start': [None, None]})


def test_start_goal_and_variation_go_together():
    env = fetch_hand_sim.make('HandReach', disturbances={'physics': {'gain': [0.5, 2.0]}})
    name = 'robot0:FFJ2'
    drawn, _ = env.reset(seed=0)
    start = {'joints': {name: 1.2}}
    options = {'goal': np.ones(15), 'variation': {'gain': 0.7}, 'start': start}
    placed, _ = env.reset(seed=0, options=options)
    assert placed['desired_goal'].tolist() == [1.0] * 15
    assert row(env, 'joint_states')[env.unwrapped.spec_of_task.robot.joints.index(name)] == 1.2
    assert np.linalg.norm(placed['achieved_goal'] - drawn['achieved_goal']) > 0.02
    assert env.unwrapped.simulation.variation(0)['gain'] == 0.7


NAMES = 'allowed: joints, joint_velocities, object_pose, object_velocity'


@pytest.mark.parametrize(
    ('task', 'start', 'line'),
    [
        ('FetchPush', 0, f"^start: '0' given; allowed: a mapping of {NAMES[9:]}$"),
        ('FetchPush', {'object': POSE}, f"start has no 'object'; {NAMES}; did you mean 'object_p"),
        ('FetchPush', {'object_pose': POSE[:3]}, r'object_pose: shape \(3,\) given; .* \(7,\)$'),
        ('FetchPush', {'object_pose': [np.nan] * 7}, r'object_pose\[0\] is nan; allowed'),
        ('FetchPush', {'object_pose': [99.0, *POSE[1:]]}, 'object_pose: .99.*: -10 ... 10$'),
        ('FetchPush', {'object_pose': [*POSE[:3], 0, 0, 0, 0]}, 'a quaternion of zeros; allowed'),
        (
            'FetchPush',
            {'object_pose': [1.3, 0.7, 0.38, 1, 0, 0, 0]},
            'start: (object0 and table0|table0 and object0) would overlap by 45 mm; allowed: up to',
        ),
        ('FetchPush', {'object_velocity': [0.0] * 6}, 'object_velocity without object_pose'),
        ('FetchReach', {'object_pose': POSE}, 'FetchReach has no object; allowed: joints, joint_v'),
        ('HandReach', {'joints': {'robot0:FFJ9': 0}}, "no 'robot0:FFJ9'; allowed: .*did you"),
        (
            'HandReach',
            {'joints': {'robot0:FFJ3': 9}},
            'robot0:FFJ3: 9.0 given; allowed: -0.369 ... 0.369',
        ),
        ('HandReach', {'joints': [0.0] * 3}, r'start joints: shape .3,. given; .*\(24,\)$'),
        (
            'HandReach',
            {'joint_velocities': {'robot0:FFJ3': 1e9}},
            'joint_velocities robot0:FFJ3: .*; allowed: -100 ... 100$',
        ),
    ],
)
def test_an_impossible_start_is_refused_in_one_line_and_nothing_moves(task, start, line):
    assert_rejected(fetch_hand_sim.make_vec(task, 2), line, options={'start': start})


@pytest.mark.parametrize(
    ('disturbances', 'variation', 'line'),
    [
        ('mild', {'frction': 1.0}, 'frction.*allowed: action_latency'),
        ('mild', {'friction': 100.0}, 'friction=100.0; allowed: a number 0.05 ... 20'),
        ('mild', {'friction': 'high'}, 'high.*allowed: one finite number'),
        ('mild', {'damping': 2.0}, 'FetchPush has no damping'),
        ('mild', 3, "variation: '3' given; allowed: a mapping"),
        (None, {'friction': 1.0}, 'undisturbed'),
    ],
)
def test_an_impossible_variation_is_rejected_likewise(disturbances, variation, line):
    env = fetch_hand_sim.make_vec('FetchPush', 2, disturbances=disturbances)
    assert_rejected(env, line, options={'variation': variation})


def goal(value):
    return {'options': {'goal': value}}


def mask(value):
    return {'options': {'reset_mask': value}}


@pytest.mark.parametrize(
    ('numbers', 'arguments', 'line'),
    [
        ((1, 2), {'options': 3}, "options: '3' given; allowed: a mapping of goal, "),
        ((1, 2), {'options': {'begin': 0}}, "options has no 'begin'; allowed: goal"),
        ((1, 2), goal([0] * 6), r'goal of .*: shape \(6,\) given; .* \(7,\)'),
        ((1, 2), goal([*[0] * 6, np.nan]), r'goal of .*\[6\] is nan'),
        ((1, 2), goal([1, [2], 3]), 'goal: 3 values; allowed: one, or [12]$'),
        ((1, 2), goal(np.zeros(7)), 'a goal quaternion must not be zero'),
        ((1,), {'seed': -1}, 'greater or equal to zero'),
        ((2,), {'seed': True}, 'seed True; allowed'),
        ((2,), {'seed': [1, 2, 3]}, '2 environments take as many seeds, not 3'),
        ((2,), mask([True, False]), 'array of 2 boo'),
        ((2,), mask(np.ones(3, dtype=bool)), 'reset_mask .*True, *True, *True.*; allowed: an'),
        ((2,), mask(np.zeros(2, dtype=bool)), 'reset_mask .*False, False.*; .* one of them Tr'),
    ],
)
def test_other_arguments_are_rejected_likewise(numbers, arguments, line):
    for number in numbers:
        task = 'HandManipulateBlockFull'
        env = fetch_hand_sim.make_vec(task, number) if number > 1 else fetch_hand_sim.make(task)
        assert_rejected(env, line, **arguments)


def state_of(env) -> bytes:
    simulation = env.unwrapped.simulation
    state: bytes = simulation.task.batch.state.tobytes() + simulation.goals.tobytes()
    return state + str(env.unwrapped.np_random_seed).encode()


def assert_rejected(env, line, **arguments) -> None:
    env.reset(seed=0)
    before = state_of(env)
    with pytest.raises((ValueError, gymnasium.error.Error), match=line) as caught:
        env.reset(**{'seed': 1} | arguments)
    assert '\n' not in str(caught.value)
    assert state_of(env) == before
