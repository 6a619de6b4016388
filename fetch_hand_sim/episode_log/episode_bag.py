"""What makes a bag an episode: the records at its beginning and at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.bag_file import BagFile
from fetch_hand_sim.episode_log.bag_metadata import metadata_record, metadata_yaml
from fetch_hand_sim.episode_log.limits import MAX_METADATA_BYTES
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings

# Names of the metadata records; of the two `rosbag2` ones readers take the last.
EPISODE, EPISODE_RESULT, ROSBAG2 = 'episode', 'episode_result', 'rosbag2'


def checked_strings(content: Mapping[str, str]) -> dict[str, str]:
    """Returns a copy of the contents of a record, if they can be written and read back.

    Raises:
        ValueError: If they are no strings, on which MCAP would fail in the middle of the file, or
            too long.
    """
    for key, value in content.items():
        if not isinstance(key, str) or not isinstance(value, str):
            raise ValueError(f'episode metadata are strings, not {key!r}: {value!r}')
    size = sum(len(text.encode()) for item in content.items() for text in item)
    if size > MAX_METADATA_BYTES:
        raise ValueError(f'{size} bytes of episode metadata; allowed: {MAX_METADATA_BYTES}')
    return dict(content)


def begin_bag(
    stream: BinaryIO,
    file_name: str,
    settings: LogSettings,
    metadata: dict[str, str],
    attachments: Sequence[Attachment],
) -> BagFile:
    """Writes what identifies the episode, so that a cut-off file can be told too."""
    bag = BagFile(
        stream,
        file_name,
        settings.chunk_size,
        settings.compression,
        has_attachments=bool(attachments),
    )
    bag.add_record(EPISODE, metadata)
    bag.add_record(ROSBAG2, metadata_record(bag.info, metadata))
    for attachment in attachments:
        bag.add_attachment(attachment.name, attachment.media_type, attachment.data)
    bag.flush()
    return bag


def end_bag(
    bag: BagFile, stream: BinaryIO, metadata: dict[str, str], result: dict[str, str]
) -> str:
    """Writes how the episode ended and the summary, as far as the operating system.

    Returns:
        The text of `metadata.yaml`.
    """
    custom_data = {**metadata, **result}
    bag.flush()
    info = bag.info
    bag.add_record(EPISODE_RESULT, result)
    bag.add_record(ROSBAG2, metadata_record(info, custom_data))
    bag.finish()
    stream.flush()
    return metadata_yaml(info, custom_data)


def store_bag(stream: BinaryIO, directory: Path, description: str) -> None:
    """Brings an ended bag and its `metadata.yaml` to the disk."""
    durable.sync(stream)
    durable.write_text(durable.metadata_file(directory), description)
