"""The documentation names folders, files and pages that exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from support import ROOT

PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')


def folders() -> dict[str, list[Path]]:
    """The modules of every folder of the packages, without `__init__` and `__main__`."""
    found: dict[str, list[Path]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            modules = found.setdefault(f'{path.parent.relative_to(ROOT)}/', [])
            if path.stem not in ('__init__', '__main__'):
                modules.append(path)
    return found


def test_the_architecture_page_lists_every_folder_once() -> None:
    page = (ROOT / 'docs' / 'architecture.md').read_text()
    assert sorted(re.findall(r'^\| `([\w/]+/)` \|', page, flags=re.MULTILINE)) == sorted(folders())


# Pages


def pages() -> list[Path]:
    """The documentation, without history: the changelog and the lab notes."""
    docs = [page for page in pages_of_docs() if 'lab_notes' not in page.parts]
    return sorted([ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *docs])


def pages_of_docs() -> list[Path]:
    """All pages in `docs`, also the lab notes."""
    return sorted(path for path in (ROOT / 'docs').rglob('*.md') if path.parent.name != 'generated')


def lost_files(page: str) -> list[str]:
    """The Python files that a page names and that are nowhere in the repository."""
    named = re.findall(r'`([\w/]*\w\.py)`', page)
    return [name for name in named if not any(path.endswith(f'/{name}') for path in tree())]


@cache
def tree() -> list[str]:
    """The Python files of the repository."""
    files = [path.relative_to(ROOT) for name in FOLDERS for path in (ROOT / name).rglob('*.py')]
    return ['/setup.py', *(f'/{path}' for path in files)]


FOLDERS = (*PACKAGES, 'bench', 'examples', 'test', 'tools')


def test_files_named_by_pages_and_package_docstrings_exist() -> None:
    packages = [path for name in PACKAGES for path in (ROOT / name).rglob('__init__.py')]
    lost = {str(path): lost_files(path.read_text()) for path in (*pages(), *packages)}
    assert {path: files for path, files in lost.items() if files} == {}


def test_every_page_is_in_the_documentation() -> None:
    """Each page is in a table of contents, where readers on GitHub find it."""
    listed: set[Path] = set()
    for page in pages_of_docs():
        for block in re.findall(
            r'^```{toctree}\n(.*?)^```', page.read_text(), re.DOTALL | re.MULTILINE
        ):
            names = (line for line in block.splitlines() if line and not line.startswith(':'))
            listed |= {(page.parent / f'{name}.md').resolve() for name in names}
    docs = {*pages_of_docs()} - {ROOT / 'docs/index.md'}
    assert docs - listed == set()
    assert {path for path in listed - docs if path.parent.name != 'generated'} == set()


@pytest.mark.parametrize('path', ['fetch_hand_sim/episode_check.py', 'rewards_of_old.py'])
def test_a_file_that_moved_is_noticed(path: str) -> None:
    assert lost_files(f'see `{path}` and `simulation/rewards.py`') == [path]
