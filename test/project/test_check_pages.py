"""The pages are readable: links, short table cells, texts of pictures, plain words."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from support import ROOT

TOOL = runpy.run_path(str(ROOT / 'tools' / 'check_pages.py'))


def test_the_pages_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert TOOL['main']([]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        (f'| {"x" * 121} | y |\n', 'table cell of 121 characters'),
        ('![](page.md)\n', 'has no alt text'),
        ('[a](gone.md)\n', 'link to gone.md, which does not exist'),
    ],
)
def test_a_problem_is_found(text: str, problem: str, tmp_path: Path) -> None:
    page = tmp_path / 'page.md'
    page.write_text(text)
    (found,) = TOOL['findings'](page)
    assert problem in found


def test_idioms_are_counted(tmp_path: Path) -> None:
    page = tmp_path / 'page.md'
    page.write_text('Who draws a picture gets a line. Nothing else is wrong here.\n')
    assert TOOL['idioms'](page) == (['Who draws a picture gets a line.'], 2)
