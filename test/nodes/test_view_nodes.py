"""Viewers beside a running robot: they see it, act on it, and it does not notice them."""

from __future__ import annotations

import signal
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import PIL.Image
import pytest
from std_srvs.srv import SetBool

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.simulation.opengl import prepare_opengl
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.view.live import LiveRobot
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
from msgs_spec.topics import topic
from support import running_processes, stat_of
from support.episode_recorder import Recorder
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    VIEW,
    Client,
    Start,
    client,
    end,
    episodes_in,
    logged_run,
    open_view,
    payload,
    ros_args,
)
from support.visitors import DeafVisitor, Visitor

REACH = task_spec('FetchReach')
VIEW_REPLAY = (sys.executable, '-m', 'fetch_hand_sim.replay_node')
VISUALIZATION = (sys.executable, '-m', 'fetch_hand_sim.visualization_node')
TOPIC = 'achieved_goal'
CONTROL_HZ = 25.0
# Allowed loss of ticks per second.
LOSS = 0.4
# Seconds before a turn and of a turn; after so many pairs of turns the robot is found too slow.
SETTLING, TURN = 0.5, 3.0
PAIRS = 6
ACTOR = str(Path(__file__).parents[2] / 'policy_node' / 'actors' / 'FetchReach.safetensors')


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


def can_render() -> bool:
    try:
        prepare_opengl()
    except RuntimeError:
        return False
    return True


def test_a_page_commands_its_robot_unless_it_is_read_only(start_process: Start) -> None:
    settings = {'perturb_limit': 20.0, 'real_time_factor': 2.0}
    start_process(*SIM_NODE, *ros_args(task='FetchReach', **settings))
    goal = np.array([1.3, 0.8, 0.6])
    with client(REACH) as connection:
        follower = Follower(connection, may_command=False)
        follower.until(lambda p: p.frame is not None, 'picture')
        follower.robot.perform(SetGoal(goal))
        follower.robot.perform(SetPaused(True))
        assert 'only watch' in follower.robot.picture().facts.notice
        stamp = follower.picture.stamp_ns
        follower.until(lambda p: p.stamp_ns > stamp, 'another tick')
        assert not np.allclose(follower.picture.frame.desired_goal, goal)
        assert not connection.node.get_publishers_info_by_topic('/set_goal')
    with client(REACH) as connection:
        connection.subscribe('desired_goal')
        follower = Follower(connection)
        follower.until(lambda p: p.frame is not None and p.facts.rate > 10.0, 'picture')
        assert follower.picture.graphs.distance.values[-1] > 0.0

        follower.until(lambda p: p.facts.speed == 2.0, 'speed that it was started with')
        assert connection.set_parameter('/sim_node', 'real_time_factor', 0.123).successful
        follower.until(lambda p: p.facts.speed == 0.123, 'speed that another program has set')
        follower.robot.perform(SetSpeed(5000.0))
        follower.until(lambda p: 'refuses real_time_factor' in p.facts.notice, 'refusal')
        assert follower.picture.facts.speed == 0.123
        assert connection.set_parameter('/sim_node', 'real_time_factor', 0.0).successful
        follower.until(lambda p: p.facts.speed == 0.0, 'no speed at all')
        assert follower.picture.facts.has_speed
        follower.robot.perform(SetSpeed(1.0))
        follower.until(lambda p: p.facts.speed == 1.0, 'speed of the page')

        follower.robot.perform(SetGoal(goal))
        desired = topic(REACH, 'desired_goal')
        connection.spin_until(
            lambda: np.allclose(decode(desired, connection.received['desired_goal'][-1]), goal),
            'the goal',
        )
        follower.robot.perform(Reset(seed=77))
        follower.until(lambda p: p.facts.seed == 77, 'episode of that seed')
        # No node commands, so only a push moves the gripper.
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


