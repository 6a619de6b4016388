"""Viewers beside a running robot: they see it, act on it, and it does not notice them."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import rclpy

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.simulation.opengl import prepare_opengl
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.view.live import LiveRobot
from fetch_hand_sim.view.picture import Facts
from fetch_hand_sim.view.requests import (
    ChooseActor,
    Push,
    Reset,
    SetCommand,
    SetCommanding,
    SetGoal,
    SetPaused,
    SetSpeed,
    StepOnce,
)
from msgs_spec.codecs import decode, message_stamp
from msgs_spec.tasks import task_spec
from msgs_spec.topics import LATCHED, scalar_topics, topic, topics, view_topics
from node_runtime.event_loop import EventLoop
from node_runtime.ros import rclpy_profile, ros_message_class
from support.episode_recorder import Recorder
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Client,
    client,
    end,
    episodes_in,
    finish,
    payload,
    ros_args,
)
from support.pace import TOPIC, assert_keeps_pace
from support.visitors import DeafVisitor, Visitor

Start = Callable[..., subprocess.Popen[str]]
REACH = task_spec('FetchReach')
VIEW = (sys.executable, '-m', 'fetch_hand_sim.view', '--no-browser')
VISUALIZATION = (sys.executable, '-m', 'fetch_hand_sim.visualization_node')


VIEW_REPLAY = (sys.executable, '-m', 'fetch_hand_sim.replay_node')
ACTOR = Path(__file__).parents[2] / 'policy_node' / 'actors' / 'FetchReach.safetensors'


class Follower:
    """A `LiveRobot` with the latest of its pictures."""

    def __init__(self, connection, may_command=True):
        self.connection = connection
        self.robot = LiveRobot(connection.node, may_command)
        self.picture = None

    def until(self, condition, what):
        def look():
            self.picture = self.robot.picture() or self.picture
            return self.picture is not None and condition(self.picture)

        self.connection.spin_until(look, what)


def test_what_the_page_asks_for_happens(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach', perturb_limit=20.0))
    with client(REACH) as connection:
        connection.subscribe('desired_goal')
        follower = Follower(connection)
        follower.until(lambda p: p.frame is not None and p.facts.rate > 10.0, 'picture')
        assert follower.picture.graphs.distance.values[-1] > 0.0
        goal = np.array([1.3, 0.8, 0.6])
        follower.robot.perform(SetGoal(goal))
        desired = topic(REACH, 'desired_goal')
        connection.spin_until(
            lambda: np.allclose(decode(desired, connection.received['desired_goal'][-1]), goal),
            'the goal',
        )
        follower.robot.perform(Reset(seed=77))
        follower.until(lambda p: p.facts.seed == 77, 'episode of that seed')
        # Nobody commands, so only a push moves the gripper.
        before = follower.picture.frame.achieved_goal
        connection.spin(0.2)

        def is_pushed(picture):
            follower.robot.perform(Push('robot0:gripper_link', np.array([0, 0, 19.0, 0, 0, 0])))
            return np.abs(picture.frame.achieved_goal - before).max() > 1e-3

        assert follower.picture.facts.push_limit == 20.0
        follower.until(is_pushed, 'gripper that was pushed')
        # New episodes keep the goal of the page.
        follower.until(lambda p: np.allclose(p.frame.desired_goal, goal), 'goal in the new episode')
        follower.robot.perform(SetPaused(True))
        follower.until(lambda p: 'paused at' in p.facts.notice, 'answer')
        connection.spin(0.3)
        before = follower.picture.stamp_ns
        follower.robot.picture()
        follower.robot.perform(StepOnce())
        follower.until(lambda p: p.stamp_ns > before or '1 run' in p.facts.notice, 'a step')


def test_another_actor_takes_over(start_process: Start) -> None:
    start_process(*POLICY_NODE)
    start_process(*SIM_NODE, *ros_args(task='FetchReach', wait_for_commands=True))
    with client(REACH) as connection:
        follower = Follower(connection)
        follower.until(
            lambda p: 'FetchReach' in p.facts.commander and p.facts.actors, 'actor that commands'
        )
        follower.until(lambda p: p.facts.actor == 'FetchReach', 'its name')
        follower.robot.perform(ChooseActor('nosuch'))
        follower.until(lambda p: 'refuses policy' in p.facts.notice, 'refusal')
        assert follower.picture.facts.actor == 'FetchReach', 'it acts still'
        follower.robot.perform(ChooseActor('random'))
        follower.until(lambda p: 'random' in p.facts.commander, 'random commander')
        follower.until(lambda p: p.facts.actor == 'random', 'its name')
        stamp = follower.picture.stamp_ns
        commands = []

        def has_changed(picture):
            # A reset has none.
            if picture.stamp_ns > stamp and picture.command is not None:
                commands.append(picture.command)
            return len(commands) > 1 and np.ptp(np.stack(commands), axis=0).min() > 0.5

        follower.until(has_changed, 'random commands')


def test_the_page_names_the_actor_at_once(start_process: Start) -> None:
    start_process(*POLICY_NODE, *ros_args(policy=ACTOR))
    start_process(*SIM_NODE, *ros_args(task='FetchReach', wait_for_commands=True))
    with client(REACH) as connection:
        follower = Follower(connection)
        follower.until(lambda p: p.facts.actors and p.facts.actor == str(ACTOR), 'actor')


def test_the_speed_is_the_one_of_the_robot_whoever_sets_it(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach', real_time_factor=2.0))
    with client(REACH) as connection:
        follower = Follower(connection)
        follower.until(lambda p: p.facts.speed == 2.0, 'speed that it was started with')
        set_parameter(connection, '/sim_node', 'real_time_factor', 0.123)
        follower.until(lambda p: p.facts.speed == 0.123, 'speed that another program has set')
        follower.robot.perform(SetSpeed(5000.0))
        follower.until(lambda p: 'refuses real_time_factor' in p.facts.notice, 'refusal')
        assert follower.picture.facts.speed == 0.123
        follower.robot.perform(SetSpeed(0.5))
        follower.until(lambda p: p.facts.speed == 0.5, 'speed of the page')
        set_parameter(connection, '/sim_node', 'real_time_factor', 0.0)
        follower.until(lambda p: p.facts.speed == 0.0, 'no speed at all')
        assert follower.picture.facts.has_speed


def test_a_replay_is_told_from_a_robot_and_paused(start_process: Start, tmp_path: Path) -> None:
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    start_process(*VIEW_REPLAY, *ros_args(path=path, loop=True, rate=0.8))
    with client(REACH) as connection:
        follower = Follower(connection)
        follower.until(lambda p: p.facts.rate > 1.0 and p.facts.phase == 'running', 'replay')
        facts = follower.picture.facts
        assert facts.commander == 'a replay (/replay_node)'
        assert not facts.takes_actions
        follower.until(lambda p: p.facts.speed == 0.8, 'its rate')
        follower.robot.perform(SetSpeed(0.001))
        follower.until(lambda p: 'refuses rate' in p.facts.notice, 'refusal')
        assert follower.picture.facts.speed == 0.8
        follower.robot.perform(SetSpeed(2.0))
        follower.until(lambda p: p.facts.speed == 2.0, 'other speed')
        goal = follower.picture.frame.desired_goal
        follower.robot.perform(SetGoal(goal + 0.1))
        follower.until(lambda p: 'a replay can only' in p.facts.notice, 'a word about goals')
        np.testing.assert_array_equal(follower.picture.frame.desired_goal, goal)
        follower.robot.perform(SetPaused(True))
        picture = follower.robot.picture() or follower.picture
        assert not picture.facts.is_paused, 'before it answers'
        follower.until(lambda p: p.facts.is_paused, 'pause')
        assert follower.picture.facts.notice == 'paused'
        connection.spin(0.3)
        follower.until(lambda p: True, 'picture')
        stamp = follower.picture.stamp_ns
        connection.spin(1.0)
        follower.until(lambda p: True, 'picture')
        assert follower.picture.stamp_ns == stamp and follower.picture.facts.is_paused
        # Another program lets it go on.
        pause(connection, '/replay_node', False)
        follower.until(lambda p: not p.facts.is_paused and p.stamp_ns != stamp, 'it goes on')


@pytest.mark.release
def test_a_replay_of_any_name_in_any_namespace_is_paused(
    start_process: Start, tmp_path: Path
) -> None:
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    names = {each.name for each in topics(REACH) if each.direction == 'published'} - {'/clock'}
    names_in_left = [word for name in names for word in ('-r', f'/{name}:=/left/{name}')]
    renamed = ['-r', '__node:=player', '-r', '__ns:=/left', '-r', '~/pause:=/left/halt']
    start_process(*VIEW_REPLAY, *ros_args(path=path, loop=True), *names_in_left, *renamed)
    rclpy.init()
    node = rclpy.create_node('viewer', namespace='left')
    viewer, loop = LiveRobot(node, may_command=True), EventLoop(node)
    try:

        def wait_for(condition: Callable[[Facts], object]) -> None:
            end = time.monotonic() + 30.0
            while (picture := viewer.picture()) is None or not condition(picture.facts):
                assert time.monotonic() < end
                loop.wait(0.05)

        wait_for(lambda facts: facts.commander == 'a replay (/left/player)' and facts.rate > 1.0)
        viewer.perform(SetPaused(True))
        wait_for(lambda facts: facts.is_paused)
        viewer.perform(SetPaused(False))
        wait_for(lambda facts: not facts.is_paused and facts.notice == 'running')
    finally:
        loop.close()
        node.destroy_node()
        rclpy.shutdown()


def set_parameter(connection: Client, node: str, name: str, value: float) -> None:
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    parameter = Parameter(name, value=value).to_parameter_msg()
    answer = connection.call(SetParameters, f'{node}/set_parameters', parameters=[parameter])
    assert answer.results[0].successful


def pause(connection: Client, node: str, is_paused: bool) -> None:
    from std_srvs.srv import SetBool

    assert connection.call(SetBool, f'{node}/pause', data=is_paused).success


def test_the_page_commands_until_somebody_else_does(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    with client(REACH) as connection:
        connection.subscribe('applied_command')
        follower = Follower(connection)
        follower.until(lambda p: p.frame is not None and p.facts.rate > 0.0, 'picture')
        values = np.array([0.25, -0.5, 0.75, 1.0])
        follower.robot.perform(SetCommanding(True))

        def is_obeyed(picture):
            follower.robot.perform(SetCommand(values))
            return picture.command is not None and np.allclose(picture.command, values)

        follower.until(is_obeyed, 'command that is applied')
        start_process(*POLICY_NODE)
        follower.until(
            lambda p: not p.facts.is_commanding and 'your sliders do not' in p.facts.notice,
            'page that gives way',
        )
        # The robot may know the policy before this client does.
        connection.spin_until(
            lambda: connection.node.count_publishers('/commands') == 1, 'commands of one node'
        )
        follower.robot.perform(SetCommand(values))
        stamp = follower.picture.stamp_ns
        follower.until(lambda p: p.stamp_ns > stamp + 10**9, 'a second more')
        assert not np.allclose(follower.picture.command, values)


def test_who_may_only_watch_changes_nothing(start_process: Start) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    with client(REACH) as connection:
        follower = Follower(connection, may_command=False)
        follower.until(lambda p: p.frame is not None, 'picture')
        before = follower.picture.frame.desired_goal
        follower.robot.perform(SetGoal(np.array([1.3, 0.8, 0.6])))
        follower.robot.perform(SetPaused(True))
        assert 'only watch' in follower.robot.picture().facts.notice
        stamp = follower.picture.stamp_ns
        follower.until(lambda p: p.stamp_ns > stamp, 'another tick')
        assert not np.allclose(follower.picture.frame.desired_goal, [1.3, 0.8, 0.6])
        assert before.shape == (3,)
        assert not connection.node.get_publishers_info_by_topic('/set_goal')


def test_the_robot_shares_no_memory_with_who_listens(start_process: Start) -> None:
    """Through shared memory a listener that is stopped or killed holds the robot up."""
    robot = start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    policy = start_process(*POLICY_NODE)
    with client(REACH) as connection:
        connection.subscribe('achieved_goal', 'applied_command')
        connection.spin_until(lambda: connection.received['applied_command'], 'command')
        for process in (robot, policy):
            assert '/dev/shm/fastrtps' not in Path(f'/proc/{process.pid}/maps').read_text()
        # The client has some, under the name that is looked for.
        assert '/dev/shm/fastrtps' in Path('/proc/self/maps').read_text()


def open_view(start_process: Start) -> tuple[subprocess.Popen[str], str]:
    """Starts a viewer; returns its process and where its page is."""
    view = start_process(*VIEW, '--wait', '30')
    found = re.search(r'http://(127.0.0.1:\d+)/', view.stdout.readline())
    assert found, view.communicate()
    return view, found[1]


def wait_for_pictures(connection: Client, visitor: Visitor) -> None:
    """Waits until a visitor has seen more than it had."""
    wanted = visitor.pictures + 5
    connection.spin_until(lambda: visitor.pictures > wanted, 'pictures')


@pytest.mark.alone
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    'harm',
    [
        pytest.param('visitor leaves', marks=pytest.mark.release),
        'visitor is deaf',
        pytest.param('SIGSTOP', marks=pytest.mark.release),
        pytest.param('SIGKILL', marks=pytest.mark.release),
    ],
)
def test_a_page_or_a_viewer_that_ends_or_hangs_is_not_noticed(
    start_process: Start, harm: str
) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    with client(REACH) as connection:
        connection.subscribe(TOPIC)
        connection.spin_until(lambda: connection.received[TOPIC], 'tick')

        @contextmanager
        def harmed():
            view, address = open_view(start_process)
            assert set(niceness_of_threads(view.pid)) == {10}
            visitor = Visitor(address, 'visitor')
            wait_for_pictures(connection, visitor)
            if harm == 'visitor is deaf':
                with DeafVisitor(address):
                    yield
                    # Nor do those who watch beside it.
                    wait_for_pictures(connection, visitor)
                end(view)
            elif harm == 'visitor leaves':
                visitor.close()
                yield
                end(view)
            else:
                view.send_signal(signal.Signals[harm])
                yield
                view.kill()
                view.wait()

        assert_keeps_pace(connection, harmed)


def watch_everything(connection: Client) -> dict[str, set[int]]:
    """Subscribes to what `visualization_node` publishes of a tick; returns the stamps by topic."""
    seen: dict[str, set[int]] = {name: set() for name in ('goal_markers', 'scalars/distance')}
    try:
        prepare_opengl()
        seen['camera/image_raw'] = set()
    except RuntimeError:
        pass

    def subscribe(name: str) -> None:
        source = {each.name: each for each in view_topics(REACH)}[name]

        def keep(message: Any) -> None:
            (first, *_) = getattr(message, 'markers', [message])
            seen[name].add(message_stamp(first))

        kind = ros_message_class(source.type_name)
        connection.node.create_subscription(kind, name, keep, rclpy_profile(source.qos))

    for name in seen:
        subscribe(name)
    return seen


@pytest.mark.alone
def test_episodes_are_logged_to_the_same_bytes_whoever_watches(
    start_process: Start, tmp_path: Path
) -> None:
    """A page with its visitor, markers, scalars and pictures leave no trace in them."""

    def start_robot(name: str) -> subprocess.Popen[str]:
        settings = {'seed': 7, 'episodes': 4, 'episode_dir': tmp_path / name}
        lockstep = ros_args(mode='lockstep', wait_for_commands=True, **settings)
        return start_process(*SIM_NODE, *lockstep)

    robot, policy = start_robot('alone'), start_process(*POLICY_NODE)
    code, output = finish(robot, 60.0)
    assert code == 0, output
    end(policy)
    robot = start_robot('watched')
    node = start_process(*VISUALIZATION, *ros_args(camera_width=64, camera_height=48))
    view, address = open_view(start_process)
    visitor = Visitor(address, 'visitor')
    with client(REACH) as connection:
        seen = watch_everything(connection)
        wait_for_pictures(connection, visitor)
        # There is no tick before the first command, but by then all of them are there.
        connection.spin_until(
            lambda: (
                all(connection.node.count_publishers(name) for name in seen)
                and connection.node.count_subscribers('latest_tick')
            ),
            'page and node',
        )
        policy = start_process(*POLICY_NODE)
        connection.spin_until(lambda: robot.poll() is not None, 'end of the robot', 60.0)
        assert min(map(len, seen.values())) > 1 and len(seen['scalars/distance']) > 8, seen
    for process in (policy, view, node, robot):
        end(process)
    first, second = (episodes_in(tmp_path / name) for name in ('alone', 'watched'))
    assert len(first) == len(second) == 4
    for alone, watched in zip(first, second, strict=True):
        assert payload(alone) == payload(watched)
        # The one value that tells two runs apart.
        assert alone.metadata.pop('started') != watched.metadata.pop('started')
        for part in ('metadata', 'result', 'attachments', 'schemas', 'channels', 'size_bytes'):
            assert getattr(alone, part) == getattr(watched, part), part


def test_standard_tools_get_what_they_need(start_process: Start) -> None:
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image
    from std_msgs.msg import String
    from visualization_msgs.msg import MarkerArray

    from msgs_spec.topics import STATE

    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    parameters = ros_args(camera_width=64, camera_height=48, camera_hz=5.0)
    node = start_process(*VISUALIZATION, *parameters)
    with client(REACH) as connection:
        received = {}

        def subscribe(kind, name, qos):
            def keep(message):
                received[name] = message

            return connection.node.create_subscription(kind, name, keep, rclpy_profile(qos))

        subscribe(String, 'robot_description', LATCHED)
        subscribe(MarkerArray, 'goal_markers', STATE)
        connection.spin_until(lambda: len(received) == 2, 'description and markers')
        root = ElementTree.fromstring(received['robot_description'].data)
        names = {joint.get('name') for joint in root.findall('joint')}
        assert set(REACH.robot.joints) <= names
        assert len(received['goal_markers'].markers) > 2
        assert connection.node.count_publishers('camera/image_raw') == 1
        try:
            prepare_opengl()
        except RuntimeError as error:
            pytest.skip(str(error))
        subscribe(Image, 'camera/image_raw', STATE)
        subscribe(CameraInfo, 'camera/camera_info', STATE)
        wanted = {'camera/image_raw', 'camera/camera_info'}
        connection.spin_until(lambda: wanted <= received.keys(), 'picture')
        picture = np.array(received['camera/image_raw'].data).reshape(48, 64, 3)
        assert picture.std() > 10.0
        info = received['camera/camera_info']
        assert (info.width, info.height) == (64, 48)
        assert connection.node.count_subscribers('camera/image_raw/compressed') == 0
        subscribe(CompressedImage, 'camera/image_raw/compressed', STATE)
        connection.spin_until(lambda: 'camera/image_raw/compressed' in received, 'JPEG')
        data = bytes(received['camera/image_raw/compressed'].data)
        small = np.asarray(PIL.Image.open(BytesIO(data)))
        assert small.shape == picture.shape and small.std() > 10.0
    node.send_signal(signal.SIGINT)
    assert node.wait(10) == 0


def test_who_comes_while_the_robot_stands_still_sees_the_last_tick(start_process: Start) -> None:
    from sensor_msgs.msg import Image
    from std_srvs.srv import SetBool

    # Under whatever name its state is published.
    other = ('-r', 'joint_states:=/arm/joints')
    robot = start_process(*SIM_NODE, *ros_args(task='FetchReach'), *other)
    node = start_process(*VISUALIZATION, *ros_args(camera_width=64, camera_height=48), *other)
    (distance, *_) = scalar_topics(REACH)
    kinds = {
        name: ros_message_class(type_name)
        for name, type_name in (
            ('goal_markers', 'visualization_msgs/msg/MarkerArray'),
            (distance.name, distance.type_name),
            ('/tf', 'tf2_msgs/msg/TFMessage'),
        )
        # PyPI has no tf2_msgs.
        if name != '/tf' or find_spec('tf2_msgs') is not None
    }
    try:
        prepare_opengl()
        kinds['camera/image_raw'] = Image
    except RuntimeError:
        pass
    with client(REACH) as connection:
        connection.subscribe('achieved_goal')
        scalars, pictures = [], []
        kind, profile = kinds[distance.name], rclpy_profile(distance.qos)
        connection.node.create_subscription(kind, distance.name, scalars.append, profile)
        connection.node.create_subscription(Image, 'camera/image_raw', pictures.append, profile)
        connection.spin_until(lambda: len(scalars) > 5, 'scalars')
        if Image in kinds.values():
            connection.spin_until(lambda: len(pictures) > 2, 'pictures')
        assert connection.call(SetBool, '/sim_node/pause', data=True).success
        connection.spin(1.0)
        ticks = connection.received['achieved_goal']
        # Pictures are fewer than ticks, but the last one shows the last tick.
        connection.spin_until(
            lambda: not pictures or message_stamp(pictures[-1]) == message_stamp(ticks[-1]),
            'last picture',
        )
        last = message_stamp(ticks[-1])
        seen = {}

        def subscribe(name):
            def keep(message):
                parts = getattr(message, 'markers', getattr(message, 'transforms', [message]))
                seen[name] = message_stamp(parts[-1])

            connection.node.create_subscription(kinds[name], name, keep, profile)

        for name in kinds:
            subscribe(name)
        connection.spin_until(lambda: seen == dict.fromkeys(kinds, last), 'last tick, once more')
        # And once only.
        connection.spin(1.5)
        count = len(scalars)
        connection.spin(1.5)
        assert len(scalars) == count
        # Nothing is said of a robot that is gone.
        end(robot)
        seen.clear()
        subscribe('goal_markers')
        connection.spin(2.0)
        assert not seen
    end(node)


@pytest.mark.release
@pytest.mark.parametrize('simulated_time', [False, True])
def test_another_robot_in_the_same_place_is_followed(
    start_process: Start, simulated_time: bool
) -> None:
    """Its goals come on the same topics with another type, or its joints have other names."""
    from std_msgs.msg import String

    node = start_process(*VISUALIZATION, *ros_args(use_sim_time=simulated_time))
    for task, names in (
        ('HandReach', {}),
        ('HandReach', {'joint_prefix': 'rh_'}),
        ('FetchPush', {}),
    ):
        spec = task_spec(task, **names)
        robot = start_process(*SIM_NODE, *ros_args(task=task, **names))
        with client(spec) as connection:
            connection.subscribe('joint_states')
            stamps, descriptions = [], []
            reward = next(each for each in scalar_topics(spec) if each.name == 'scalars/reward')
            for kind, name, profile, take in (
                (
                    ros_message_class(reward.type_name),
                    reward.name,
                    reward.qos,
                    lambda message, stamps=stamps: stamps.append(message_stamp(message)),
                ),
                (String, 'robot_description', LATCHED, descriptions.append),
            ):
                connection.node.create_subscription(kind, name, take, rclpy_profile(profile))

            def is_followed(spec=spec, stamps=stamps, descriptions=descriptions, c=connection):
                joints = f'"{spec.robot.joints[-1]}"'
                is_described = descriptions and joints in descriptions[-1].data
                return is_described and len(set(stamps).intersection(c.stamps('joint_states'))) > 10

            connection.spin_until(is_followed, f'scalars of {task}')
        end(robot)
    end(node)


def test_a_viewer_sees_another_robot_in_the_same_place(start_process: Start) -> None:
    """Served as the page is; what it asks for goes to the robot of now, or nowhere."""
    rclpy.init()
    node = rclpy.create_node('viewer')
    viewer, loop = LiveRobot(node, may_command=True), EventLoop(node)
    asked = np.zeros(0)
    try:
        for task, size in (('HandReach', 15), ('FetchPush', 3)):
            robot = start_process(*SIM_NODE, *ros_args(task=task))
            deadline = time.monotonic() + 30.0
            goal = np.zeros(0)
            while goal.size != size:
                assert time.monotonic() < deadline, f'no picture of {task}'
                loop.wait(0.05)
                picture = viewer.picture()
                if picture is not None and picture.frame is not None:
                    goal = picture.frame.desired_goal
            # Made for the robot before.
            viewer.perform(SetGoal(asked))
            viewer.perform(SetCommand(np.zeros(1)))
            asked = goal + np.eye(1, size)[0] * 0.01
            # Shown at once, but this time it is said by the robot.
            end_of_patience = time.monotonic() + 1.0
            goal = np.zeros(size)
            while time.monotonic() < end_of_patience or not np.allclose(goal, asked):
                assert time.monotonic() < deadline, f'{task} does not get the goal'
                viewer.perform(SetCommanding(True))
                viewer.perform(SetCommand(np.zeros(task_spec(task).robot.action_size)))
                if time.monotonic() < end_of_patience - 0.9:
                    viewer.perform(SetGoal(asked))
                loop.wait(0.05)
                picture = viewer.picture()
                if picture is not None and picture.frame is not None:
                    goal = picture.frame.desired_goal
            end(robot)
    finally:
        loop.close()
        node.destroy_node()
        rclpy.shutdown()


@pytest.mark.alone
def test_a_fast_robot_is_seen_as_it_is_now_and_then_and_a_replay_after_it(
    start_process: Start, tmp_path: Path
) -> None:
    """One message for all of a tick, as often as eyes need it; a replay has none of these."""
    settings = {'real_time_factor': 0.0, 'episode_dir': tmp_path, 'seed': 5}
    robot = start_process(*SIM_NODE, *ros_args(task='FetchPush', **settings))
    with client(task_spec('FetchPush')) as connection:
        connection.subscribe('latest_tick', 'joint_states', 'achieved_goal', 'reward')
        follower = Follower(connection)
        follower.until(lambda p: p.facts.episode > 3 and p.frame is not None, 'episodes')
        names = [name for name, _ in connection.node.get_topic_names_and_types()]
        ours = connection.node.get_subscriptions_info_by_topic('/achieved_goal')
        assert '/latest_tick' in names and len(ours) == 1, 'one of the test, none of the viewer'
        began = time.monotonic()
        connection.received['latest_tick'].clear()
        connection.received['joint_states'].clear()
        connection.spin(2.0)
        seconds = time.monotonic() - began
        seen, ticks = (len(connection.received[n]) for n in ('latest_tick', 'joint_states'))
        assert 5 * seconds < seen < 36 * seconds
        assert ticks > seen, 'a starved machine has few more'
        follower.robot.perform(SetPaused(True))
        follower.until(lambda p: p.facts.is_paused, 'pause')
        connection.spin(1.0)
        # The last tick, also where it came too soon after another one to be published at once.
        last = connection.received['joint_states']
        follower.until(lambda p: p.stamp_ns == message_stamp(last[-1]), 'last tick')
        picture = follower.picture
        achieved = decode(
            topic(task_spec('FetchPush'), 'achieved_goal'), connection.received['achieved_goal'][-1]
        )
        np.testing.assert_array_equal(picture.frame.achieved_goal, achieved)
        end(robot)
        first = min(path for path in tmp_path.iterdir() if path.name[0] != '.')
        start_process(*VIEW_REPLAY, *ros_args(path=first, loop=True))
        follower.until(lambda p: p.facts.episode == 0 and p.facts.tick > 20, 'ticks of the replay')
        assert follower.picture.facts.seed == 5


@pytest.mark.release
def test_without_opengl_the_camera_says_so_and_the_rest_goes_on(
    start_process: Start, ros_environment: dict[str, str]
) -> None:
    from sensor_msgs.msg import Image

    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    environment = ros_environment | {'MUJOCO_GL': 'disabled'}
    node = start_process(*VISUALIZATION, env=environment)
    with client(REACH) as connection:
        scalars: list[object] = []
        (distance, *_) = scalar_topics(REACH)
        for name, kind, profile, take in (
            ('camera/image_raw', Image, distance.qos, lambda _: None),
            (distance.name, ros_message_class(distance.type_name), distance.qos, scalars.append),
        ):
            connection.node.create_subscription(kind, name, take, rclpy_profile(profile))
        connection.spin_until(lambda: len(scalars) > 25, 'scalars')
    node.send_signal(signal.SIGINT)
    output, errors = node.communicate(timeout=20)
    assert node.returncode == 0
    (line,) = [line for line in errors.splitlines() if 'ERROR' in line]
    assert 'MUJOCO_GL=disabled; allowed: egl' in line
    assert 'Traceback' not in output + errors
    (said,) = [line for line in errors.splitlines() if 'FetchReach: publishes' in line]
    assert 'goal_markers' in said and distance.name in said


def test_scalars_are_those_of_the_tick_with_their_stamp(start_process: Start) -> None:
    spec = task_spec('HandManipulateBlockFull')
    metric = GoalMetric(spec)
    start_process(*SIM_NODE, *ros_args(task=spec.name))
    node = start_process(*VISUALIZATION)
    with client(spec) as connection:
        connection.subscribe('achieved_goal', 'desired_goal')
        seen: dict[str, dict[int, float]] = {}

        def subscribe(source):
            def keep(message):
                stamp = message_stamp(message)
                seen.setdefault(source.name, {})[stamp] = decode(source, message)[0]

            connection.node.create_subscription(
                ros_message_class(source.type_name), source.name, keep, rclpy_profile(source.qos)
            )

        for source in scalar_topics(spec):
            subscribe(source)

        def ticks_seen_whole():
            goals = (connection.received[name] for name in ('achieved_goal', 'desired_goal'))
            return set.intersection(
                set(seen.get('scalars/distance', ())),
                set(seen.get('scalars/reward', ())),
                *({message_stamp(message) for message in messages} for messages in goals),
            )

        # Subscriptions connect one after the other. More than an episode, so that a reset is seen.
        connection.spin_until(lambda: len(ticks_seen_whole()) > 120, 'scalars', 60.0)
        assert set(seen) == {s.name for s in scalar_topics(spec)}
        goals = {
            name: {
                message_stamp(m): decode(topic(spec, name), m) for m in connection.received[name]
            }
            for name in ('achieved_goal', 'desired_goal')
        }
    end(node)
    # Of a desired_goal only the last is kept for a client that is late.
    stamps = sorted(set.intersection(*map(set, [seen['scalars/distance'], *goals.values()])))
    # A tick is 40 ms, and all come; a machine that is busy may lose some of them.
    assert len(stamps) > 0.5 * (stamps[-1] - stamps[0]) / 40e6 > 50.0
    for stamp in stamps[:-1]:
        achieved, desired = goals['achieved_goal'][stamp], goals['desired_goal'][stamp]
        distance, rotation = metric.distances(achieved, desired)
        assert seen['scalars/distance'][stamp] == distance
        assert seen['scalars/rotation'][stamp] == rotation
        assert seen['scalars/is_success'][stamp] == metric.success(achieved, desired)
        if stamp in seen['scalars/reward']:
            assert seen['scalars/reward'][stamp] == metric.reward(achieved, desired)
    assert set(seen['scalars/distance']) - set(seen['scalars/reward']), 'a reset has a reward'


def niceness_of_threads(process: int) -> list[int]:
    """The priority of each thread of a process, 0 as usual, higher for less."""
    files = Path(f'/proc/{process}/task').glob('*/stat')
    return [int(file.read_text().rpartition(')')[2].split()[16]) for file in files]


def processes_of_session(session: int) -> list[str]:
    """Command lines of what runs in a session."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = path.read_text().rpartition(')')[2].split()
            if int(fields[3]) == session and fields[0] != 'Z':
                found.append(path.with_name('cmdline').read_text())
        except OSError:
            continue
    return found


@pytest.mark.parametrize(
    ('arguments', 'line'),
    [
        (['--wait', '0.2', '--robot', 'nosuch'], 'no robot in namespace /nosuch'),
        (['--task', 'FetchReach', '--policy', 'nosuch'], 'policy_node ended'),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    start_process: Start, arguments: list[str], line: str
) -> None:
    process = start_process(*VIEW, *arguments)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1, error
    assert line in error and 'Traceback' not in error
    assert not processes_of_session(process.pid)
