"""`docs/architecture.md` is the map of the tree: every module is on it, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support import ROOT

PAGE = ROOT / 'docs' / 'architecture.md'
PACKAGES = ('msgs_spec', 'fetch_hand_sim', 'policy_node')
# What a package or its `python -m` says is said of the folder.
UNNAMED = {'__init__.py', '__main__.py'}


def modules(package: str) -> set[str]:
    """The modules of a package as paths from the repository's root."""
    paths = (path.relative_to(ROOT) for path in (ROOT / package).rglob('*.py'))
    return {str(path) for path in paths if path.name not in UNNAMED}


def named_modules(page: str) -> list[str]:
    """The modules that the tables of a page name, each under the heading of its folder."""
    found = []
    for section in re.split(r'^### ', page, flags=re.MULTILINE)[1:]:
        folder = re.match(r'`([\w/]+/)`', section)
        assert folder, f'docs/architecture.md: heading without a `folder/`: {section[:40]!r}'
        for row in re.findall(r'^\| (`.*?) \|', section, flags=re.MULTILINE):
            found += [folder[1] + name for name in re.findall(r'`(\w+\.py)`', row)]
    return found


@pytest.mark.parametrize('package', PACKAGES)
def test_every_module_is_on_the_map_once(package: str) -> None:
    named = [name for name in named_modules(PAGE.read_text()) if name.startswith(package + '/')]
    there = modules(package)
    missing, gone = sorted(there - set(named)), sorted(set(named) - there)
    assert not missing, (
        f'docs/architecture.md does not name {", ".join(missing)}: add each, with what lives in '
        'it, to the table under the heading of its folder (### `folder/`)'
    )
    assert not gone, f'docs/architecture.md names modules that are gone: {", ".join(gone)}'
    assert len(named) == len(set(named)), 'docs/architecture.md names a module twice'


@pytest.mark.parametrize(
    ('page', 'named'),
    [
        ('### `a/b/`\n\n| `c.py`, `d.py` | what |\n', ['a/b/c.py', 'a/b/d.py']),
        ('### `a/`\n\n| other | `c.py` |\n', []),
        ('`c.py` before any heading\n', []),
    ],
)
def test_only_the_first_column_of_a_folders_table_counts(page: str, named: list[str]) -> None:
    assert named_modules(page) == named


# Pages


def pages() -> list[Path]:
    """The documentation, without the history in the changelog."""
    docs = [path for path in (ROOT / 'docs').rglob('*.md') if path.parent.name != 'generated']
    return sorted([ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *docs])


def lost_files(page: str) -> list[str]:
    """The Python files that a page names and that are nowhere in the repository."""
    files = [path.relative_to(ROOT) for name in FOLDERS for path in (ROOT / name).rglob('*.py')]
    tree = {f'/{path}' for path in files} | {'/setup.py'}
    named = re.findall(r'`([\w/]*\w\.py)`', page)
    return [name for name in named if not any(path.endswith(f'/{name}') for path in tree)]


FOLDERS = (*PACKAGES, 'bench', 'examples', 'test', 'tools')


@pytest.mark.parametrize('page', pages(), ids=lambda path: path.name)
def test_files_named_by_the_documentation_exist(page: Path) -> None:
    assert lost_files(page.read_text()) == []


@pytest.mark.parametrize('page', pages(), ids=lambda path: path.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    targets = re.findall(r'\]\(([^)#:\s]+)(?:#[^)]*)?\)', page.read_text())
    assert [each for each in targets if not (page.parent / each).exists()] == []


def test_every_page_is_in_the_documentation() -> None:
    """What no table of contents names, Sphinx would warn of; GitHub's readers would not find it."""
    listed: set[Path] = set()
    for page in pages():
        for block in re.findall(
            r'^```{toctree}\n(.*?)^```', page.read_text(), re.DOTALL | re.MULTILINE
        ):
            names = (line for line in block.splitlines() if line and not line.startswith(':'))
            listed |= {(page.parent / f'{name}.md').resolve() for name in names}
    docs = {page for page in pages() if ROOT / 'docs' in page.parents} - {ROOT / 'docs/index.md'}
    assert docs - listed == set()
    assert {path for path in listed - docs if path.parent.name != 'generated'} == set()


@pytest.mark.parametrize('path', ['fetch_hand_sim/episode_check.py', 'rewards_of_old.py'])
def test_a_file_that_moved_is_noticed(path: str) -> None:
    assert lost_files(f'see `{path}` and `simulation/rewards.py`') == [path]


@pytest.mark.parametrize('package', PACKAGES)
def test_what_a_package_says_of_its_files_is_true(package: str) -> None:
    paths = (ROOT / package).rglob('__init__.py')
    lost = {str(path): files for path in paths if (files := lost_files(path.read_text()))}
    assert lost == {}