def test_a_page_commands_until_a_policy_does_and_then_chooses_its_actor(
    start_process: Start,
) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    with client(REACH) as connection:
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

        follower.until(
            lambda p: 'FetchReach' in p.facts.commander and p.facts.actors, 'actor that commands'
        )
        follower.until(lambda p: p.facts.actor == 'FetchReach', 'its name')
        follower.robot.perform(ChooseActor('nosuch'))
        follower.until(lambda p: 'refuses policy' in p.facts.notice, 'refusal')
        assert follower.picture.facts.actor == 'FetchReach', 'it acts still'
        assert connection.set_parameter('/policy_node', 'policy', ACTOR).successful
        follower.until(lambda p: p.facts.actor == ACTOR, 'actor that another program has set')
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


def test_a_replay_of_any_name_is_told_from_a_robot_and_paused(
    start_process: Start, tmp_path: Path
) -> None:
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    renamed = ['-r', '__node:=player', '-r', '__ns:=/left', '-r', '~/pause:=/left/halt']
    start_process(*VIEW_REPLAY, *ros_args(path=path, loop=True, rate=0.8), *renamed)
    with client(REACH, namespace='left') as connection:
        follower = Follower(connection)
        follower.until(lambda p: p.facts.rate > 1.0 and p.facts.tick > 0, 'replay')
        facts = follower.picture.facts
        assert facts.commander == 'a replay (/left/player)'
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
        assert connection.call(SetBool, '/left/halt', data=False).success
        follower.until(lambda p: not p.facts.is_paused and p.stamp_ns != stamp, 'it goes on')


def wait_for_pictures(connection: Client, visitor: Visitor) -> None:
    """Waits until a visitor has seen more than it had."""
    wanted = visitor.pictures + 5
    connection.spin_until(lambda: visitor.pictures > wanted, 'pictures')


def assert_keeps_pace(
    connection: Client, beside: Callable[[], AbstractContextManager[object]]
) -> None:
    """Compare the simulated time that passes with and without a load.

    Other processes slow both kinds of turns, so on a busy machine more pairs of turns follow until
    both are equally fast. A missed tick is lost, so simulated time counts all of them.

    Args:
        connection: A client that subscribed to `TOPIC`.
        beside: Context in which the load runs.
    """
    alone, disturbed = np.zeros(2), np.zeros(2)
    for _ in range(PAIRS):
        alone += progress(connection)
        with beside():
            disturbed += progress(connection)
        before, now = (CONTROL_HZ * simulated / real for simulated, real in (alone, disturbed))
        # A busy machine may deliver ticks in bursts, above 25 Hz.
        if now > min(before, CONTROL_HZ) - LOSS:
            return
    raise AssertionError(f'{now:.2f} Hz, {before:.2f} Hz without load')


def progress(connection: Client) -> np.ndarray:
    """Return simulated and real seconds between the arrivals of two ticks."""
    # Ticks that arrived before the subscriber spins would have a wrong arrival time.
    connection.spin(SETTLING)
    began = next_tick(connection)
    connection.spin(TURN)
    return next_tick(connection) - began


def next_tick(connection: Client) -> np.ndarray:
    """Return stamp and arrival of the next tick, in seconds."""
    ticks = connection.received[TOPIC]
    count = len(ticks)
    connection.spin_until(lambda: len(ticks) > count, 'tick')
    return np.array([1e-9 * message_stamp(ticks[-1]), connection.received_at[TOPIC][-1]])


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
            view, url, _ = open_view(start_process, '--wait', '30')
            assert set(niceness_of_threads(view.pid)) == {10}
            visitor = Visitor(urlsplit(url).netloc, 'visitor')
            wait_for_pictures(connection, visitor)
            if harm == 'visitor is deaf':
                with DeafVisitor(urlsplit(url).netloc):
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


