"""A robot and a task of somebody else's, from `Task` itself: what it must offer."""

from __future__ import annotations

import gc
import re
import weakref
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.first_reset import require_goals
from fetch_hand_sim.simulation.models import load_spec
from fetch_hand_sim.simulation.rendering import simulation_frame
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Scene, default_view
from fetch_hand_sim.simulation.tasks import registry
from fetch_hand_sim.simulation.tasks.task import Task
from msgs_spec.robots import CommandPart, RobotSpec
from msgs_spec.tasks import TASKS, GoalKind, TaskFormulas, TaskSpec, VectorPart
from node_runtime.command_line import CommandError

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
        self.add_sensor('end_effector_twist', lambda: np.zeros((self.batch.nsim, 6)))

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
        monkeypatch.setattr(registry, 'foreign_simulation', lambda name: own)
        return Simulation(spec.name, num_envs=num_envs, num_threads=1)

    return simulation


def test_a_robot_from_task_itself_is_simulated(make):
    simulation = make()
    first = simulation.reset(seed=0)
    assert first['observation'].shape == (2, 7)
    moved = simulation.step(np.ones((2, 2))).observation
    assert (moved['achieved_goal'] != first['achieved_goal']).any()
    assert set(simulation.task.sensors) == set(simulation.readings())


def test_a_method_of_the_task_does_not_keep_it_alive(make):
    simulation = make(kind=type('Own', (ArmReach,), {'add_sensors': _both_by_methods}))
    task = weakref.ref(simulation.task)
    gc.disable()
    try:
        del simulation
        assert task() is None
    finally:
        gc.enable()


def _both_by_methods(task):
    type(task).twist = lambda self: np.zeros((self.batch.nsim, 6))
    task.add_sensor('end_effector_pose', task.pose)
    task.add_sensor('end_effector_twist', task.twist)


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
        (
            with_method('add_sensors', lambda task: None),
            'ArmReach has no sensor for end_effector_pose, end_effector_twist, which its robot '
            'publishes: add_sensor',
        ),
        (
            with_sensor('touch', lambda task: np.zeros((1, 1))),
            "no sensor 'touch'; allowed: joint_states, end_effector_pose, end_effector_twist$",
        ),
        (
            with_formulas(topics=('joint_states', 'touch')),
            "the formulas of ArmReach read 'touch'; allowed: joint_states, end_effector_pose, ",
        ),
        (
            {'robot': replace(ARM, joints=('shoulder', 'elbo'))},
            "no hinge or slide joint 'elbo', which its robot names; allowed: shoulder, elbow, sli",
        ),
        (
            {'robot': replace(ARM, joints=('shoulder', 'ball:joint'))},
            "no hinge or slide joint 'ball:joint'",
        ),
        (
            {'object_name': 'block'} | with_method('add_sensors', lambda task: _all_sensors(task)),
            "the object 'block' needs a free joint 'block:joint' .*; its free joints: ball:joint",
        ),
        (
            with_method('add_sensors', lambda task: task.model.site('end')),
            "ArmReach cannot be made: .*Invalid name 'end'",
        ),
    ],
)
def test_what_is_not_there_is_said_in_one_line_when_the_task_is_made(make, changes, line):
    with pytest.raises(ValueError, match=line) as error:
        make(**changes)
    assert '\n' not in str(error.value)


def _all_sensors(task):
    ArmReach.add_sensors(task)
    task.add_sensor('object_pose', lambda: np.zeros((task.batch.nsim, 7)))
    task.add_sensor('object_twist', lambda: np.zeros((task.batch.nsim, 6)))


def test_a_free_joint_of_the_object_is_enough(make):
    make(object_name='ball', **with_method('add_sensors', _all_sensors)).reset(seed=0)


class Flat(GoalMetric):
    def reward(self, achieved_goal, desired_goal, info=None):
        return -1.0


class WithoutInfo(GoalMetric):
    def reward(self, achieved_goal, desired_goal):
        return np.zeros(np.shape(achieved_goal)[:-1])


