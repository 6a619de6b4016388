"""Every way a run can end: killed at random moments, disks that fill up, vanish or refuse."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fetch_hand_sim.commands import episodes_recover
from fetch_hand_sim.episode_log import find_episodes, find_leftovers, read_episode
from msgs_spec.tasks import task_spec
from support import SUPPORT, script_environment
from support.graph import SIM_NODE, client, end, finish, ros_args

# `make torture` turns this up.
KILLS = int(os.environ.get('EPISODE_KILLS', '10'))
LONGEST_LIFE = float(os.environ.get('EPISODE_LIFE', '0.6'))
SCRIPT = SUPPORT / 'killed_recorder.py'
# Of finished files, how many may wait for the disk when a robot is killed.
MOST_UNSTORED = 16
REACH = task_spec('FetchReach')
MIB = 1024 * 1024


@pytest.mark.alone
@pytest.mark.timeout(60 + 10 * KILLS)
def test_killed_at_random_moments_a_robot_loses_a_quarter_of_a_second(tmp_path):
    """At factors 1 to 50 of real time, and nothing is left that recovery could not clear away."""
    run = subprocess.run(
        [sys.executable, SCRIPT, tmp_path, str(KILLS), str(LONGEST_LIFE), '5'],
        capture_output=True,
        text=True,
        env=script_environment(),
        check=False,
    )
    assert run.returncode == 0, run.stderr
    losses = [lost_seconds(**json.loads(line)) for line in run.stdout.splitlines()]
    print(f'{len(losses)} kills, lost at most {max(losses):.3f} s: {np.round(losses, 3).tolist()}')
    assert len(losses) == KILLS
    assert max(losses) <= 0.25
    # The moments are random, and yet most of them hit an episode being written.
    assert np.count_nonzero(losses) >= KILLS // 2


def lost_seconds(directory, factor, ticks):
    """Recover the leftovers of a killed robot; return the lost wall-clock time.

    It lasts from the first lost tick to the last, and at most as long as these ticks take: on a
    busy machine the robot may have been suspended between them.
    """
    path = Path(directory)
    if path.exists():
        for finished in find_episodes(path):
            assert read_episode(finished).is_complete
        assert len(find_leftovers(path)) <= 1 + MOST_UNSTORED
        assert episodes_recover.main([directory]) == 0
        assert find_leftovers(path) == []
    known = {
        (int(name.name.split('_')[1]), message.log_time_ns)
        for name in (find_episodes(path) if path.exists() else [])
        for message in read_episode(name).topics['/clock'].messages
    }
    made = [((episode, stamp), wall) for episode, stamp, wall in ticks]
    lost = [wall for tick, wall in made if tick not in known]
    # All that is lost is at the end.
    assert [wall for _, wall in made[len(made) - len(lost) :]] == lost
    if not lost:
        return 0.0
    return min(lost[-1] - lost[0] + 0.04 / factor, len(lost) * 0.04 / factor)


def error_lines(output):
    return [line for line in output.splitlines() if '[ERROR]' in line]


def ticks_after(listener, count=30):
    """Waits for that many more ticks: the robot is alive."""
    before = len(listener.received['joint_states'])
    listener.spin_until(
        lambda: len(listener.received['joint_states']) >= before + count, 'more ticks'
    )


def wait_for_episode_in_progress(listener, directory):
    listener.spin_until(
        lambda: directory.exists() and any(directory.glob('.*.active')), 'an episode in progress'
    )


def fill(directory):
    """Takes all room of the disk."""
    with (directory.parent / 'filler').open('wb', buffering=0) as file:
        size = MIB
        while size:
            try:
                file.write(bytes(size))
            except OSError:
                size //= 2


@pytest.mark.parametrize(
    ('harm', 'message'),
    [
        (fill, 'No space left on device|MiB free on the disk'),
        (shutil.rmtree, 'No such file or directory'),
    ],
)
def test_a_disk_that_fails_stops_the_log_and_not_the_robot(
    start_process, mount, tmp_path, harm, message
):
    directory = (mount('size=80m') if harm is fill else tmp_path) / 'episodes'
    # Slow: between two episodes nothing is written, and the directory would be made anew.
    robot = start_process(*SIM_NODE, *ros_args(episode_dir=directory, real_time_factor=0.3))
    with client(REACH) as listener:
        listener.subscribe('joint_states', '/diagnostics')
        wait_for_episode_in_progress(listener, directory)
        harm(directory)
        listener.spin_until(
            lambda: any('has failed' in report.message for report in listener.reports()),
            'failed log',
        )
        ticks_after(listener, 5)
    (error,) = error_lines(end(robot))
    assert re.search(message, error)


def test_episodes_that_were_asked_for_and_not_logged_are_a_failure(start_process, mount):
    disk = mount('size=8m')
    arguments = ros_args(episode_dir=disk, episodes=3, real_time_factor=0.0)
    code, output = finish(start_process(*SIM_NODE, *arguments))
    assert code == 1 and 'Traceback' not in output
    (error,) = error_lines(output)
    assert 'less than 64 MiB free on the disk' in error
    assert list(disk.iterdir()) == []
    # Episodes that are not logged are still reported.
    assert 'episode 2 seed 2: 50 steps, return' in output
    assert output.splitlines()[-1] == f'sim_node: not all episodes are in {disk}'


def test_a_terminated_robot_closes_its_episode(start_process, tmp_path):
    # Slow, so that no episode ends by itself just then.
    robots = {
        number: start_process(
            *SIM_NODE,
            *ros_args(episode_dir=tmp_path / number.name, real_time_factor=0.2),
            *('-r', f'__ns:=/{number.name}'),
        )
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    for number, robot in robots.items():
        directory = tmp_path / number.name
        with client(REACH) as listener:
            wait_for_episode_in_progress(listener, directory)
        robot.send_signal(number)
        code, output = finish(robot)
        assert code == 0 and 'Traceback' not in output, output
        (episode,) = map(read_episode, find_episodes(directory))
        assert not episode.is_complete
        assert episode.result['reason'] == number.name
        assert find_leftovers(directory) == []


def test_a_robot_under_nohup_survives_its_terminal(start_process):
    robot = start_process('nohup', *SIM_NODE, stdin=subprocess.DEVNULL)
    with client(REACH) as listener:
        listener.subscribe('joint_states')
        ticks_after(listener, 1)
        robot.send_signal(signal.SIGHUP)
        ticks_after(listener)
    end(robot)
