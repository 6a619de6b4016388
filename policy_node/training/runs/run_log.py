"""The log of a run: terminal line, CSV file, TensorBoard (if installed) and curve as PNG."""

from __future__ import annotations

import csv
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import torch
from rich.console import Console
from rich.live import Live
from rich.text import Text

from node_runtime.signals import discard_unread_output
from policy_node.training.evaluation import EpisodeOutcomes, diagnose, success_rate
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.runs.run_folder import BOARD_FOLDER, PROGRESS_FILE, disk_warning

COLUMNS = (
    'seconds',
    'env_steps',
    'episodes',
    'updates',
    'train_success',
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
# Values of a cycle by column; None if not measured.
Row = dict[str, float | None]
# Columns by field of `Losses`.
_LOSS_COLUMNS = {'critic': 'critic_loss', 'actor': 'actor_loss', 'value': 'mean_value'}
# Seconds between lines if the output is not a terminal.
_PLAIN_INTERVAL = 15.0


class RunLog:
    """Writes one row per cycle to `progress.csv`, TensorBoard and the terminal.

    Args:
        output: Folder of the run. A resumed run appends to its log.
        total_steps: Environment steps of the whole run, to estimate the remaining time.
        time_limit: Time limit of the run, seconds; 0 means none.
        resumed_steps: Environment steps of the checkpoint that the run resumes from. Later rows are
            removed, because the run repeats these steps.
        quiet: Show nothing in the terminal.
        on_row: Function to call with each row.
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
        partial = self.path.with_name(f'.{self.path.name}.partial')
        self._file: IO[str] = partial.open('w', newline='')
        # Older logs lack some columns.
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
        """Write the row of one cycle; a value of None leaves its column empty."""
        with disk_warning(f'{self.path} lacks a row'):
            self._writer.writerow({name: _short(row.get(name)) for name in COLUMNS})
            self._file.flush()
            if self._board is not None:
                self._board.write(row)
        if not self._quiet:
            with disk_warning('no progress line'):
                self._show(row)
        if self._on_row is not None:
            self._on_row(row)

    def close(self) -> None:
        """Stop updating the progress line in the terminal and close the files."""
        discard_unread_output()
        if self._live.is_started:
            self._live.stop()
        with disk_warning(f'{self.path} lacks rows'):
            self._file.close()
            if self._board is not None:
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
        # A closed terminal must not end the run.
        discard_unread_output()
        if self._console.is_terminal:
            self._live.update(Text(line))
        elif time.monotonic() - self._last_plain > _PLAIN_INTERVAL:
            self._last_plain = time.monotonic()
            print(line, file=sys.stderr, flush=True)

    def _remaining(self, row: Row) -> str:
        speed = row['steps_per_second'] or 0
        if speed <= 0:
            return '-'
        remaining = (self._total_steps - (row['env_steps'] or 0)) / speed
        if self._time_limit > 0:
            remaining = min(remaining, self._time_limit - (row['seconds'] or 0))
        return _clock(max(remaining, 0.0))


def evaluation_columns(outcomes: EpisodeOutcomes | None, success_rule: str) -> Row:
    """Return an evaluation as columns of `progress.csv`, success by `success_rule`; {} for None."""
    if outcomes is None:
        return {}
    found = {f'eval_{n}': value for n, value in diagnose(outcomes).items() if n != 'long_way_share'}
    return {
        'eval_success': success_rate(outcomes, success_rule),
        'eval_episodes': len(outcomes),
        'eval_touched': float(outcomes.touched.mean()),
        **found,
    }


def loss_columns(losses: Sequence[Losses]) -> Row:
    """Return the mean losses of a cycle by column of `progress.csv`; all None without updates."""
    found: Row = {}
    for name, column in _LOSS_COLUMNS.items():
        values = [getattr(loss, name) for loss in losses]
        found[column] = float(torch.stack(values).mean()) if values else None
    return found


def _short(value: float | None) -> str:
    return '' if value is None else f'{value:.6g}' if isinstance(value, float) else str(value)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours}:{minutes:02}:{rest:02}'


def _rows_until(path: Path, env_steps: int) -> list[dict[str, str]]:
    """Return the rows up to and with `env_steps`, as text; [] for 0 steps or without a log."""
    if env_steps == 0 or not path.is_file():
        return []
    return [row for row, numbers in _valid_rows(path) if numbers['env_steps'] <= env_steps]


def _valid_rows(path: str | Path) -> Iterator[tuple[dict[str, str], dict[str, float]]]:
    """Yield each row of a log as a pair of its texts and its numbers, which lack empty columns.

    Damaged rows are left out, for example a last row that a killed run wrote only in part.
    """
    with open(path, newline='', encoding='utf-8', errors='replace') as file, suppress(csv.Error):
        for row in csv.DictReader(file):
            try:
                numbers = {name: float(text) for name, text in row.items() if text != ''}
            except (TypeError, ValueError):
                continue
            if 'env_steps' in numbers and all(map(math.isfinite, numbers.values())):
                yield row, numbers


class _Board:
    """A TensorBoard event file.

    TensorBoard's own writers are not used, because an error in their thread prints a traceback.
    """

    def __init__(self, folder: Path, resumed_steps: int) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event, self._summary = event_pb2.Event, summary_pb2.Summary
        folder.mkdir(exist_ok=True)
        name = f'events.out.tfevents.{time.time_ns()}.{os.getpid()}'
        self._records = RecordWriter((folder / name).open('xb'))
        self._write(file_version='brain.Event:2')
        start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        # TensorBoard hides earlier values of the steps that a resumed run repeats.
        self._write(step=resumed_steps + 1, session_log=start)

    def write(self, row: Row) -> None:
        """Write the values of a row to the event file, at the environment steps of the row."""
        values = [
            self._summary.Value(tag=name, simple_value=value)
            for name, value in row.items()
            if value is not None and name != 'env_steps'
        ]
        self._write(step=int(row['env_steps'] or 0), summary=self._summary(value=values))

    def close(self) -> None:
        self._records.close()

    def _write(self, **values: Any) -> None:
        event = self._event(wall_time=time.time(), **values)
        self._records.write(event.SerializeToString())
        self._records.flush()


def _tensorboard(output: Path, resumed_steps: int) -> _Board | None:
    try:
        return _Board(output / BOARD_FOLDER, resumed_steps)
    except ImportError:
        return None


def read_progress(path: str | Path) -> list[dict[str, float]]:
    """Read the rows of `progress.csv` as numbers, without empty columns and damaged rows."""
    return [numbers for _, numbers in _valid_rows(path)]


def draw_curve(rows: Sequence[dict[str, float]], title: str, file: str | Path | IO[bytes]) -> None:
    """Draw the success rates against environment steps and write them to `file` as PNG."""
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
