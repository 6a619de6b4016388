"""Episodes by the thousand, and Ctrl-C; what they contain is in `test_episode_tools.py`."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeLogError, EpisodeWriter
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import TASKS
from policy_node.policies.policy import PolicyError

ROBOTS = 2


def rest(observation: object) -> np.ndarray:
    return np.zeros((ROBOTS, 4))


def generator(
    directory: Path, act: Callable[[object], np.ndarray], simulation: Simulation | None = None
) -> EpisodeGenerator:
    simulation = simulation or Simulation('FetchReach', num_envs=ROBOTS, num_threads=1)
    return EpisodeGenerator(simulation, directory, act, RecordingContext(simulation))


@pytest.mark.parametrize('error', [KeyboardInterrupt, PolicyError])
def test_ctrl_c_or_a_failing_policy_reports_every_finished_episode(
    tmp_path: Path, error: type[BaseException]
) -> None:
    logged, asked = [], itertools.count()

    def act(observation: object) -> np.ndarray:
        if next(asked) == 2 * TASKS['FetchReach'].episode_ticks + 10:
            raise error
        return rest(observation)

    with pytest.raises(error):
        for each in generator(tmp_path, act).generate(10 * ROBOTS):
            logged.append(each.path)
    assert logged == sorted(tmp_path.iterdir())
    assert len(logged) == 2 * ROBOTS


def test_ctrl_c_while_a_file_is_written_leaves_whole_ones_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, write = itertools.count(1), EpisodeWriter.write_received

    def interrupted(self: EpisodeWriter, *arguments: object, **options: object) -> bool:
        if next(written) == 70:
            raise KeyboardInterrupt
        return write(self, *arguments, **options)

    monkeypatch.setattr(EpisodeWriter, 'write_received', interrupted)
    logged = []
    with pytest.raises(KeyboardInterrupt):
        for each in generator(tmp_path, rest).generate(ROBOTS):
            logged.append(each.path)
    assert len(logged) == 1 and logged == list(tmp_path.iterdir())


def test_a_full_disk_reports_every_finished_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, store = itertools.count(), EpisodeWriter.store

    def full(self: EpisodeWriter) -> Path | None:
        if next(written) == 0:
            raise EpisodeLogError('no space left')
        return store(self)

    monkeypatch.setattr(EpisodeWriter, 'store', full)
    logged = []
    with pytest.raises(EpisodeLogError, match='no space left'):
        for each in generator(tmp_path, rest).generate(ROBOTS):
            logged.append(each.path)
    assert len(logged) == ROBOTS - 1
    assert {*logged} == {path for path in tmp_path.iterdir() if path.name[0] != '.'}


def test_an_episode_that_mujoco_gave_up_is_no_whole_one(tmp_path: Path) -> None:
    """Its last tick is of the state that MuJoCo was set back to, so loading leaves it out."""
    simulation = Simulation('FetchReach', num_envs=ROBOTS, num_threads=1)
    velocity, asked = simulation.task.batch.bind('qvel'), itertools.count(1)

    def act(observation: object) -> np.ndarray:
        if next(asked) == 5:
            velocity[1, 0] = np.nan
        return rest(observation)

    whole, lost = generator(tmp_path, act, simulation).generate(ROBOTS)
    assert whole.is_complete and not lost.is_complete
    outcomes = [load_episode(each.path) for each in (whole, lost)]
    assert [each.outcome.reason for each in outcomes] == [None, 'diverged']
    assert [(each.is_complete, len(each)) for each in outcomes] == [(True, 50), (False, 4)]
    assert [each.outcome.steps for each in outcomes] == [50, 5]
