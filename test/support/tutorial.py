"""A page as its reader follows it: every block done, one after the other, in one folder.

Three kinds of blocks, told apart by what stands behind the fence:

- ```` ```sh ````: commands in the reader's terminal, which end by themselves. With words behind,
  ```` ```sh second terminal ````: one command in another terminal of that name; it runs on until
  the page is over, and then gets a Ctrl-C.
- ```` ```python ````: run. With a name behind, ```` ```python robot.py ````: a file of that name.
- ```` ``` ```` alone: what the block before prints. Lines come in this order, with others between;
  `...` stands for anything.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

# A training or a benchmark on a busy machine.
TIMEOUT = 1500.0
# A node that is told to stop has its log to close.
STOP_TIMEOUT = 30.0
INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block.

    Attributes:
        kind: `sh`, `python` or '' for output.
        label: The words behind.
        text: What is in it.
    """

    kind: str
    label: str
    text: str


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    found = re.findall(r'^```(\w*) ?([^\n]*)\n(.*?)^```$', page, flags=re.DOTALL | re.MULTILINE)
    return [Block(*parts) for parts in found]


def missing_line(expected: str, printed: str) -> str | None:
    """The first line of an output block that was not printed where it should be."""
    lines = (_words(line) for line in printed.splitlines())
    for line in filter(None, map(_words, expected.splitlines())):
        pattern = '.*'.join(map(re.escape, line.split('...')))
        if not any(re.fullmatch(pattern, each) for each in lines):
            return line
    return None


def _words(line: str) -> str:
    return ' '.join(line.split())


@dataclass
class Reader:
    """Somebody who follows a page.

    Attributes:
        folder: Where.
        environment: Of all that is started.
    """

    folder: Path
    environment: Mapping[str, str]
    _terminals: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    _printed: str = ''

    def follow(self, page: str) -> None:
        """Does what the page says; fails where it does not do what the page says."""
        try:
            for block in blocks(page):
                self._do(block)
            for name, process in self._terminals.items():
                self._end(name, process)
        finally:
            for process in self._terminals.values():
                process.kill()
                process.wait()

    def _do(self, block: Block) -> None:
        if block.kind == 'sh' and block.label:
            self._open_terminal(block)
        elif block.kind == 'python' and block.label:
            (self.folder / block.label).write_text(block.text)
        elif block.kind == 'sh':
            self._run(['bash', '-euo', 'pipefail', '-c', block.text], block.text)
        elif block.kind == 'python':
            self._run([sys.executable, '-W', 'ignore', '-c', block.text], block.text)
        elif block.kind == '':
            missing = missing_line(block.text, self._printed)
            assert missing is None, f'the page shows {missing!r}; printed:\n{self._printed}'

    def _run(self, command: list[str], text: str) -> None:
        result = subprocess.run(
            command,
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=TIMEOUT,
        )
        self._printed = result.stdout
        others = '\n'.join(self._logs())
        assert result.returncode == 0, f'{text}\n{result.returncode}: {result.stdout}\n{others}'

    def _open_terminal(self, block: Block) -> None:
        (command,) = block.text.strip().splitlines()
        with (self.folder / f'.{block.label}.log').open('w') as log:
            self._terminals[block.label] = subprocess.Popen(
                ['bash', '-c', f'exec {command}'],
                cwd=self.folder,
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
            )

    def _end(self, name: str, process: subprocess.Popen[str]) -> None:
        process.send_signal(signal.SIGINT)
        code = process.wait(timeout=STOP_TIMEOUT)
        printed = (self.folder / f'.{name}.log').read_text()
        assert code in (0, INTERRUPTED) and 'Traceback' not in printed, f'{name}: {code}\n{printed}'

    def _logs(self) -> Iterator[str]:
        for path in sorted(self.folder.glob('.*.log')):
            yield f'{path.name}:\n{path.read_text()}'