class Difference(GoalMetric):
    def reward(self, achieved_goal, desired_goal, info=None):
        return np.asarray(achieved_goal) - np.asarray(desired_goal)


class OfBatches(GoalMetric):
    def reward(self, achieved_goal, desired_goal, info=None):
        return -np.abs(achieved_goal - desired_goal).sum(axis=1)


class Share(GoalMetric):
    def success(self, achieved_goal, desired_goal):
        return GoalMetric.success(self, achieved_goal, desired_goal) * 1.0


class Nothing(GoalMetric):
    def reward(self, achieved_goal, desired_goal, info=None):
        return np.full(np.shape(achieved_goal)[:-1], np.nan)


def single_precision(readings, tick_duration):
    return observe(readings, tick_duration).astype(np.float32)


def rewarded_by(kind):
    return with_method('goal_metric', lambda task, rule, reward: kind(task.spec, rule, reward))


def of_one_row(readings, tick_duration):
    joints, pose = readings['joint_states'], readings['end_effector_pose']
    return np.array([joints[0], joints[1], joints[2], joints[3], *pose[:3]])


def of_a_first_row(readings, tick_duration):
    rows = observe(readings, tick_duration)
    return rows[0] if rows.ndim > 1 else rows


def about_the_mean(readings, tick_duration):
    rows = observe(readings, tick_duration)
    rows[..., :2] -= rows[..., :2].mean()
    return rows


@pytest.mark.parametrize(
    'changes', [with_formulas(observation=single_precision), rewarded_by(Share)]
)
def test_other_types_of_numbers_are_taken_as_before(make, changes):
    simulation = make(**changes)
    simulation.reset(seed=0)
    assert np.isfinite(simulation.step(np.zeros((2, 2))).observation['observation']).all()


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        (with_formulas(observation=lambda r, t: observe(r, t)[..., :-1]), r'\(2, 6\), not \(2, 7'),
        (with_formulas(observation=of_a_first_row), r'axes \(2,\) has shape \(7,\), not \(2, 7\)'),
        (with_formulas(observation=of_one_row), r'axes \(2,\) cannot be computed: .*Error'),
        (with_formulas(observation=about_the_mean), 'of a row depends on the other rows'),
        (with_formulas(observation=lambda r, t: observe(r, t) * np.nan), 'observation is not fin'),
        (with_formulas(achieved_goal=lambda r: achieve(r)[..., :2]), r'achieved_goal of readings'),
        (
            with_formulas(topics=('joint_states',)),
            "asks for 'end_effector_pose'; the topics of the formulas: joint_states$",
        ),
        (
            {'observation': (SPEC.observation[2], *SPEC.observation[:2])},
            r'observation\[0:3\], by its parts tip, is not the achieved goal',
        ),
        (
            with_sensor('end_effector_twist', lambda task: np.zeros(6)),
            r'end_effector_twist says ha',
        ),
        (with_sensor('end_effector_twist', lambda task: task.batch.bind('qvel')[:, :6]), 'fresh'),
        (with_method('sample_goal', lambda *_: np.zeros(2)), r'what reset returns has .*\(2, 2\)'),
        (with_method('sample_goal', lambda *_: np.full(3, np.nan)), 'reset returns is not finite'),
        (
            with_method('resting_commands', lambda task: np.zeros(2)),
            r'resting_commands\(\) has sha',
        ),
        (rewarded_by(Flat), r'reward of goals \(2, 3\) has shape \(\), not \(2,\)'),
        (rewarded_by(Difference), r'reward of goals \(2, 3\) has shape \(2, 3\), not \(2,\)'),
        (
            rewarded_by(OfBatches),
            r'reward of goals \(3,\) cannot be computed: AxisError',
        ),
        (rewarded_by(Nothing), 'reward of goals .* is not finite'),
        (rewarded_by(WithoutInfo), 'reward of goals .* cannot be computed: TypeError'),
        (
            with_formulas(achieved_goal=lambda readings: achieve(readings).tolist()),
            'achieved_goal of readings .* is no array but list',
        ),
    ],
)
def test_what_does_not_fit_the_specification_is_said_at_the_first_reset(make, changes, line):
    simulation = make(**changes)
    with pytest.raises(ValueError, match=f'^ArmReach: .*{line}') as error:
        simulation.reset(seed=0)
    # Of commands it is a line on stderr.
    assert isinstance(error.value, CommandError)
    assert '\n' not in str(error.value)
    assert not simulation.is_started.any()


