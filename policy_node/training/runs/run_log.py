"""Progress of a run: a live line, CSV, TensorBoard where installed, and the curve as PNG."""

from __future__ import annotations

import csv
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from node_runtime.command_line import complain
from node_runtime.signals import discard_unread_output
from policy_node.training.runs.run_folder import BOARD_FOLDER, PROGRESS_FILE

COLUMNS = (
    'seconds',
    'env_steps',
    'episodes',
    'updates',
    'train_success',
    'narrowing_steps',
    'eval_success',
    'eval_episodes',
    'eval_touched',
    'eval_stay',
    'eval_long_way',
    'eval_dropped',
    'eval_distance',
    'eval_rotation',
    'eval_guided',
    'critic_loss',
    'actor_loss',
    'mean_value',
    'steps_per_second',
    'samples_per_second',
    'processor_seconds',
)
# A cycle by those names; None is what it did not measure.
Row = dict[str, float | None]
# Seconds between lines where the output is no terminal.
_PLAIN_INTERVAL = 15.0


class RunLog:
    """Writes one row per cycle; a resumed run appends to the same file.

    Args:
        output: Folder of the run.
        total_steps: Environment steps of the whole run, for the ETA.
        time_limit: Its limit, seconds; 0 is none.
        resumed_steps: Environment steps of the checkpoint the run goes on from. What was logged
            after it, and is about to be run again, is removed.
        quiet: Whether nothing is shown.
        on_row: Called with each row when it is written.
    """

    def __init__(
        self,
        output: Path,
        total_steps: int,
        time_limit: float,
        resumed_steps: int = 0,
        quiet: bool = False,
        on_row: Callable[[Row], None] | None = None,
    ) -> None:
        self.path = output / PROGRESS_FILE
        self._total_steps = total_steps
        self._time_limit = time_limit
        kept = _rows_until(self.path, resumed_steps)
        logged = float(kept[-1]['env_steps']) if kept else 0.0
        if logged < resumed_steps and not quiet:
            complain(
                'fetch_hand_sim train',
                f'{self.path} has no rows from {logged:,.0f} to {resumed_steps:,} steps',
            )
        partial = self.path.with_name(f'.{self.path.name}.partial')
        self._file: IO[str] = partial.open('w', newline='')
        # Logs from before a column was added leave it empty.
        self._writer = csv.DictWriter(
            self._file, COLUMNS, restval='', extrasaction='ignore', lineterminator='\n'
        )
        self._writer.writeheader()
        self._writer.writerows(kept)
        self._file.flush()
        partial.replace(self.path)
        self._board = _tensorboard(output, resumed_steps)
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, refresh_per_second=4, transient=False)
        self._last_plain = 0.0
        self._last_eval = ''
        self._quiet, self._on_row = quiet, on_row
        if self._console.is_terminal and not quiet:
            self._live.start()

    def write(self, row: Row) -> None:
        """Record one cycle; None leaves a column empty.

        Raises:
            OSError: If the log was removed, or there is no room for it.
        """
        if not self.path.is_file():
            raise OSError(f'{self.path} was removed while the run trained')
        self._writer.writerow({name: _short(row.get(name)) for name in COLUMNS})
        self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                if value is not None and name != 'env_steps':
                    self._board.add_scalar(name, value, int(row['env_steps'] or 0))
            self._board.flush()
        if not self._quiet:
            self._show(row)
        if self._on_row is not None:
            self._on_row(row)

    def close(self) -> None:
        """Ends the live line and closes the files."""
        discard_unread_output()
        if self._live.is_started:
            self._live.stop()
        self._file.close()
        if self._board is not None and self.path.is_file():
            self._board.close()

    def _show(self, row: Row) -> None:
        if row.get('eval_success') is not None:
            self._last_eval = f'{row["eval_success"]:.3f} of {row["eval_episodes"]:.0f}'
        steps, seconds = row['env_steps'] or 0, row['seconds'] or 0
        line = (
            f'{steps:,.0f} steps  {row["steps_per_second"] or 0:,.0f} steps/s  '
            f'{row["samples_per_second"] or 0:,.0f} samples/s  '
            f'train {row["train_success"] or 0:.2f}  eval {self._last_eval or "-"}  '
            f'{_clock(seconds)}  ETA {self._remaining(row)}'
        )
        # A run does not end because nobody watches it any more.
        discard_unread_output()
        if self._console.is_terminal:
            self._live.update(Text(line))
        elif time.monotonic() - self._last_plain > _PLAIN_INTERVAL:
            self._last_plain = time.monotonic()
            print(line, file=sys.stderr, flush=True)

    def _remaining(self, row: dict[str, float | None]) -> str:
        speed = row['steps_per_second'] or 0
        if speed <= 0:
            return '-'
        remaining = (self._total_steps - (row['env_steps'] or 0)) / speed
        if self._time_limit > 0:
            remaining = min(remaining, self._time_limit - (row['seconds'] or 0))
        return _clock(max(remaining, 0.0))


