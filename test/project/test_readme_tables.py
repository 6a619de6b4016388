"""The README's tables say what the evaluation files and the benchmark say."""

from __future__ import annotations

import hashlib
import json
import runpy
from pathlib import Path

import pytest

from policy_node.policies.loading import shipped_actors
from support import ROOT

ACTORS = ROOT / 'policy_node' / 'actors'
TOOL = runpy.run_path(str(ROOT / 'tools' / 'readme_tables.py'))


@pytest.mark.parametrize('page', ['README.md', 'docs/speed.md', 'docs/results.md'])
def test_pages_have_the_present_tables(page: str) -> None:
    text = (ROOT / page).read_text(encoding='utf-8')
    assert TOOL['with_tables'](text) == text, 'run: make tables'


def test_the_readme_is_short() -> None:
    lines = (ROOT / 'README.md').read_text().splitlines()
    assert len(lines) <= 110
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize('path', shipped_actors().values(), ids=lambda path: path.stem)
def test_each_actor_is_the_one_that_was_evaluated(path: Path) -> None:
    report = json.loads(path.with_suffix('.json').read_text())
    assert report['sha256'] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert report['episodes'] >= 1000
    assert path.with_suffix('.png').is_file()