@pytest.mark.alone
def test_episodes_are_logged_to_the_same_bytes_with_and_without_viewers(
    start_process: Start, tmp_path: Path
) -> None:
    """A page with its visitor, markers, scalars and pictures leave no trace in them."""

    policy = start_process(*POLICY_NODE)
    logged_run(start_process, tmp_path / 'alone', seed=7, episodes=4)
    end(policy)
    settings = {'mode': 'lockstep', 'seed': 7, 'episode_dir': tmp_path / 'watched'}
    robot = start_process(*SIM_NODE, *ros_args(wait_for_commands=True, **settings))
    node = start_process(*VISUALIZATION, *ros_args(camera_width=64, camera_height=48))
    view, url, _ = open_view(start_process, '--wait', '30')
    visitor = Visitor(urlsplit(url).netloc, 'visitor')
    names = ['goal_markers', 'scalars/distance', *(['camera/image_raw'] if can_render() else [])]
    with client(REACH) as connection:
        connection.subscribe('episode_status', *names)
        wait_for_pictures(connection, visitor)
        # There is no tick before the first command, but by then all of them are there.
        connection.spin_until(
            lambda: (
                all(connection.node.count_publishers(name) for name in names)
                and connection.node.count_subscribers('latest_tick')
            ),
            'page and node',
        )
        policy = start_process(*POLICY_NODE)
        connection.spin_until(
            lambda: (
                min(len(connection.stamps(name)) for name in names) > 1
                and len(connection.stamps('scalars/distance')) > 8
                and connection.statuses()[-1].episode > 3
            ),
            'markers, scalars and pictures of four episodes',
        )
    for process in (policy, view, node, robot):
        end(process)
    first, second = (episodes_in(tmp_path / name)[:4] for name in ('alone', 'watched'))
    for alone, watched in zip(first, second, strict=True):
        assert payload(alone) == payload(watched)
        # The only value that differs between two runs.
        assert alone.metadata.pop('started') != watched.metadata.pop('started')
        for part in ('metadata', 'result', 'attachments', 'schemas', 'channels'):
            assert getattr(alone, part) == getattr(watched, part), part


def test_standard_tools_get_what_they_need_also_from_a_robot_that_stands_still(
    start_process: Start,
) -> None:
    # Also if the topic of the joint states has another name.
    other = ('-r', 'joint_states:=/arm/joints')
    robot = start_process(*SIM_NODE, *ros_args(task='FetchReach'), *other)
    parameters = ros_args(camera_width=64, camera_height=48, camera_hz=5.0)
    node = start_process(*VISUALIZATION, *parameters, *other)
    with client(REACH) as connection:
        received = connection.received
        goals = 'achieved_goal', 'desired_goal'
        connection.subscribe(*goals, 'robot_description', 'goal_markers')
        # Without tf2_msgs, which PyPI lacks, the node has no topic of frames.
        names = ['goal_markers', 'scalars/distance', *(['/tf'] if find_spec('tf2_msgs') else [])]
        connection.subscribe('scalars/distance')
        connection.spin_until(
            lambda: (
                len(received['scalars/distance']) > 5
                and received['robot_description']
                and received['goal_markers']
            ),
            'description, markers and scalars',
        )
        root = ElementTree.fromstring(received['robot_description'][0].data)
        assert set(REACH.robot.joints) <= {joint.get('name') for joint in root.findall('joint')}
        assert len(received['goal_markers'][0].markers) > 2
        assert connection.node.count_publishers('camera/image_raw') == 1
        if can_render():
            names.append('camera/image_raw')
            pictures = 'camera/image_raw', 'camera/camera_info', 'camera/image_raw/compressed'
            connection.subscribe(*pictures)
            connection.spin_until(lambda: all(received[name] for name in pictures), 'pictures')
            picture, info, jpeg = (received[name][0] for name in pictures)
            values = np.array(picture.data).reshape(48, 64, 3)
            assert values.std() > 10.0
            assert (info.width, info.height) == (64, 48)
            small = np.asarray(PIL.Image.open(BytesIO(bytes(jpeg.data))))
            assert small.shape == values.shape and small.std() > 10.0
        assert connection.call(SetBool, '/sim_node/pause', data=True).success
        connection.spin(1.0)
        last = connection.stamps('achieved_goal')[-1:]
        # Pictures are fewer than ticks, but the last one shows the last tick.
        connection.spin_until(
            lambda: all(connection.stamps(n)[-1:] == last for n in (*goals, *names) if n != '/tf'),
            'last picture',
        )
        values = [decode(topic(REACH, name), received[name][-1]) for name in goals]
        distance = received['scalars/distance'][-1].vector.x
        assert distance == GoalMetric(REACH).distances(*values)[0]
        late = Client(REACH, 'late')
        late.subscribe(*names)
        late.spin_until(lambda: all(late.stamps(name) == last for name in names), 'last tick again')
        # And once only.
        connection.spin(1.5)
        count = len(received['scalars/distance'])
        connection.spin(1.5)
        assert len(received['scalars/distance']) == count
        # Nothing is published of a robot that has shut down.
        end(robot)
        late.received.clear()
        later = Client(REACH, 'later')
        later.subscribe('goal_markers')
        later.spin(2.0)
        assert not later.received
        for each in (late, later):
            each.close()
    end(node)


