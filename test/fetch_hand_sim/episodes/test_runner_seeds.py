"""Seeds of episodes: one after the other, from the seed that was set."""

from __future__ import annotations

import pytest

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from support.episode_recorder import rested_episode


@pytest.fixture(scope='module')
def simulation():
    return Simulation('FetchReach', num_threads=1)


def run_episode(runner):
    """Runs the next episode; returns its ticks."""
    return [tick for tick, _ in rested_episode(runner)]


def test_a_seed_takes_effect_at_the_next_episode(simulation):
    runner = EpisodeRunner(simulation, first_seed=3)
    seen = [run_episode(runner)[0].status.seed for _ in range(2)]
    runner.set_next_seed(100)
    assert runner.seed == 100
    seen += [run_episode(runner)[0].status.seed for _ in range(2)]
    assert seen == [3, 4, 100, 101]


def test_the_first_seed_follows_the_last(simulation):
    """So that every episode can be run again: no parameter takes more."""
    runner = EpisodeRunner(simulation, first_seed=2**32 - 1)
    assert [run_episode(runner)[0].status.seed for _ in range(2)] == [2**32 - 1, 0]


def test_the_running_episode_keeps_its_own(simulation):
    runner = EpisodeRunner(simulation, first_seed=3)
    runner.advance(runner.resting_command())
    runner.set_next_seed(7)
    runner.set_next_seed(50)
    assert runner.seed == 3
    assert runner.advance(runner.resting_command()).status.seed == 3
    runner.end_episode()
    assert runner.seed == 50
    assert {tick.status.seed for tick in run_episode(runner)} == {50}
    assert run_episode(runner)[-1].status.seed == 51


def test_a_number_of_episodes_counts_from_the_first_of_them(simulation):
    runner = EpisodeRunner(simulation, episodes=2, first_episode=5)
    for _ in range(2):
        assert not runner.is_done
        run_episode(runner)
    assert runner.is_done


@pytest.mark.parametrize('episodes', [0, 2])
def test_a_series_that_begins_again_has_the_seed_that_was_set_last(simulation, episodes):
    runner = EpisodeRunner(simulation, first_seed=3, first_episode=4)
    runner.set_next_seed(100)
    for _ in range(episodes):
        run_episode(runner)
    runner.start_over()
    assert (runner.episode, runner.seed) == (4, 100)
    assert [run_episode(runner)[0].status.seed for _ in range(2)] == [100, 101]
