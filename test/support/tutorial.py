"""Run every block of a page in one folder, as a reader would.

Kinds of blocks:

- ```` ```sh ````: commands that terminate. ```` ```sh second terminal ````: a command in another
  terminal of this name; it receives Ctrl-C at the end of the page.
- ```` ```python ````: a program to run. ```` ```python robot.py ````: a file of this name.
- ```` ``` ````: lines that the previous block prints, in this order, perhaps with others between
  them; `...` matches any text.
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
# A node closes its log before it ends.
STOP_TIMEOUT = 30.0
INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block.

    Attributes:
        kind: `sh`, `python` or '' for output.
        label: The words after the kind.
        text: The content.
    """

    kind: str
    label: str
    text: str


def blocks(page: str) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    found = re.findall(r'^```(\w*) ?([^\n]*)\n(.*?)^```$', page, flags=re.DOTALL | re.MULTILINE)
    return [Block(*parts) for parts in found]


def missing_line(expected: str, printed: str) -> str | None:
    """Return the first line of an output block that is missing in the output, or None."""
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
    """Runs the blocks of a page in a folder."""

    folder: Path
    environment: Mapping[str, str]
    _terminals: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    _printed: str = ''

    def follow(self, page: str) -> None:
        """Run all blocks; fail if a block fails or prints something else."""
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
