"""Playing files: frames equal the log, the playhead obeys, damaged neighbours are skipped."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, EpisodeReadError
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.films.recording import find_playable, load_recording
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame
from fetch_hand_sim.view.curves import Curves
from fetch_hand_sim.view.page.plots import command_curves, value_limits
from fetch_hand_sim.view.picture import Series
from fetch_hand_sim.view.player import Player
from fetch_hand_sim.view.requests import (
    ChangeEpisode,
    OpenEpisode,
    Seek,
    SetPaused,
    SetSpeed,
    StepOnce,
)
from msgs_spec.robots import FETCH
from msgs_spec.tasks import TASKS
from support.episode_recorder import Recorder
from support.tasks import each_task


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp('episodes')
    recorder = Recorder('FetchPush')
    for _ in range(3):
        recorder.record(EpisodeDirectory(directory))
    return directory


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def player(folder, clock):
    return Player(find_playable(folder), clock)


@each_task
def test_frames_are_what_was_logged(task, tmp_path):
    recorder = Recorder(task)
    path = recorder.record(EpisodeDirectory(tmp_path))
    recording, arrays = load_recording(path), load_episode(path)
    assert len(recording.frames) == len(arrays) + 1 == TASKS[task].episode_ticks + 1
    for tick, frame in enumerate(recording.frames):
        observation = {name: rows[tick] for name, rows in arrays.observations.items()}
        np.testing.assert_array_equal(frame.desired_goal, observation['desired_goal'])
        np.testing.assert_array_equal(frame.achieved_goal, observation['achieved_goal'])
        assert (frame.object_pose is not None) == TASKS[task].has_object
        assert frame.joint_position.shape == (len(TASKS[task].robot.joints),)
    if task.startswith('Hand'):
        joints = arrays.observations['observation'][:, : len(TASKS[task].robot.joints)]
        shown = np.array([frame.joint_position for frame in recording.frames])
        np.testing.assert_array_equal(shown, joints)


def test_it_plays_as_fast_as_asked(player, clock):
    assert player.picture().facts.tick == 0
    clock.now = 0.4
    assert player.picture().facts.tick == 10
    assert player.picture() is None, 'nothing new'
    player.perform(SetSpeed(2.0))
    clock.now = 0.6
    assert player.picture().facts.tick == 20
    player.perform(SetSpeed(1.0))
    clock.now = 2.0
    assert player.picture().facts.tick == 50
    clock.now = 3.2
    assert player.picture().facts.tick == 0, 'it starts again after the end'


def test_pause_steps_and_seeking(player, clock):
    player.perform(SetPaused(True))
    clock.now = 5.0
    assert player.picture().facts.tick == 0
    player.perform(StepOnce())
    assert player.picture().facts.tick == 1
    player.perform(Seek(40))
    picture = player.picture()
    assert (picture.facts.tick, picture.facts.ticks) == (40, 50)
    # Curves end at the playhead.
    for series in (picture.graphs.distance, picture.graphs.reward, picture.graphs.commands):
        assert len(series.times) == len(series.values) == 41
    player.perform(StepOnce(-1))
    assert player.picture().facts.tick == 39
    for beyond, end in ((-5, 0), (10**9, 50)):
        player.perform(Seek(beyond))
        assert player.index == end
    assert len(player.picture().graphs.distance.times) == 51


def test_episodes_are_chosen_one_by_one_or_by_number(player):
    numbers = []
    for request in (*map(ChangeEpisode, (1, 1, 1, -1)), OpenEpisode(1)):
        player.perform(request)
        numbers.append(player.picture().timeline.number)
    assert numbers == [1, 2, 0, 2, 1]
    player.perform(OpenEpisode(7))
    assert player.picture() is None


def test_a_read_only_page_plays_on(folder, clock):
    player = Player(find_playable(folder), clock, may_act=False)
    for request in (SetPaused(True), Seek(3), ChangeEpisode(1), OpenEpisode(2)):
        player.perform(request)
    clock.now += 0.4
    picture = player.picture()
    assert (picture.timeline.number, picture.facts.tick) == (0, 10)
    assert not picture.facts.may_command and '--read-only' in picture.facts.notice


@pytest.fixture
def damaged(folder, tmp_path):
    """Two episodes that end in the middle."""
    paths = [tmp_path / 'a.mcap', tmp_path / 'b.mcap']
    data = next(find_playable(folder)[0].glob('*.mcap')).read_bytes()
    for path in paths:
        path.write_bytes(data[: len(data) // 2])
    return paths


def test_the_first_readable_episode_is_opened_and_unreadable_ones_are_named(folder, damaged, clock):
    good = find_playable(folder)

    def shown(player):
        picture = player.picture()
        return picture.timeline.number, picture.facts.notice

    number, notice = shown(Player([damaged[0], *good], clock))
    assert number == 1 and 'skipped' in notice and 'a.mcap' in notice
    number, notice = shown(Player([*damaged, *good], clock))
    assert number == 2 and 'a.mcap' in notice and notice.endswith(' (and 1 more)')
    with pytest.raises(EpisodeReadError, match=r'none of 2 episodes can be read; .*a\.mcap'):
        Player(damaged, clock)
    player = Player([good[0], damaged[0], good[1]], clock)
    # A chosen one stays closed, and its neighbours are reached over it.
    player.perform(OpenEpisode(1))
    number, notice = shown(player)
    assert number == 0 and 'a.mcap' in notice and 'skipped' not in notice
    player.perform(ChangeEpisode(1))
    number, notice = shown(player)
    assert number == 2 and 'a.mcap' in notice
    player.perform(OpenEpisode(0))
    assert shown(player) == (0, '')


def test_deleted_episodes_are_reported(folder, tmp_path, clock):
    shutil.copytree(folder, tmp_path / 'gone')
    player = Player(find_playable(tmp_path / 'gone'), clock)
    shutil.rmtree(tmp_path / 'gone')
    player.perform(ChangeEpisode(1))
    picture = player.picture()
    assert picture.timeline.number == 0
    assert 'none of 3 episodes can be read' in picture.facts.notice
    assert 'No such file' in picture.facts.notice


def test_fingers_are_comparable_with_the_command_of_the_gripper():
    simulation = Simulation('FetchPickAndPlace', num_threads=1)
    spec, model = simulation.spec, simulation.model
    curves = Curves(GoalMetric(spec))
    ranges = [model.joint(name).range for name in spec.robot.joints if 'gripper_finger' in name]
    np.testing.assert_array_equal(ranges, [[0.0, 0.05]] * 2)
    simulation.reset(seed=0)
    for tick in range(20):
        # Opens, then closes.
        command = np.array([0.0, 0.0, 0.1, 1.0 if tick < 10 else -1.0])
        simulation.step_commands(command[None])
        joints = simulation.readings()['joint_states'][0][: len(spec.robot.joints)]
        goal = np.zeros(3)
        curves.add(tick * 0.04, Frame(joints, goal, goal, None, False), 0.0, command)
    graphs = curves.graphs()
    names = [list(command_curves(part, graphs, i)) for i, part in enumerate(spec.robot.command)]
    assert names == [['command, from where it is']] * 3 + [['command', 'fingers (1: 0.1 m apart)']]
    opening = command_curves(spec.robot.command[3], graphs, 3)['fingers (1: 0.1 m apart)'].values
    assert opening[9] == pytest.approx(1.0, abs=0.1) and opening[-1] == pytest.approx(-1.0, abs=0.1)


@pytest.mark.filterwarnings('error')
def test_a_gripper_of_another_robot_has_no_position():
    joints = tuple(name.replace('gripper_finger', 'jaw') for name in FETCH.joints)
    spec = replace(TASKS['FetchReach'], robot=replace(FETCH, joints=joints))
    curves, goal = Curves(GoalMetric(spec)), np.zeros(3)
    curves.add(0.0, Frame(np.zeros(len(joints)), goal, goal, None, False), 0.0, np.zeros(4))
    assert np.isnan(curves.graphs().positions.values).all()


def test_a_rotation_is_at_most_180_degrees():
    spec = TASKS['HandManipulateBlockFull']
    curves, place = Curves(GoalMetric(spec)), np.zeros(3)
    for angle in np.radians([10.0, 170.0, 190.0, 268.0, 350.0]):
        pose = [np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)]
        achieved, desired = np.r_[place, pose], np.r_[place, 1.0, 0.0, 0.0, 0.0]
        joints = np.zeros(len(spec.robot.joints))
        curves.add(0.0, Frame(joints, desired, achieved, None, False), None, None)
    shown = np.degrees(curves.graphs().rotation.values)
    np.testing.assert_allclose(shown, [10.0, 170.0, 170.0, 92.0, 10.0])


@pytest.mark.parametrize('threshold', [0.01, 0.1])
@pytest.mark.parametrize('values', [[0.3, 0.2], [0.3, 0.001], [0.005, 0.004], [0.1, 0.1], []])
def test_the_threshold_is_seen_whatever_the_curve_does(values, threshold):
    series = Series(np.arange(len(values)), np.array(values))
    lower, upper = value_limits([series], threshold, 0.0, 2.0)
    for each in [threshold, *values]:
        assert 0.1 < (each - lower) / (upper - lower) < 0.9


def test_an_axis_is_for_what_is_seen_of_a_curve():
    series = Series(np.array([0.0, 1.0, 2.0, 3.0]), np.array([99.0, 1.0, np.nan, 2.0]))
    lower, upper = value_limits([series], None, 0.5, 3.0)
    assert 0.5 < lower < 1.0 and 2.0 < upper < 2.5
