"""The documentation names folders, files and pages that exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from support import PACKAGES, ROOT

FOLDERS = (*PACKAGES, 'bench', 'examples', 'test', 'tools')


def test_the_architecture_page_lists_every_folder_once() -> None:
    page = (ROOT / 'docs' / 'architecture.md').read_text()
    modules = [path for package in PACKAGES for path in (ROOT / package).rglob('*.py')]
    folders = {f'{path.parent.relative_to(ROOT)}/' for path in modules}
    listed = re.findall(r'^\| `([\w/]+/)` \|', page, flags=re.MULTILINE)
    assert sorted(listed) == sorted(folders)


def pages() -> list[Path]:
    """The documentation, without history: the changelog and the lab notes."""
    docs = (path for path in (ROOT / 'docs').rglob('*.md') if path.parent.name != 'generated')
    current = (page for page in docs if 'lab_notes' not in page.parts)
    return sorted([ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *current])


def lost_files(page: str) -> list[str]:
    """The Python files that a page names and that are nowhere in the repository."""
    named = re.findall(r'`([\w/]*\w\.py)`', page)
    return [name for name in named if not any(path.endswith(f'/{name}') for path in tree())]


@cache
def tree() -> list[str]:
    """The Python files of the repository."""
    files = [path.relative_to(ROOT) for name in FOLDERS for path in (ROOT / name).rglob('*.py')]
    return ['/setup.py', *(f'/{path}' for path in files)]


def test_files_named_by_pages_and_package_docstrings_exist() -> None:
    packages = [path for name in PACKAGES for path in (ROOT / name).rglob('__init__.py')]
    lost = {str(path): lost_files(path.read_text()) for path in (*pages(), *packages)}
    assert {path: files for path, files in lost.items() if files} == {}
