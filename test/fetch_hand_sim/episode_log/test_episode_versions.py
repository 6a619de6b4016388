"""Episodes of earlier versions: read, listed, loaded, checked and replayed as before."""

from __future__ import annotations

import hashlib
from pathlib import Path

from fetch_hand_sim.commands import episodes_check, episodes_list
from fetch_hand_sim.episode_log import load_episodes, read_episode, read_summary, recover_episode
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.replay_node.schedule import ReplaySchedule

# Logged by version 0.1 at revision 2ce2393; never to be written again.
OLD = Path(__file__).parents[2] / 'data' / 'episodes_0_1'
EPISODE = OLD / 'FetchReach_000000_seed0'
FILE = EPISODE / f'{EPISODE.name}_0.mcap'
SHA256 = '842cbac0b71e66f6d781abc8212fad2e5b8d37ac54c1554370e8af023b76cabd'


def test_the_file_is_the_one_that_was_logged():
    assert hashlib.sha256(FILE.read_bytes()).hexdigest() == SHA256
    assert sum(path.stat().st_size for path in EPISODE.iterdir()) < 100_000


def test_it_reads_and_loads():
    episode, summary = read_episode(EPISODE), read_summary(EPISODE)
    assert episode.is_complete and summary.is_complete
    assert summary.message_count == sum(len(t.messages) for t in episode.topics.values()) == 509
    assert summary.size_bytes == FILE.stat().st_size
    (arrays,) = load_episodes(EPISODE)
    assert arrays.observations['observation'].shape == (51, 10)
    assert float(arrays.result['return']) == arrays.rewards.sum()
    assert len(ReplaySchedule(EPISODE).messages) == 459


def test_an_old_episode_is_checked_and_listed(capsys):
    assert episodes_check.main([str(OLD)]) == 0
    assert 'identical, 51 ticks, 459 messages' in capsys.readouterr().out
    assert episodes_list.main([str(OLD)]) == 0
    assert '1 episode, ' in capsys.readouterr().out


def test_cut_off_it_is_recovered(tmp_path):
    leftover = tmp_path / '.old.active'
    leftover.mkdir()
    (leftover / 'old_0.mcap').write_bytes(FILE.read_bytes()[: FILE.stat().st_size // 2])
    path = recover_episode(leftover)
    result = check_episode(path)
    assert result.difference is None and result.ticks > 20
