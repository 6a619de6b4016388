"""Sizes that writers and readers share: no writer makes a file that readers reject.

The largest episode that this project writes has 1,400 messages, 0.4 MB. Received messages come from
other processes, so they have an allowance, and a flood on one topic takes no room from the others.
"""

from __future__ import annotations

# Messages of a file, and the topics they belong to.
MAX_MESSAGES = 50_000
MAX_TOPICS = 64
# A chunk, and all chunks of a file together, unpacked.
MAX_CHUNK_BYTES = 16 * 2**20
MAX_UNPACKED_BYTES = 16 * 2**20
# Chunks of a file; each has an entry of some 250 bytes in the summary.
MAX_CHUNKS = 10_000
MAX_SUMMARY_BYTES = 4 * 2**20
# Records outside of chunks: an index of each of its topics follows each chunk.
MAX_RECORDS = 300_000
# A metadata record, and the metadata that a writer accepts; YAML may need ten times their size.
MAX_RECORD_BYTES = 2**20
MAX_METADATA_BYTES = 2**16
# Entries of a metadata record, or of the metadata of a channel.
MAX_MAP_ENTRIES = 1000
# Metadata records of a file; a robot writes two, and two for rosbag2.
MAX_METADATA_RECORDS = 16
# All attachments of a file, and the file; a compiled model has 3 MB.
MAX_ATTACHMENTS = 100
MAX_ATTACHMENT_BYTES = 64 * 2**20
MAX_FILE_BYTES = 128 * 2**20

# Received messages on one topic that an episode contains; the robot subscribes to four.
MAX_RECEIVED_MESSAGES = MAX_MESSAGES // 10
MAX_RECEIVED_BYTES = MAX_UNPACKED_BYTES // 8
