"""A disturbed simulation: what it changes, what it leaves alone, and that it can be repeated."""

from __future__ import annotations

import copy
import pickle

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rendering import simulation_frame
from support.same_bits import assert_same
from support.tasks import FAMILIES, each_task


def actions(simulation: Simulation, ticks: int) -> np.ndarray:
    shape = (ticks, simulation.num_envs, simulation.spec.robot.action_size)
    return np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)


@each_task
def test_start_and_goal_are_the_same_with_and_without_disturbances(task: str) -> None:
    plain = Simulation(task, 2).reset(seed=3)
    noise = {'action': {'latency': 2, 'noise': 0.1}, 'physics': {'friction': [0.5, 2.0]}}
    disturbed = Simulation(task, 2, disturbances=noise).reset(seed=3)
    for name in ('desired_goal', 'achieved_goal'):
        assert (plain[name] == disturbed[name]).all()


@pytest.mark.parametrize('task', FAMILIES)
def test_one_simulation_many_and_copies_give_the_same_bits(task: str) -> None:
    many, one = (Simulation(task, count, disturbances='severe') for count in (3, 1))
    many.reset(seed=[5, 6, 7])
    one.reset(seed=6)
    copies: list[Simulation] = []
    # Longer than a block of random numbers.
    for tick, action in enumerate(actions(many, 70)):
        if tick == 5:
            copies = [copy.deepcopy(many), pickle.loads(pickle.dumps(many))]
        expected = many.step(action).observation['observation']
        assert_same(one.step(action[1:2]).observation['observation'], expected[1:2])
        for each in copies:
            assert_same(each.step(action).observation['observation'], expected)
    drawn = [each.reset() for each in (many, *copies)]
    assert_same(drawn[0], drawn[1])
    assert_same(drawn[0], drawn[2])


@pytest.mark.parametrize('ticks', [1, 3])
@pytest.mark.parametrize('part', ['action', 'joints'])
def test_a_latency_delays_commands_or_what_is_seen_and_nothing_else(part: str, ticks: int) -> None:
    delayed = Simulation('HandReach', 1, disturbances={part: {'latency': ticks}})
    plain = Simulation('HandReach', 1)
    given = actions(plain, 10)
    observations = [each.reset(seed=0)['observation'] for each in (plain, delayed)][:1]
    resting = plain.resting_commands()
    for tick in range(10):
        late = delayed.step(given[tick])
        if part == 'joints':
            now = plain.step(given[tick])
        elif tick < ticks:
            now = plain.step_commands(resting)
        else:
            now = plain.step(given[tick - ticks])
        observations.append(now.observation['observation'])
        seen = max(tick + 1 - ticks, 0) if part == 'joints' else -1
        assert (late.observation['observation'] == observations[seen]).all()
        assert (late.observation['achieved_goal'] == now.observation['achieved_goal']).all()
        assert (late.reward == now.reward).all()


def test_joint_errors_move_the_fingertips_as_the_joints_would() -> None:
    simulation = Simulation('HandReach', 50, disturbances={'joints': {'bias': 0.01}})
    simulation.reset(seed=0)
    error = simulation.readings()['fingertip_poses'] - simulation.true_readings()['fingertip_poses']
    spread = error.reshape(50, 5, 7)[..., :3].std()
    # Some millimetres for a hundredth of a radian on fingers of some ten centimetres.
    assert 0.0003 < spread < 0.005


@pytest.mark.parametrize(
    ('disturbances', 'field', 'place'),
    [
        ({'physics': {'object_mass': 2.0}}, 'body_mass', 'object0'),
        ({'physics': {'friction': 0.5}}, 'geom_friction', None),
        ({'physics': {'object_size': 1.1}}, 'geom_size', 'object0'),
    ],
)
def test_physics_varies_and_the_model_stays(disturbances, field: str, place: str | None) -> None:
    simulation = Simulation('FetchPush', 2, disturbances=disturbances)
    for _ in range(2):
        simulation.reset(seed=0)
        factor = next(iter(disturbances['physics'].values()))
        varied = simulation.task.batch.get_model(0)
        one, other = (getattr(model, field) for model in (varied, simulation.model))
        if place is not None:
            number = (varied.body if field.startswith('body') else varied.geom)(place).id
            one, other = one[number], other[number]
        assert np.allclose(one, factor * other)


def test_a_stale_pose_is_repeated_while_pushes_move_the_object() -> None:
    disturbances = {
        'action': {'latency': [0, 2]},
        'object': {'stale': 1.0},
        'pushes': {'force': 5.0, 'rate': 5.0},
    }
    simulation = Simulation('FetchPush', 60, disturbances=disturbances)
    first = simulation.reset(seed=0)
    drawn = {simulation.variation(index)['action_latency'] for index in range(60)}
    assert drawn == {0.0, 1.0, 2.0}
    for _ in range(5):
        seen = simulation.step(np.zeros((60, 4), np.float32)).observation
    assert (seen['observation'][:, 3:6] == first['observation'][:, 3:6]).all()
    moved = np.linalg.norm(seen['achieved_goal'] - first['achieved_goal'], axis=1) > 0.001
    # Five pushes a second, for a fifth of a second.
    assert 0.4 < moved.mean() < 0.9


@pytest.mark.parametrize('control_hz', [25.0, 100.0])
def test_lost_tracking_returns_after_half_a_second(control_hz: float) -> None:
    disturbances = {'object': {'noise': 0.01, 'lost': 0.02}}
    simulation = Simulation('FetchPush', 20, control_hz=control_hz, disturbances=disturbances)
    before = simulation.reset(seed=0)['observation'][:, 3:6]
    repeated, lengths = np.zeros(20, np.int64), []
    for _ in range(2 * int(control_hz)):
        seen = simulation.step(np.zeros((20, 4), np.float32)).observation['observation'][:, 3:6]
        is_fresh = (seen != before).any(axis=1)
        lengths += repeated[is_fresh & (repeated > 0)].tolist()
        repeated, before = np.where(is_fresh, 0, repeated + 1), seen
    # Tracking may be lost again at once.
    assert min(lengths) == int(control_hz / 2)


def test_sensors_are_read_once_a_step_and_again_after_the_state_was_written() -> None:
    simulation = Simulation('FetchPush', 1, keeps_data=True, disturbances='hardware')
    simulation.reset(seed=0)
    count = 0
    read = simulation.task.readings

    def counted(*names):
        nonlocal count
        count += 1
        return read(*names)

    simulation.task.readings = counted  # type: ignore[method-assign]
    result = simulation.step(np.zeros((1, 4), np.float32))
    truth = simulation.true_readings()
    assert count == 1
    assert (truth['object_pose'][:, :3] == result.observation['achieved_goal']).all()
    data = simulation.data(0)
    data.joint('object0:joint').qpos[0] += 0.1
    mujoco.mj_forward(simulation.model, data)
    simulation.write_data(0, data)
    moved = simulation.observe()['achieved_goal'] - result.observation['achieved_goal']
    assert moved[0, 0] == pytest.approx(0.1)


def test_pictures_show_the_true_state_and_not_what_disturbed_sensors_measure() -> None:
    simulation = Simulation(
        'FetchPush', disturbances={'object': {'noise': 0.05}, 'joints': {'bias': 0.1}}
    )
    simulation.reset(seed=0)
    frame, qpos = simulation_frame(simulation), simulation.task.batch.bind('qpos')[0]
    assert frame.object_pose is not None
    assert (frame.object_pose == qpos[-7:]).all()
    assert (frame.joint_position == qpos[simulation.task.joint_qpos]).all()
