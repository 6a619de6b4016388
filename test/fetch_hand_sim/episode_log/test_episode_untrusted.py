"""Hostile files end in a clear error at little cost."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from support import SUPPORT, script_environment

# `make torture` turns this up.
FILES = int(os.environ.get('EPISODE_MUTATIONS', '80'))
SCRIPT = SUPPORT / 'mutated_files.py'
READERS = 6


@pytest.mark.timeout(60 + FILES)
def test_damaged_files_end_in_one_line_or_a_result(finished):
    run = subprocess.run(
        [sys.executable, SCRIPT, finished / f'{finished.name}_0.mcap', str(FILES), '7'],
        capture_output=True,
        text=True,
        env=script_environment(),
    )
    assert run.returncode == 0, run.stderr
    report = json.loads(run.stdout)
    print(report)
    assert sum(report['outcomes'].values()) == READERS * FILES
    assert report['outcomes']['read_episode error'] > 0.8 * FILES
    assert report['slowest_s'] < 5.0
    # 330 MiB after 10,000 files; 820 after 80 without the limit on unpacked bytes.
    assert report['peak_bytes'] < 400 * 2**20
