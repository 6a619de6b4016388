"""Episodes as MCAP files: one rosbag2 bag per episode, complete or marked as interrupted."""

from fetch_hand_sim.episode_log.arrays import EpisodeArrays, load_episodes
from fetch_hand_sim.episode_log.episode_metadata import episode_metadata
from fetch_hand_sim.episode_log.episode_record import EpisodeOutcome, EpisodeRecord
from fetch_hand_sim.episode_log.episodes import EpisodeDirectory, episode_name
from fetch_hand_sim.episode_log.errors import (
    EpisodeExistsError,
    EpisodeInUseError,
    EpisodeLogError,
    EpisodeReadError,
)
from fetch_hand_sim.episode_log.leftovers import Leftover, find_leftovers
from fetch_hand_sim.episode_log.log_times import log_time
from fetch_hand_sim.episode_log.reader import Episode, read_episode
from fetch_hand_sim.episode_log.recovery import recover_episode
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings
from fetch_hand_sim.episode_log.summary import (
    EpisodeSummary,
    expand_episodes,
    find_episodes,
    read_summary,
)
from fetch_hand_sim.episode_log.writer import EpisodeWriter

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
    'LogSettings',
    'episode_metadata',
    'episode_name',
    'expand_episodes',
    'find_episodes',
    'find_leftovers',
    'load_episodes',
    'log_time',
    'read_episode',
    'read_summary',
    'recover_episode',
]