def test_another_robot_in_the_same_place_is_followed(start_process: Start) -> None:
    """Its goals come on the same topics with another type, or its joints have other names."""
    node = start_process(*VISUALIZATION, *ros_args(use_sim_time=True))
    for task, names in (
        ('FetchPush', {}),
        ('HandReach', {}),
        ('HandReach', {'joint_prefix': 'rh_'}),
    ):
        spec = task_spec(task, **names)
        robot = start_process(*SIM_NODE, *ros_args(task=task, **names))
        with client(spec) as connection:
            connection.subscribe('joint_states', 'scalars/reward', 'robot_description')

            def is_followed(spec=spec, connection=connection):
                description = connection.received['robot_description'][-1].data
                stamps = map(connection.stamps, ('joint_states', 'scalars/reward'))
                seen = set.intersection(*map(set, stamps))
                return f'"{spec.robot.joints[-1]}"' in description and len(seen) > 10

            connection.spin_until(is_followed, f'scalars of {task}')
        end(robot)
    end(node)


@pytest.mark.alone
def test_a_fast_robot_is_seen_as_it_is_now_and_then_and_a_replay_after_it(
    start_process: Start, tmp_path: Path
) -> None:
    """A robot publishes one message for all of a tick; a replay has none of these."""
    settings = {'real_time_factor': 0.0, 'episode_dir': tmp_path, 'seed': 5}
    robot = start_process(*SIM_NODE, *ros_args(task='FetchPush', **settings))
    with client(task_spec('FetchPush')) as connection:
        connection.subscribe('joint_states', 'achieved_goal')
        follower = Follower(connection)
        follower.until(lambda p: p.facts.episode > 3 and p.frame is not None, 'episodes')
        names = [name for name, _ in connection.node.get_topic_names_and_types()]
        ours = connection.node.get_subscriptions_info_by_topic('/achieved_goal')
        assert '/latest_tick' in names and len(ours) == 1, 'one of the test, none of the viewer'
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
def test_without_opengl_only_the_camera_fails_and_reports_it(
    start_process: Start, ros_environment: dict[str, str]
) -> None:
    start_process(*SIM_NODE, *ros_args(task='FetchReach'))
    node = start_process(*VISUALIZATION, env=ros_environment | {'MUJOCO_GL': 'disabled'})
    with client(REACH) as connection:
        connection.subscribe('camera/image_raw', 'scalars/distance')
        connection.spin_until(lambda: len(connection.received['scalars/distance']) > 25, 'scalars')
    output = end(node)
    (line,) = [line for line in output.splitlines() if 'ERROR' in line]
    assert 'MUJOCO_GL=disabled; allowed: egl' in line
    (said,) = [line for line in output.splitlines() if 'FetchReach: publishes' in line]
    assert 'goal_markers' in said and 'scalars/distance' in said


def niceness_of_threads(process: int) -> list[int]:
    """The priority of each thread of a process, 0 as usual, higher for less."""
    files = Path(f'/proc/{process}/task').glob('*/stat')
    return [int(file.read_text().rpartition(')')[2].split()[16]) for file in files]


@pytest.mark.parametrize(
    ('arguments', 'line'),
    [
        (['--wait', '0.2', '--robot', 'nosuch'], 'no robot in namespace /nosuch'),
        (['--task', 'FetchReach', '--policy', 'nosuch'], 'policy_node ended'),
    ],
)
def test_a_source_that_cannot_be_shown_is_one_line(
    start_process: Start, arguments: list[str], line: str
) -> None:
    process = start_process(*VIEW, *arguments)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1, error
    assert line in error and 'Traceback' not in error
    assert not [each for each in running_processes() if stat_of(each)[3:4] == [str(process.pid)]]
