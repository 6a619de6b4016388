"""Observations rebuilt from the bytes of topics against those of the simulation, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium_robotics.utils import rotations as reference

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import decode
from msgs_spec.observations import ObservationAssembler
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


# The parts of an observation at 50 Hz.
PARTS = {
    'joint_position': lambda r: np.split(r['joint_states'], 3)[0],
    'joint_velocity': lambda r: np.split(r['joint_states'], 3)[1],
    'fingertip_positions': lambda r: r['fingertip_poses'].reshape(5, 7)[:, :3].ravel(),
    'object_pose': lambda r: r['object_joint'][:7],
    'object_velocity': lambda r: r['object_joint'][7:],
    'end_effector_position': lambda r: r['end_effector_pose'][:3],
    'end_effector_velocity': lambda r: 0.02 * r['end_effector_twist'][:3],
    'gripper_state': lambda r: PARTS['joint_position'](r)[-2:],
    'gripper_velocity': lambda r: 0.02 * PARTS['joint_velocity'](r)[-2:],
    'object_position': lambda r: r['object_pose'][:3],
    'object_relative_position': lambda r: r['object_pose'][:3] - r['end_effector_pose'][:3],
    'object_rotation': lambda r: reference.mat2euler(reference.quat2mat(r['object_pose'][3:])),
    'object_relative_velocity': lambda r: 0.02 * (r['object_twist'] - r['end_effector_twist'])[:3],
    'object_angular_velocity': lambda r: 0.02 * r['object_twist'][3:],
}


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_layout_names_what_the_vector_holds(task):
    tick = random_tick(task)
    if task.has_object:
        tick.readings['object_pose'][3:] /= np.linalg.norm(tick.readings['object_pose'][3:])
    found = ObservationAssembler(task, 50.0).assemble(vectors_of(task, tick))['observation']
    expected = {part.name: PARTS[part.name](tick.readings) for part in task.observation}
    assert {part.name: part.size for part in task.observation} == {
        name: len(values) for name, values in expected.items()
    }
    np.testing.assert_allclose(found, np.concatenate([*expected.values()]), atol=1e-14)


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
