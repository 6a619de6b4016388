"""Sizes that nodes, writers and readers agree on: nothing is written that a reader refuses.

The two limits of a file are two orders above the largest episode this project writes.
"""

from __future__ import annotations

# A message: the longest a robot sends or understands has 3 KB. A robot drops what is longer before
# it decodes or logs it.
MAX_MESSAGE_BYTES = 64 * 2**10
# A chunk of a file, unpacked.
MAX_CHUNK_BYTES = 16 * 2**20
# All chunks of a file together, unpacked.
MAX_UNPACKED_BYTES = 64 * 2**20
