"""Check the pages for broken links, missing alt texts, long table cells and hard words.

`python tools/check_pages.py [PAGE ...]`. Lab notes are history: only their
links are checked. Generated tables are not measured.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_LONGEST_CELL = 120
# Share of sentences that may contain an idiom of the style sheet.
_MOST_IDIOMS = 0.01
_IDIOMS = re.compile(
    r'^(Who|Whose|Whoever|Whatever|Whether|What (?!happens|is new)|That of|Those of)\b'
    r'|\b([Nn]obody|[Ss]omebody|[Aa]nybody|[Ww]hoever|nothing that|there is none|is none|of which'
    r'|gives up|gave up|given up|lets go|not apart|as far as|beside what)\b'
    r'|, and so do(es)?\b|, nor\b'
)


def pages() -> list[Path]:
    """Return README, CONTRIBUTING, SECURITY, CHANGELOG and all pages of docs."""
    top = [ROOT / f'{name}.md' for name in ('README', 'CONTRIBUTING', 'SECURITY', 'CHANGELOG')]
    docs = (ROOT / 'docs').rglob('*.md')
    return [*top, *sorted(path for path in docs if path.parent.name != 'generated')]


def findings(page: Path) -> Iterator[str]:
    """Yield the broken links, missing alt texts and long cells of a page."""
    text = _without_code(page.read_text(encoding='utf-8'))
    for alt, target in re.findall(r'(!?\[[^\]]*)\]\(([^)#:\s]+)(?:#[^)]*)?\)', text):
        if not (page.parent / target).exists():
            yield f'link to {target}, which does not exist'
        if alt == '![':
            yield f'picture {target} has no alt text'
    for address in re.findall(r'!\[[^\]]*\]\((https?:[^)]*)\)', text):
        yield f'picture {address} is loaded from the internet'
    if 'lab_notes' not in page.parts:
        for cell in _cells(text):
            if len(cell) > _LONGEST_CELL:
                yield f'table cell of {len(cell)} characters, allowed {_LONGEST_CELL}: {cell[:50]}'


def idioms(page: Path) -> tuple[list[str], int]:
    """Return the sentences of a page with an idiom, and the number of all sentences."""
    text = _without_code(page.read_text(encoding='utf-8'))
    # The style guide quotes the words that it advises against.
    text = text.split('\n## How to write')[0]
    text = re.sub(r'`[^`]*`', 'X', text)
    text = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', text)
    lines = (line for line in text.splitlines() if not line.startswith(('|', '#', '    ')))
    text = '\n'.join(re.sub(r'^\s*([-*]|\d+\.)\s+', '\n\n', line) for line in lines)
    blocks = [' '.join(block.split()) for block in re.split(r'\n\s*\n', text)]
    split = (each for block in blocks for each in re.split(r'(?<=[.!?])\s+(?=[A-Z*])', block))
    sentences = [each for each in split if len(re.findall(r'[A-Za-z]{2,}', each)) >= 3]
    return [each for each in sentences if _IDIOMS.search(each)], len(sentences)


def _without_code(text: str) -> str:
    return re.sub(r'^```.*?^```', '', text, flags=re.DOTALL | re.MULTILINE)


def _cells(text: str) -> Iterator[str]:
    """Yield the cells of the tables that people write."""
    text = re.sub('<!-- generated .*?<!-- /generated -->', '', text, flags=re.DOTALL)
    for line in text.splitlines():
        if line.startswith('|'):
            yield from (cell.strip() for cell in line.strip('| ').split('|'))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what is wrong; return the exit code."""
    given = [Path(each).resolve() for each in (sys.argv[1:] if arguments is None else arguments)]
    wrong, hard, total = 0, [], 0
    for page in given or pages():
        for finding in findings(page):
            wrong += 1
            print(f'{page.relative_to(ROOT)}: {finding}')
        if 'lab_notes' not in page.parts:
            found, number = idioms(page)
            total += number
            hard += [f'{page.relative_to(ROOT)}: {sentence[:110]}' for sentence in found]
    if len(hard) > _MOST_IDIOMS * total:
        wrong += 1
        print('\n'.join(hard))
        print(f'{len(hard)} of {total} sentences have an idiom of the style sheet, allowed 1 %')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
