"""Check the pages: table cells, alternative texts of pictures, plain words.

python tools/check_docs.py [PAGE ...]

Checks README.md, CONTRIBUTING.md and docs, without lab notes and generated pages. Exit code 0: all
is well; 1: a line for each problem. Words to avoid are listed in CONTRIBUTING.md.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Characters, without the target of links.
LONGEST_CELL = 120
# Share of sentences with an idiom that is hard to read, and of long sentences, over all pages.
MOST_IDIOMS, MOST_LONG = 0.01, 0.08
LONG_SENTENCE = 28
_SKIPPED = ('lab_notes', 'generated')
_IDIOMS = re.compile(
    r'^(Who|Whom|Whose|Whoever|Whatever|What (?!happens|is new)|Whether|That of|Those of)\b'
    r'|\b(nobody|somebody|anybody|everybody|whoever|whatever|nothing that|there is none)\b'
    r'|\b(is none|of whom|of which|of one that|that there is|that there are|as far as|not apart)\b'
    r'|\b(says|tells|told|hears|heard|knows|asks|asked|wants|sees|speaks|gives up|gave up)\b'
    r'|, and so do(es)?\b|, nor\b|\bof all that\b|\bbut for\b|\bbeside what\b'
)


def pages() -> list[Path]:
    """Return the pages that readers see."""
    docs = (ROOT / 'docs').rglob('*.md')
    found = [path for path in docs if not set(_SKIPPED) & set(path.relative_to(ROOT).parts)]
    return [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(found)]


def problems(page: str) -> Iterator[str]:
    """Yield a line for each long table cell and each picture without a text."""
    for number, line in enumerate(_without_code(page).splitlines(), 1):
        if line.startswith('|'):
            cells = re.sub(r'\]\([^)]*\)', ']', line).strip('|').split('|')
            longest = max(len(cell.strip()) for cell in cells)
            if longest > LONGEST_CELL:
                yield f'{number}: a table cell has {longest} characters; allowed: {LONGEST_CELL}'
        if re.search(r'!\[\s*\]\(', line):
            yield f'{number}: a picture has no text; write ![what it shows](file)'


def sentences(page: str) -> Iterator[str]:
    """Yield the sentences outside of code, tables and headings."""
    text = re.sub(r'`[^`]*`', 'X', _without_code(page))
    text = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', text)
    text = re.sub(r'^(\||#).*$', '', text, flags=re.MULTILINE)
    text = re.sub(r'^\s*([-*]|\d+\.)\s+', '\n\n', text, flags=re.MULTILINE)
    for block in re.split(r'\n\s*\n', text):
        for sentence in re.split(r'(?<=[.!?])\s+(?=[A-Z*])', ' '.join(block.split())):
            if len(re.findall(r'[A-Za-z]{2,}', sentence)) >= 3:
                yield sentence.strip('* ')


def _without_code(page: str) -> str:
    """Blank code, so that the numbers of lines stay."""
    page = re.sub(
        r'^```.*?^```$', lambda m: '\n' * m[0].count('\n'), page, flags=re.DOTALL | re.MULTILINE
    )
    return re.sub(r'^ {4}\S.*$', '', page, flags=re.MULTILINE)


def main(arguments: list[str] | None = None) -> int:
    """Print the problems; return the exit code."""
    given = [Path(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    found, idioms, long, total = [], [], [], 0
    for path in given or pages():
        page = path.read_text(encoding='utf-8')
        found += [f'{path}:{problem}' for problem in problems(page)]
        for sentence in sentences(page):
            total += 1
            if _IDIOMS.search(sentence):
                idioms.append(f'{path}: {sentence}')
            if len(sentence.split()) > LONG_SENTENCE:
                long.append(f'{path}: {sentence}')
    for name, listed, most in (('idioms', idioms, MOST_IDIOMS), ('long', long, MOST_LONG)):
        if len(listed) > most * total:
            found += [*listed, f'{name}: {len(listed)} of {total} sentences; allowed: {most:.0%}']
    print(*found, sep='\n', end='\n' if found else '')
    return int(bool(found))


if __name__ == '__main__':
    sys.exit(main())
