"""The revision that episodes and actors name."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from node_runtime.source_revision import revision_of


def git(root: Path, *arguments: str) -> str:
    identity = ('-c', 'user.name=a', '-c', 'user.email=a@b')
    command = ['git', '-C', str(root), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_a_revision_is_dirty_where_code_differs_and_not_where_pages_do(tmp_path: Path) -> None:
    for name in ('msgs_spec/tasks.py', 'policy_node/actors/Reach.json', 'docs/research/page.md'):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('first')
    git(tmp_path, 'init', '-q')
    with pytest.raises(subprocess.SubprocessError):
        revision_of(tmp_path)
    git(tmp_path, 'add', '-A')
    git(tmp_path, 'commit', '-qm', 'first')
    commit = git(tmp_path, 'rev-parse', 'HEAD')
    assert revision_of(tmp_path) == commit
    (tmp_path / 'docs/research/page.md').write_text('second')
    (tmp_path / 'policy_node/new.py').write_text('not of the commit')
    assert revision_of(tmp_path) == commit
    (tmp_path / 'msgs_spec/tasks.py').write_text('second')
    assert revision_of(tmp_path) == f'{commit}-dirty'
