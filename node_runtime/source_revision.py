"""The source revision, which episode files and actors record."""

from __future__ import annotations

import subprocess
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')


@cache
def source_revision() -> str:
    """Return the commit of this source tree, or the installed version outside of a repository."""
    root = Path(__file__).resolve().parents[1]
    # Not a parent folder's: an installed copy may lie in a user's repository.
    if (root / '.git').exists():
        with suppress(OSError, subprocess.SubprocessError):
            return revision_of(root)
    try:
        return f'fetch_hand_sim {version("fetch_hand_sim")}'
    except PackageNotFoundError:
        return 'unknown'


def revision_of(root: Path) -> str:
    """Return the commit of a source tree, with `-dirty` if files of its packages have changed.

    Raises:
        OSError: If git is not installed.
        subprocess.SubprocessError: If git fails, times out, or `root` is not a repository.
    """

    def git(*arguments: str) -> str:
        command = ['git', '-C', str(root), *arguments]
        run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5.0)
        return run.stdout.strip()

    commit = git('rev-parse', 'HEAD')
    changed = git('status', '--porcelain', '--untracked-files=no', '--', *_PACKAGES)
    return f'{commit}-dirty' if changed else commit
