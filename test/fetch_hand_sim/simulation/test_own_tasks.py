"""Tasks of other packages that the thirteen do not think of: other models, goals, commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.simulation.tasks import hand_manipulate, registry
from fetch_hand_sim.simulation.tasks.fetch import FETCH_CONFIGS
from fetch_hand_sim.simulation.tasks.hand import HandReachTask
from fetch_hand_sim.simulation.tasks.hand_manipulate import MANIPULATE_CONFIGS, HandManipulateTask
from fetch_hand_sim.simulation.tasks.task import BatchConfig
from msgs_spec.tasks import TASKS, GoalKind, TaskFormulas
from msgs_spec.topics import topics

BLOCK = 'HandManipulateBlockRotateZ'


class BlockNear(HandManipulateTask):
    """The block under another name."""

    ASSET = MANIPULATE_CONFIGS[BLOCK].asset

    def __init__(self, spec, batch):
        super().__init__(spec, batch, MANIPULATE_CONFIGS[BLOCK])


def test_a_model_of_its_own_is_the_one_that_is_simulated(monkeypatch):
    class Missing(HandReachTask):
        ASSET = '/nowhere/hand.xml'

    with pytest.raises((FileNotFoundError, ValueError), match='nowhere'):
        Missing(TASKS['HandReach'], BatchConfig())
    monkeypatch.setattr(registry, 'third_party_simulation', lambda name: object)
    monkeypatch.setattr(registry, 'task_spec', lambda name: replace(TASKS[BLOCK], name=name))
    with pytest.raises(ValueError, match='the simulation of Mine lacks ASSET'):
        registry.task_asset('Mine')
    monkeypatch.undo()
    monkeypatch.setattr(registry, 'PHYSICS_TIMESTEP', 0.001)
    with pytest.raises(ValueError, match=r'time step of 0\.002 s; allowed: 0\.001 s'):
        registry.make_task('HandReach')
    monkeypatch.setattr(registry, 'task_asset', lambda name: 'another.xml')
    with pytest.raises(ValueError, match=r'hand/reach\.xml, .* another\.xml'):
        registry.make_task('HandReach')


def test_sensors_of_a_task_of_another_name_run_only_when_read_and_change_no_bit():
    class Touching(BlockNear):
        def __init__(self, spec, batch):
            super().__init__(spec, batch)
            self.touch = self.output('sensordata')

    spec = replace(TASKS[BLOCK], name='HandBlockNear', reference_id=None)
    touching = Touching(spec, BatchConfig())
    tasks = touching, HandManipulateTask(TASKS[BLOCK], BatchConfig(), MANIPULATE_CONFIGS[BLOCK])
    for task in tasks:
        task.reset(np.arange(1), [np.random.default_rng(0)])
        for _ in range(10):
            task.apply_commands(task.resting_commands() + 0.3)
            task.step()
    assert touching.touch.shape == (1, 29)
    assert touching.touch.any()
    assert tasks[0].batch.state.tobytes() == tasks[1].batch.state.tobytes()
    assert tasks[0].asset == tasks[1].asset == BlockNear.ASSET


def test_a_start_that_cannot_be_is_refused_instead_of_looked_for_for_ever(monkeypatch):
    with pytest.raises(ValueError, match=r'object_range 0\.07 m'):
        replace(FETCH_CONFIGS['FetchPush'], object_range=0.07)
    replace(FETCH_CONFIGS['FetchReach'], object_range=0.0)
    # The last try counts.
    monkeypatch.setattr(hand_manipulate, '_MOST_TRIES', 1)
    Simulation(BLOCK).reset(seed=0)
    monkeypatch.setattr(hand_manipulate, '_MOST_TRIES', 3)
    # No object of 6 cm reaches it.
    monkeypatch.setattr(hand_manipulate, 'PALM_HEIGHT', 1.0)
    simulation = Simulation(BLOCK)
    with pytest.raises(RuntimeError, match=f'{BLOCK}: the object fell off the palm 3 times'):
        simulation.reset(seed=0)


def test_a_pose_goal_needs_neither_a_ghost_nor_the_joint_of_its_object(monkeypatch):
    """Such as that of FetchPush, turned."""
    formulas = TaskFormulas(
        topics=('object_pose',),
        observation=lambda readings, tick_duration: readings['object_pose'].copy(),
        achieved_goal=lambda readings: readings['object_pose'].copy(),
    )
    turned = {'name': 'FetchPushTurned', 'goal': GoalKind.POSE, 'rotation_threshold': 0.2}
    spec = replace(TASKS['FetchPush'], **turned, formulas=formulas, reference_id=None)
    assert 'object_joint' not in {each.name for each in topics(spec)}
    assert 'object_joint' in {each.name for each in topics(TASKS[BLOCK])}
    module = 'fetch_hand_sim.simulation.scene'
    monkeypatch.setattr(f'{module}.task_spec', lambda name: spec)
    monkeypatch.setattr(f'{module}.task_asset', lambda name: 'fetch/push.xml')
    assert not Scene(spec.name).has_ghost
    monkeypatch.undo()
    assert Scene(BLOCK).has_ghost
