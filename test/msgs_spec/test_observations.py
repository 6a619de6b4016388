"""Observations rebuilt from the bytes of topics against those of the simulation, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium_robotics.utils import rotations as reference

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import decode
from msgs_spec.observations import ObservationAssembler, achieved_goal, observation
from msgs_spec.robots import command_from_action
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS
from msgs_spec.tick import TickEncoder
from support.random_ticks import random_tick

TICKS = 5


def vectors_of(task, tick):
    """Vectors of a subscriber that joins topics by stamp."""
    messages = TickEncoder(task).encode(tick)
    return {spec.name: decode(spec, deserialize(spec.type_name, data)) for spec, data in messages}


@pytest.mark.parametrize(
    ('name', 'control_hz'), [*((name, 25.0) for name in TASKS), ('FetchPush', 125.0)]
)
def test_topics_give_the_observation_of_the_simulation(name, control_hz):
    task = TASKS[name]
    simulation = Simulation(name, control_hz=control_hz)
    runner = EpisodeRunner(Simulation(name, control_hz=control_hz), first_seed=7)
    assembler = ObservationAssembler(task, control_hz)
    generator = np.random.default_rng(0)
    expected = simulation.reset(seed=[7])
    tick = runner.advance(runner.resting_command())
    for _ in range(TICKS):
        observation = assembler.assemble(vectors_of(task, tick))
        assert observation.keys() == expected.keys()
        for key, value in observation.items():
            assert value.tobytes() == expected[key][0].tobytes(), key
        action = generator.uniform(-1, 1, size=task.robot.action_size)
        command = command_from_action(task.robot, action)
        expected = simulation.step_commands(command[None]).observation
        tick = runner.advance(command)


def parts_of(task, vector):
    """The named parts of an observation vector, as the task's layout has them."""
    ends = np.cumsum([part.size for part in task.observation])
    pieces = np.split(vector, ends[:-1])
    return {part.name: piece for part, piece in zip(task.observation, pieces, strict=True)}


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_layout_names_what_the_vector_holds(task):
    tick = random_tick(task)
    readings = dict(tick.readings)
    if task.has_object:
        readings['object_pose'][3:] /= np.linalg.norm(readings['object_pose'][3:])
    found = ObservationAssembler(task, 50.0).assemble(vectors_of(task, tick))['observation']
    position, velocity, _ = np.split(readings['joint_states'], 3)
    if not task.robot.has_gripper_command:
        expected = {'joint_position': position, 'joint_velocity': velocity}
        expected['fingertip_positions'] = readings['fingertip_poses'].reshape(5, 7)[:, :3].ravel()
        if task.has_object:
            expected['object_pose'] = readings['object_joint'][:7]
            expected['object_velocity'] = readings['object_joint'][7:]
    else:
        gripper, velocity_of_gripper = (
            readings['end_effector_pose'][:3],
            readings['end_effector_twist'][:3],
        )
        expected = {
            'end_effector_position': gripper,
            'end_effector_velocity': 0.02 * velocity_of_gripper,
            'gripper_state': position[-2:],
            'gripper_velocity': 0.02 * velocity[-2:],
        }
        if task.has_object:
            place, quaternion = np.split(readings['object_pose'], [3])
            linear, angular = np.split(readings['object_twist'], 2)
            expected |= {
                'object_position': place,
                'object_relative_position': place - gripper,
                'object_rotation': reference.mat2euler(reference.quat2mat(quaternion)),
                'object_relative_velocity': 0.02 * (linear - velocity_of_gripper),
                'object_angular_velocity': 0.02 * angular,
            }
    for name, piece in parts_of(task, found).items():
        np.testing.assert_allclose(piece, expected[name], atol=1e-14, err_msg=name)


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_batches_equal_single_calls(task):
    ticks = [random_tick(task, seed) for seed in range(6)]
    batch = {name: np.stack([t.readings[name] for t in ticks]) for name in ticks[0].readings}
    for formula in (observation, achieved_goal):
        extra = (0.04,) if formula is observation else ()
        singles = [formula(task, tick.readings, *extra) for tick in ticks]
        assert formula(task, batch, *extra).tobytes() == np.stack(singles).tobytes()


@pytest.mark.parametrize('name', ['FetchPush', 'HandReach', 'HandManipulatePenRotate'])
def test_needed_topics_are_needed(name):
    task = TASKS[name]
    assembler = ObservationAssembler(task, 25.0)
    vectors = vectors_of(task, random_tick(task))
    needed = [spec.name for spec in assembler.topics]
    assembler.assemble({name: vectors[name] for name in needed})
    for missing in needed:
        with pytest.raises(ValueError, match=f'no {missing} for an observation of {name}'):
            assembler.assemble({key: vectors[key] for key in needed if key != missing})
        broken = np.full_like(vectors[missing], np.nan)
        with pytest.raises(ValueError, match=f'{missing}: (not every value is|no) finite'):
            assembler.assemble(vectors | {missing: broken})
