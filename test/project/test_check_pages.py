"""The pages are readable: links, short table cells, texts of pictures, plain words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from check_pages import findings, idioms, main

from support import ROOT


def test_the_pages_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        (f'| {"x" * 121} | y |\n', 'table cell of 121 characters'),
        ('![](page.md)\n', 'has no alt text'),
        ('[a](gone.md)\n', 'link to gone.md, which does not exist'),
        ('![a](https://example.org/a.png)\n', 'is loaded from the internet'),
    ],
)
def test_a_problem_on_a_page_is_found(text: str, problem: str, tmp_path: Path) -> None:
    page = tmp_path / 'page.md'
    page.write_text(text)
    (found,) = findings(page)
    assert problem in found


def test_idioms_are_counted(tmp_path: Path) -> None:
    page = tmp_path / 'page.md'
    page.write_text('Who draws a picture gets a line. Nothing else is wrong here.\n')
    assert idioms(page) == (['Who draws a picture gets a line.'], 2)


@pytest.mark.parametrize(
    'source', sorted((ROOT / 'docs' / 'diagrams').glob('*.mmd')), ids=lambda path: path.stem
)
def test_a_diagram_shows_the_words_of_its_source(source: Path) -> None:
    """A changed source was drawn again."""
    labels = re.findall(r'"([^"]*)"|: (.*)', source.read_text(encoding='utf-8'))
    words = ' '.join(label for pair in labels for label in pair).replace('<br>', ' ').split()
    drawn = re.sub(r'<[^>]*>', ' ', source.with_suffix('.svg').read_text(encoding='utf-8'))
    assert words
    assert set(words) <= set(drawn.split())
