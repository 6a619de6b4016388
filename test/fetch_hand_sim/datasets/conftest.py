"""Logged episodes, and the command that makes datasets of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from fetch_hand_sim.commands import episodes_export


@pytest.fixture(scope='session')
def episodes(tmp_path_factory):
    """A folder of three episodes of FetchPush under random commands."""
    from policy_node.training import generate_episodes

    directory = tmp_path_factory.mktemp('episodes')
    arguments = ['--policy', 'random', '--task', 'FetchPush', '--episodes', '3', '--threads', '1']
    assert generate_episodes.main([*arguments, '--output', str(directory)]) == 0
    return directory


@pytest.fixture(scope='session')
def export():
    """Return a function that exports a folder and returns the exit code."""

    def run(source: Path, to: str, output: Path | str, *options: str) -> int:
        pytest.importorskip('minari' if to == 'minari' else 'pyarrow')
        arguments = [str(source), '--to', to, '--output', str(output), *options]
        try:
            return episodes_export.main(arguments)
        except SystemExit as end:
            return int(end.code or 0)

    return run


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """Minari, which looks for datasets in a folder of the test."""
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path / 'minari'))
    return pytest.importorskip('minari')
