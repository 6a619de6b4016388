"""Every tutorial, followed to the letter: real nodes, real training, small budgets.

`make test-release` follows them; `make test` only parses their command lines
(test_documentation.py).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from support import ROOT
from support.tutorial import Reader, missing_line

PAGES = sorted((ROOT / 'docs' / 'tutorials').glob('*.md'))


@pytest.mark.release
@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_a_tutorial_can_be_followed(
    page: Path, tmp_path: Path, ros_environment: dict[str, str]
) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), ros_environment['PATH']])
    Reader(tmp_path, ros_environment | {'PATH': path}).follow(page.read_text(encoding='utf-8'))


@pytest.mark.parametrize(
    ('expected', 'missing'),
    [
        ('one\ntwo', None),
        ('one\nthree ...', None),
        ('t... 4', None),
        ('two\none', 'one'),
        ('three', 'three'),
    ],
)
def test_output_is_compared_with_the_page(expected: str, missing: str | None) -> None:
    assert missing_line(expected, 'one\ntwo\nthree  3 4\n') == missing


@pytest.mark.parametrize(
    ('page', 'problem'),
    [
        ('```python a.sh\necho broken; false\n```\n```sh\nsh a.sh\n```\n', 'broken'),
        ('```sh\necho a\n```\n```\nb\n```\n', "the page shows 'b'"),
        ("```python\nraise SystemExit('no')\n```\n", 'no'),
        ('```sh other\ncat nosuchfile\n```\n```sh\nsleep 0.2\n```\n', 'nosuchfile'),
    ],
)
def test_a_page_that_does_not_work_is_noticed(
    page: str, problem: str, tmp_path: Path, ros_environment: dict[str, str]
) -> None:
    with pytest.raises(AssertionError, match=problem):
        Reader(tmp_path, ros_environment).follow(page)
