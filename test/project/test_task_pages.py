"""The pages of the thirteen tasks say what the package and the evaluations of its actors say."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from support import ROOT

TOOL = runpy.run_path(str(ROOT / 'tools' / 'task_pages.py'))
END, START = TOOL['END'], TOOL['START']


@pytest.mark.parametrize('path', TOOL['sections'](), ids=lambda path: path.stem)
def test_a_page_is_up_to_date(path: Path) -> None:
    page = path.read_text(encoding='utf-8')
    renewed = TOOL['with_section'](page, TOOL['sections']()[path])
    assert renewed == page, 'run: make tables, or python tools/task_pages.py --write'
    assert (path.parent / f'../images/tasks/{path.stem}.jpg').is_file() or path.stem == 'index'
