"""Observations rebuilt from the bytes of topics against those of the simulation, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

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
