"""Episodes by the thousand, and Ctrl-C; what they contain is in `test_episode_tools.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeWriter
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.simulation import Simulation

ROBOTS = 2


def test_ctrl_c_reports_every_finished_episode(tmp_path: Path) -> None:
    logged = []
    simulation = Simulation('FetchReach', num_envs=ROBOTS, num_threads=1)
    asked = 0

    def act(observation: object) -> np.ndarray:
        nonlocal asked
        asked += 1
        if asked == 2 * simulation.spec.episode_ticks + 10:
            raise KeyboardInterrupt
        return np.zeros((ROBOTS, 4))

    generator = EpisodeGenerator(simulation, tmp_path, act, RecordingContext(simulation))
    with pytest.raises(KeyboardInterrupt):
        for each in generator.generate(10 * ROBOTS):
            logged.append(each.path)
    assert logged == sorted(tmp_path.iterdir())
    assert len(logged) == 2 * ROBOTS


def test_ctrl_c_while_a_file_is_written_leaves_whole_ones_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, write = 0, EpisodeWriter.write_received

    def interrupted(self: EpisodeWriter, *arguments: object, **options: object) -> bool:
        nonlocal written
        written += 1
        if written == 70:
            raise KeyboardInterrupt
        return write(self, *arguments, **options)

    monkeypatch.setattr(EpisodeWriter, 'write_received', interrupted)
    logged = []
    simulation = Simulation('FetchReach', num_envs=ROBOTS, num_threads=1)
    context = RecordingContext(simulation)
    generator = EpisodeGenerator(simulation, tmp_path, lambda _: np.zeros((ROBOTS, 4)), context)
    with pytest.raises(KeyboardInterrupt):
        for each in generator.generate(ROBOTS):
            logged.append(each.path)
    assert len(logged) == 1 and logged == list(tmp_path.iterdir())


def test_an_episode_that_mujoco_gave_up_is_no_whole_one(tmp_path: Path) -> None:
    """Its last tick is of the state that MuJoCo was set back to."""
    simulation = Simulation('FetchReach', num_envs=ROBOTS, num_threads=1)
    velocity, asked = simulation.task.batch.bind('qvel'), 0

    def act(observation: object) -> np.ndarray:
        nonlocal asked
        asked += 1
        if asked == 5:
            velocity[1, 0] = np.nan
        return np.zeros((ROBOTS, 4))

    generator = EpisodeGenerator(simulation, tmp_path, act, RecordingContext(simulation))
    whole, lost = generator.generate(ROBOTS)
    assert whole.is_complete and not lost.is_complete
    outcomes = [load_episode(each.path) for each in (whole, lost)]
    assert [each.outcome.reason for each in outcomes] == [None, 'diverged']
    assert [(each.is_complete, len(each)) for each in outcomes] == [(True, 50), (False, 5)]
