"""Which revision of this project runs: what episodes and actors name as their source."""

from __future__ import annotations

import subprocess
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')


@cache
def source_revision() -> str:
    """Commit of this source tree, `-dirty` where its code differs; else the installed version."""
    root = Path(__file__).resolve().parents[1]
    # Only its own: an installed copy may lie in somebody else's repository.
    if (root / '.git').exists():
        with suppress(OSError, subprocess.SubprocessError):
            return revision_of(root)
    try:
        return f'fetch_hand_sim {version("fetch_hand_sim")}'
    except PackageNotFoundError:
        return 'unknown'


def revision_of(root: Path) -> str:
    """Commit of a source tree, with `-dirty` where a file of its packages differs from it.

    Pages and reports do not count: a study renews its own while its later runs wait.

    Raises:
        OSError: If there is no git.
        subprocess.SubprocessError: If it does not answer, or the tree is none of its.
    """

    def git(*arguments: str) -> str:
        command = ['git', '-C', str(root), *arguments]
        run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5.0)
        return run.stdout.strip()

    commit = git('rev-parse', 'HEAD')
    changed = git('status', '--porcelain', '--untracked-files=no', '--', *_PACKAGES)
    return f'{commit}-dirty' if changed else commit
