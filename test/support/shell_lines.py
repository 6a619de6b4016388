"""Shell commands that a page shows, one by one, without running them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator


def python_blocks(page: str) -> list[str]:
    """The Python code of a page, in order."""
    return re.findall(r'^```python\b[^\n]*\n(.*?)^```', page, flags=re.DOTALL | re.MULTILINE)


def shell_lines(page: str) -> Iterator[str]:
    """The lines of a page that are meant for a shell: in blocks called `sh`, or indented."""
    fence = ''
    for line in page.splitlines():
        if line.startswith('```'):
            fence = '' if fence else line.removeprefix('```').partition(' ')[0] or 'text'
        elif fence in ('sh', 'bash') and line.strip():
            yield line
        elif not fence and re.match(r' {4}\S', line):
            yield line.strip()


def commands(line: str) -> Iterator[list[str]]:
    """The commands of a line as words, without comments, redirections and assignments."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars='&|;<>')
    lexer.whitespace_split, lexer.commenters = True, '#'
    words: list[str] = []
    for word in [*lexer, ';']:
        if set(word) <= set('&|;'):
            if words:
                yield words
            words = []
        elif word == '>':
            yield words
            words = ['>']
        elif words or not re.fullmatch(r'[A-Z_]+=.*', word):
            words.append(word)
