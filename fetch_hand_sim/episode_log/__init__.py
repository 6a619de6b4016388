"""Episodes as MCAP files: one rosbag2 bag per episode, complete or marked as interrupted."""

from fetch_hand_sim.episode_log.arrays import EpisodeArrays, load_episodes
from fetch_hand_sim.episode_log.bag import Attachment
from fetch_hand_sim.episode_log.files import (
    EpisodeExistsError,
    EpisodeInUseError,
    EpisodeLogError,
    EpisodeReadError,
    expand_episodes,
    find_episodes,
)
from fetch_hand_sim.episode_log.metadata import EpisodeOutcome, EpisodeRecord, episode_metadata
from fetch_hand_sim.episode_log.reader import Episode, EpisodeSummary, read_episode, read_summary
from fetch_hand_sim.episode_log.recovery import Leftover, find_leftovers, recover_episode
from fetch_hand_sim.episode_log.writer import (
    EpisodeDirectory,
    EpisodeWriter,
    episode_name,
)

__all__ = [
    'Attachment',
    'Episode',
    'EpisodeArrays',
    'EpisodeDirectory',
    'EpisodeExistsError',
    'EpisodeInUseError',
    'EpisodeLogError',
    'EpisodeOutcome',
    'EpisodeReadError',
    'EpisodeRecord',
    'EpisodeSummary',
    'EpisodeWriter',
    'Leftover',
    'episode_metadata',
    'episode_name',
    'expand_episodes',
    'find_episodes',
    'find_leftovers',
    'load_episodes',
    'read_episode',
    'read_summary',
    'recover_episode',
]
