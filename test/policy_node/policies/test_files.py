"""Files that two processes write at the same time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from policy_node.policies.files import write_files

_WRITER = """
import sys
from pathlib import Path
from policy_node.policies.files import write_files
file, letter = Path(sys.argv[1]), sys.argv[2].encode()
for _ in range(25):
    write_files({file: letter * 100_000})
"""


def test_a_file_that_two_processes_write_at_once_is_always_whole(tmp_path: Path) -> None:
    file = tmp_path / 'benchmark.csv'
    write_files({file: b'a' * 100_000})
    writers = [
        subprocess.Popen([sys.executable, '-c', _WRITER, str(file), letter]) for letter in 'ab'
    ]
    while any(writer.poll() is None for writer in writers):
        data = file.read_bytes()
        assert data in (b'a' * 100_000, b'b' * 100_000), 'a reader sees one or the other'
    assert [writer.returncode for writer in writers] == [0, 0]
    assert os.listdir(tmp_path) == [file.name]