def test_a_turn_that_is_asked_for_has_length_one():
    spec, goals = TASKS['HandManipulateBlockFull'], np.zeros((2, 7))
    goals[:, 3] = 1.0
    require_goals(spec, goals, 2)
    goals[0, 3] = 0.5
    with pytest.raises(ValueError, match=r'quaternion that reset returns has length 0.5; .*: 1$'):
        require_goals(spec, goals, 2)


def test_a_metric_is_the_one_that_was_asked_for(make):
    with pytest.raises(ValueError, match=r'goal_metric\(\) gives NoneType; allowed: a GoalMetric'):
        make(**with_method('goal_metric', lambda task, *_: None))
    make(**with_method('goal_metric', lambda task, *_: GoalMetric(task.spec)))
    with pytest.raises(ValueError, match=r"gives a metric of \('gymnasium', 'sparse'\); it passes"):
        Simulation('ArmReach', reward_type='dense')


def stale(task, ids, generators):
    task.batch.state[ids] = task.start_state
    return task.sample_goals(ids, generators)


def of_all(task, ids, generators):
    task.batch.state[:] = task.start_state
    task.batch.forward()
    return task.sample_goals(ids, generators)


def with_another_ball(task, spec, batch):
    mjcf = load_spec(task.ASSET)
    mjcf.worldbody.add_geom(size=[0.1, 0.1, 0.1])
    Task.__init__(task, spec, mjcf.compile(), batch)
    task._ctrl = task.batch.bind('ctrl')
    task._tip = task.output('site_xpos')[:, 0]
    task._turned = task.output('xquat')[:, 2]
    task.start_state = task.batch.state[0].copy()
    task.add_sensors()


@pytest.mark.parametrize(
    ('changes', 'lines'),
    [
        ({}, []),
        (with_method('reset', stale), [r'after reset with the same seed .*forward\(ids\)$']),
        (with_method('reset', of_all), ['reset changes simulations that are not among its ids$']),
        (
            with_method('__init__', with_another_ball),
            [r'what is simulated is not what .*arm.xml says \(5 and 4 geoms, or others\), and pic'],
        ),
    ],
)
def test_what_no_error_tells_is_said_in_one_line_once(make, caplog, changes, lines):
    make(**changes).reset(seed=0)
    # Once in a process, however many there are.
    simulation = Simulation('ArmReach', num_envs=2, num_threads=1)
    simulation.reset(seed=0)
    assert len(caplog.messages) == len(lines)
    for message, line in zip(caplog.messages, lines, strict=True):
        assert re.match(f'ArmReach: {line}', message)
        assert '\n' not in message


def test_commands_that_cannot_be_applied_are_said_at_the_first_reset(make):
    def wide(task, commands):
        task._ctrl[:] = np.zeros((2, 5))

    simulation = make(**with_method('apply_commands', wide))
    with pytest.raises(ValueError, match=r'ArmReach: 3 ticks cannot be made: ValueError: could'):
        simulation.reset(seed=0)


def test_one_simulation_says_it_too_and_later_resets_do_not_ask(make):
    with pytest.raises(ValueError, match='of a row depends on the other rows'):
        make(num_envs=1, **with_formulas(observation=about_the_mean)).reset(seed=0)
    asked = []
    simulation = make(**with_formulas(achieved_goal=lambda r: asked.append(0) or achieve(r)))
    simulation.reset(seed=0, ids=[1])
    first = len(asked)
    simulation.reset(seed=0)
    assert len(asked) == first + 1


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
    # What is made from one of the thirteen looks like it.
    make(looks_like='FetchPush')
    assert Scene('ArmReach').view == default_view(simulation.spec)
    assert Scene('FetchPush').view == default_view(TASKS['FetchPush'])
