"""A third-party robot and task, made from `Task` itself, and what they must define."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.models import load_spec
from fetch_hand_sim.simulation.rendering import simulation_frame
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Scene, default_view
from fetch_hand_sim.simulation.task_check import check_task
from fetch_hand_sim.simulation.tasks import registry
from fetch_hand_sim.simulation.tasks.task import Task
from msgs_spec.robots import CommandPart, RobotSpec
from msgs_spec.tasks import TASKS, GoalKind, TaskFormulas, TaskSpec, VectorPart

MJCF = """<mujoco>
  <worldbody>
    <body name="upper" pos="0 0 .1">
      <joint name="shoulder" axis="0 0 1" damping=".5"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 0 1" damping=".5"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/>
        <site name="tip" pos=".3 0 0"/>
      </body>
    </body>
    <body name="block" pos="1 0 .1"><joint name="slider" type="slide"/><geom size=".03"/></body>
    <body name="ball" pos="1 1 .1"><freejoint name="ball:joint"/><geom size=".03"/></body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>"""

ARM = RobotSpec(
    name='arm',
    joints=('shoulder', 'elbow'),
    joint_units=('rad', 'rad'),
    command=(CommandPart('shoulder', -2.0, 2.0, 'N m'), CommandPart('elbow', -1.0, 1.0, 'N m')),
    has_gripper_command=True,
)


def observe(readings, tick_duration):
    joints = readings['joint_states'][..., :4]
    return np.concatenate([joints, readings['end_effector_pose'][..., :3]], axis=-1)


def achieve(readings):
    return readings['end_effector_pose'][..., :3].copy()


FORMULAS = TaskFormulas(('joint_states', 'end_effector_pose'), observe, achieve)
SPEC = TaskSpec(
    name='ArmReach',
    robot=ARM,
    goal=GoalKind.POINT,
    observation=(
        VectorPart('position', 2, 'rad'),
        VectorPart('velocity', 2, 'rad/s'),
        VectorPart('tip', 3, 'm'),
    ),
    episode_ticks=10,
    object_name=None,
    distance_threshold=0.05,
    rotation_threshold=None,
    reference_id=None,
    achieved_goal='tip',
    formulas=FORMULAS,
)


class ArmReach(Task):
    """Torques bring the tip of an arm of two joints to a point."""

    def __init__(self, spec, batch):
        super().__init__(spec, load_spec(self.ASSET).compile(), batch)
        self._ctrl = self.batch.bind('ctrl')
        self._tip = self.output('site_xpos')[:, self.model.site('tip').id]
        self._turned = self.output('xquat')[:, self.model.body('lower').id]
        self.start_state = self.batch.state[0].copy()
        self.add_sensors()

    def add_sensors(self):
        self.add_sensor('end_effector_pose', self.pose)
        self.add_sensor('end_effector_twist', self.twist)

    def twist(self):
        return np.zeros((self.batch.nsim, 6))

    def pose(self):
        return np.concatenate([self._tip, self._turned], axis=1)

    def reset(self, ids, generators):
        self.batch.state[ids] = self.start_state
        self.batch.forward(ids)
        return self.sample_goals(ids, generators)

    def sample_goal(self, index, generator):
        return generator.uniform(-0.4, 0.4, size=3)

    def apply_commands(self, commands):
        self._ctrl[:] = commands

    def resting_commands(self):
        return np.zeros((self.batch.nsim, 2))

    def goal_metric(self, success_rule, reward_type):
        return GoalMetric(self.spec, success_rule, reward_type)


@pytest.fixture
def make(monkeypatch, tmp_path):
    """Makes simulations of the arm: as it is, or with another specification or class."""
    model = tmp_path / 'arm.xml'
    model.write_text(MJCF)

    def simulation(num_envs=2, kind=ArmReach, robot=None, **changes):
        spec = replace(SPEC, **changes, **({'robot': robot} if robot else {}))
        monkeypatch.setitem(TASKS, spec.name, spec)
        own = type(kind.__name__, (kind,), {'ASSET': str(model)})
        monkeypatch.setattr(registry, 'third_party_simulation', lambda name: own)
        return Simulation(spec.name, num_envs=num_envs, num_threads=1)

    return simulation


def test_a_method_of_the_task_does_not_keep_it_alive(make):
    simulation = make()
    task = weakref.ref(simulation.task)
    gc.disable()
    try:
        del simulation
        assert task() is None
    finally:
        gc.enable()


def with_sensor(name, function):
    def add_sensors(task):
        ArmReach.add_sensors(task)
        task.add_sensor(name, lambda: function(task))

    return {'kind': type('Own', (ArmReach,), {'add_sensors': add_sensors})}


def with_method(name, function):
    return {'kind': type('Own', (ArmReach,), {name: function})}


def with_formulas(**changes):
    return {'formulas': replace(FORMULAS, **changes)}


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        ({'robot': replace(ARM, joints=('shoulder', 'elbo'))}, 'elbo'),
        ({'robot': replace(ARM, joints=('shoulder', 'ball:joint'))}, 'ball:joint'),
    ],
)
def test_a_task_that_cannot_be_made_names_the_cause(make, changes, line):
    with pytest.raises(ValueError, match=line):
        make(**changes)


def _all_sensors(task):
    ArmReach.add_sensors(task)
    task.add_sensor('object_pose', lambda: np.zeros((task.batch.nsim, 7)))
    task.add_sensor('object_twist', lambda: np.zeros((task.batch.nsim, 6)))


class Flat(GoalMetric):
    def reward(self, achieved_goal, desired_goal, info=None):
        return -1.0


def rewarded_by(kind):
    return with_method('goal_metric', lambda task, rule, reward: kind(task.spec, rule, reward))


def of_a_first_row(readings, tick_duration):
    rows = observe(readings, tick_duration)
    return rows[0] if rows.ndim > 1 else rows


def about_the_mean(readings, tick_duration):
    rows = observe(readings, tick_duration)
    rows[..., :2] -= rows[..., :2].mean()
    return rows


def stale(task, ids, generators):
    task.batch.state[ids] = task.start_state
    return task.sample_goals(ids, generators)


def of_all(task, ids, generators):
    task.batch.state[:] = task.start_state
    task.batch.forward()
    return task.sample_goals(ids, generators)


def with_a_larger_ball(task):
    ArmReach.add_sensors(task)
    task.model.geom_size[-1] *= 2.0


def test_a_right_task_passes_its_check(make):
    make(object_name='ball', **with_method('add_sensors', _all_sensors))
    check_task('ArmReach')


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        ({'distance_threshold': -1.0}, 'distance_threshold -1.0'),
        ({'achieved_goal': 'top'}, "achieved_goal 'top'"),
        ({'robot': replace(ARM, joint_units=('rad',))}, '2 joints have 1 units'),
        (with_formulas(topics=('joint_states', 'touch')), "topic 'touch'"),
        (with_method('add_sensors', lambda task: None), 'sensor end_effector_pose is missing'),
        (with_formulas(observation=lambda r, t: observe(r, t)[..., :-1]), r'\(2, 6\), not \(2, 7'),
        (with_formulas(observation=of_a_first_row), r'axes \(2,\) has shape \(7,\), not \(2, 7\)'),
        (with_formulas(observation=about_the_mean), 'one row depends on another'),
        (with_formulas(observation=lambda r, t: observe(r, t) * np.nan), 'observation .* not fin'),
        (with_formulas(achieved_goal=lambda r: achieve(r)[..., :2]), 'achieved_goal for readings'),
        (
            {'observation': (SPEC.observation[2], *SPEC.observation[:2])},
            "part 'tip' is not the achieved goal",
        ),
        (with_sensor('end_effector_twist', lambda task: np.zeros(6)), 'end_effector_twist has sh'),
        (with_sensor('end_effector_twist', lambda task: task.batch.bind('qvel')[:, :6]), 'fresh'),
        (with_method('sample_goal', lambda *_: np.full(3, np.nan)), 'goals of reset is not finite'),
        (with_method('resting_commands', lambda task: np.zeros(2)), r'resting_commands\(\) has sh'),
        (rewarded_by(Flat), r'reward of goals \(2, 3\)'),
        (with_method('goal_metric', lambda task, *_: GoalMetric(task.spec)), 'of these'),
        (with_method('reset', stale), r'forward\(ids\)'),
        (with_method('reset', of_all), 'not in ids'),
        (with_method('add_sensors', with_a_larger_ball), 'differs from .*arm.xml'),
        ({'object_name': 'block'} | with_method('add_sensors', _all_sensors), "'block:joint'"),
    ],
)
def test_the_check_names_what_a_task_does_wrongly(make, changes, line):
    make(**changes)
    with pytest.raises(ValueError, match=f'^ArmReach: .*{line}'):
        check_task('ArmReach')


def test_what_neither_robot_nor_object_moves_is_drawn_where_it_is(make):
    simulation = make()
    simulation.reset(seed=0)
    simulation.step(np.ones((2, 2)))
    qpos = simulation.task.batch.bind('qpos')
    slider = int(simulation.model.joint('slider').qposadr[0])
    qpos[1, slider] = 0.3
    scene, frame = Scene('ArmReach'), simulation_frame(simulation, 1)
    scene.show(frame)
    assert scene.data.qpos.tobytes() == qpos[1].tobytes()
    # Of a log only the robot is known.
    scene = Scene('ArmReach')
    scene.show(replace(frame, qpos=None))
    assert scene.data.qpos[slider] == 0.0
    assert (scene.data.qpos[:2] == frame.joint_position).all()


def test_the_camera_looks_at_a_model_of_its_own(make):
    simulation = make()
    statistic = '<mujoco><statistic center="2 1 .5" extent="4"/>'
    simulation.asset.write_text(MJCF.replace('<mujoco>', statistic))
    view = Scene('ArmReach').view
    assert (view.lookat, view.distance) == ((2.0, 1.0, 0.5), 6.0)
    # A task made from one of the thirteen has the same view.
    make(looks_like='FetchPush')
    assert Scene('ArmReach').view == default_view(simulation.spec)
    assert Scene('FetchPush').view == default_view(TASKS['FetchPush'])
