"""The messages on the troubleshooting page exist in the code."""

from __future__ import annotations

import ast
import re

import pytest

from support import PACKAGES, ROOT

PAGE = (ROOT / 'docs' / 'troubleshooting.md').read_text()
# Messages of ROS, NumPy, pip and Python.
OTHERS = (
    'A module that was',
    'ModuleNotFoundError',
    'error: externally',
    'TF_OLD',
    'AssertionError',
)


def texts() -> str:
    """All strings of the packages and of setup.py."""
    files = [path for package in PACKAGES for path in (ROOT / package).rglob('*.py')]
    trees = (ast.parse(path.read_text()) for path in (*files, ROOT / 'setup.py'))
    return '\n'.join(
        node.value
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


TEXTS = texts()
MESSAGES = [
    message
    for message in re.findall(r'^### `([^`]*)`', PAGE, re.MULTILINE)
    if not message.startswith(OTHERS)
]
assert len(MESSAGES) >= 20


@pytest.mark.parametrize('message', MESSAGES)
def test_a_message_exists(message: str) -> None:
    for part in filter(None, (part.strip(' ;,:') for part in message.split('...'))):
        assert part in TEXTS, part
