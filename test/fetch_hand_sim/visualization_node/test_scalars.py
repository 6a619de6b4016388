"""Numbers for plots: what the task measures, stamped with the tick."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from rclpy.serialization import deserialize_message

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame
from fetch_hand_sim.visualization_node.messages import Scalars
from fetch_hand_sim.watch.robot_watch import SeenTick
from msgs_spec.codecs import decode, message_stamp
from msgs_spec.tasks import task_spec
from msgs_spec.topics import scalar_topics
from support.tasks import each_task

STAMP = 3_000_000_007


def tick_of(spec, reward):
    rng = np.random.default_rng(2)
    goals = [rng.uniform(0.1, 0.9, spec.goal.size) for _ in range(2)]
    if spec.goal.size == 7:
        goals = [np.concatenate([g[:3], g[3:] / np.linalg.norm(g[3:])]) for g in goals]
    frame = Frame(np.zeros(len(spec.robot.joints)), goals[0], goals[1], None, is_success=True)
    return SeenTick(STAMP, frame, reward, None)


@pytest.mark.parametrize('rule', ['gymnasium', 'paper'])
@each_task
def test_a_tick_becomes_the_numbers_its_task_has(task, rule):
    spec = task_spec(task)
    tick, metric = tick_of(spec, reward=-0.25), GoalMetric(spec, success_rule=rule)
    data = Scalars(metric).messages(tick)
    assert list(data) == [source.name for source in scalar_topics(spec)]
    distance, rotation = metric.distances(tick.frame.achieved_goal, tick.frame.desired_goal)
    wanted = {'reward': -0.25, 'is_success': 1.0, 'distance': distance, 'rotation': rotation}
    assert ('scalars/rotation' in data) == task.startswith('HandManipulate')
    assert ('scalars/distance' in data) == ('Rotate' not in task)
    for source in scalar_topics(spec):
        message = deserialize_message(data[source.name], Vector3Stamped)
        assert message_stamp(message) == STAMP
        assert decode(source, message)[0] == message.vector.x
        assert message.vector.x == wanted[source.layout[0].name]
        assert (message.vector.y, message.vector.z) == (0.0, 0.0)


def test_a_reset_has_no_reward():
    spec = task_spec('FetchPush')
    data = Scalars(GoalMetric(spec)).messages(tick_of(spec, reward=None))
    assert list(data) == ['scalars/distance', 'scalars/is_success']