def _short(value: float | None) -> str:
    return '' if value is None else f'{value:.6g}' if isinstance(value, float) else str(value)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours}:{minutes:02}:{rest:02}'


def _rows_until(path: Path, env_steps: int) -> list[dict[str, str]]:
    """Rows of a log up to `env_steps`, as they were written."""
    if env_steps == 0 or not path.is_file():
        return []
    return [row for row, numbers in _whole_rows(path) if numbers['env_steps'] <= env_steps]


def _whole_rows(path: str | Path) -> Iterator[tuple[dict[str, str], dict[str, float]]]:
    """Rows of a log as text and as numbers; what is no row is left out, whatever it is."""
    with open(path, newline='', encoding='utf-8', errors='replace') as file:
        try:
            for row in csv.DictReader(file):
                numbers = _numbers(row)
                if numbers is not None:
                    yield row, numbers
        except csv.Error:
            # Binary where a line should end: nothing after it is a row either.
            return


def _numbers(row: dict[str, str]) -> dict[str, float] | None:
    """The numbers of a row; None if a killed run has cut it short, or a disk has damaged it."""
    try:
        # A column that is missing is None, an empty one is left out.
        numbers = {name: float(text) for name, text in row.items() if text != ''}
    except (TypeError, ValueError):
        return None
    whole = 'env_steps' in numbers and all(map(math.isfinite, numbers.values()))
    return numbers if whole else None


def _tensorboard(output: Path, resumed_steps: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    # `RunLog.write` flushes: in a thread of TensorBoard an error would be a traceback.
    never = threading.TIMEOUT_MAX / 2
    folder = str(output / BOARD_FOLDER)
    return SummaryWriter(folder, purge_step=resumed_steps + 1, flush_secs=never)


def read_progress(path: str | Path) -> list[dict[str, float]]:
    """Reads `progress.csv`; empty columns are left out of a row, and rows that are damaged."""
    return [numbers for _, numbers in _whole_rows(path)]


def draw_curve(rows: Sequence[dict[str, float]], title: str, file: str | Path | IO[bytes]) -> None:
    """Draws success against environment steps as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout='constrained')
    axes = figure.add_subplot()
    explored = [row for row in rows if 'train_success' in row]
    evaluated = [row for row in rows if 'eval_success' in row]
    axes.plot(
        [row['env_steps'] for row in explored],
        [row['train_success'] for row in explored],
        color='tab:gray',
        alpha=0.5,
        label='while exploring',
    )
    axes.plot(
        [row['env_steps'] for row in evaluated],
        [row['eval_success'] for row in evaluated],
        marker='.',
        label='deterministic evaluation',
    )
    axes.set(xlabel='environment steps', ylabel='success at the last step', ylim=(-0.02, 1.02))
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend(loc='lower right')
    figure.savefig(file, dpi=120, format='png')
