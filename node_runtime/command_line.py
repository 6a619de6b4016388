"""Run commands: print one-line errors, return exit codes, check extras and show progress.

`run_command` is the one place where errors become exit codes.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from types import FrameType
from typing import Any, NoReturn

from msgs_spec.text import did_you_mean, one_line, printable
from node_runtime.signals import (
    EXIT_INTERRUPTED,
    discard_output,
    discard_unread_output,
    has_default_interrupt,
    is_unread,
    on_stop_signals,
)

# Done, failed, and not started because of wrong arguments.
EXIT_SUCCESS, EXIT_FAILURE, EXIT_USAGE = 0, 1, 2
# 128 + SIGPIPE, as in shells.
EXIT_CLOSED_PIPE = 141
# Errors of a full output.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})

# Modules that show whether an extra of this package is installed; ROS installs its own by apt.
EXTRAS = {
    'ros': ('rclpy',),
    'actors': ('torch',),
    'train': ('torch', 'matplotlib', 'tensorboard'),
    'data': ('pyarrow', 'minari'),
    'sb3': ('stable_baselines3',),
    'onnx': ('onnx', 'onnxruntime', 'onnxscript'),
    'film': ('imageio_ffmpeg',),
    'cluster': ('ray',),
}


class CommandError(Exception):
    """A command failed; the message is one line."""

    exit_code = EXIT_FAILURE


class UsageError(CommandError):
    """The arguments of a command are wrong; the message names the allowed ones in one line."""

    exit_code = EXIT_USAGE


@contextmanager
def usage_errors(
    errors: type[Exception] | tuple[type[Exception], ...] = ValueError, prefix: str = ''
) -> Iterator[None]:
    """Convert `errors` in the `with` block to `UsageError`; put `prefix` before its message."""
    try:
        yield
    except errors as error:
        raise UsageError(f'{prefix}{error}') from None


class CommandParser(argparse.ArgumentParser):
    """An argument parser with one-line errors and suggestions for misspelt names."""

    def error(self, message: str) -> NoReturn:
        """Print the error, with a suggestion if a name seems misspelt, and exit with code 2."""
        complain(self.prog, f'{message}{self._hint(message)}')
        sys.exit(EXIT_USAGE)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print help; exit with an error if the output cannot be written.

        argparse itself would ignore the failure or print a traceback.
        """

        def write() -> int:
            print(message, end='', file=file or sys.stderr)
            return EXIT_SUCCESS

        if code := _exit_code(self.prog, write):
            sys.exit(code)

    def _hint(self, message: str) -> str:
        unknown = re.match(r'unrecognized arguments: (--[\w-]+)', message)
        if unknown:
            return did_you_mean(unknown[1], list(self._option_string_actions))
        assigned = re.match(r'unrecognized arguments: (\w+=\S+)', message)
        if assigned and '--set' in self._option_string_actions:
            return f'; each has a --set of its own: --set {assigned[1]}'
        has_switches = any(option.startswith('--no-') for option in self._option_string_actions)
        word = re.match(r'unrecognized arguments: (?:true|false|yes|no|on|off)\b', message, re.I)
        if word and has_switches:
            return '; switches take no value: --name is on, --no-name is off'
        choice = re.match(r"argument (?:[^:]*/)?(--[\w-]+): invalid choice: '([^']*)'", message)
        choices = self._option_string_actions[choice[1]].choices if choice else None
        return did_you_mean(choice[2], map(str, choices)) if choice and choices else ''


def whole_number(lower: int, upper: int | None = None) -> Callable[[str], int]:
    """Return a parser of integers `lower` ... `upper` (None: no limit), for `type` of an option."""
    allowed = f'whole numbers {f"from {lower}" if upper is None else f"{lower} ... {upper}"}'

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = lower - 1
        if value < lower or (upper is not None and value > upper):
            raise argparse.ArgumentTypeError(f'{text[:80]!r} given; allowed: {allowed}')
        return value

    return read


def complain(name: str, text: object) -> None:
    """Print a text as one line on stderr, after the name of the command.

    Line breaks become spaces and control characters are escaped.
    """
    print(f'{name}: {printable(" ".join(str(text).split()))}', file=sys.stderr, flush=True)


def complain_from_handler(name: str, text: object) -> None:
    """Call `complain` in a signal handler; print nothing if the signal interrupted a write."""
    # Python forbids a write to a stream within another write to it.
    with suppress(RuntimeError):
        complain(name, text)


def say(text: object) -> None:
    """Print a line on stdout; control characters are escaped, as in `complain`."""
    print(printable(str(text)), flush=True)


def show_table(table: Any, least_width: int = 0) -> None:
    """Print a table of Rich on stdout, as wide as the terminal and at least `least_width`."""
    from rich.console import Console

    console = Console(width=max(Console().width, least_width))
    # If the output is closed, `print` raises BrokenPipeError; Rich would end the process with 1.
    with console.capture() as captured:
        console.print(table)
    print(captured.get(), end='', flush=True)


def given_command(name: str, arguments: Sequence[str] | None) -> str:
    """Return `name` and `arguments` (None: those of `sys.argv`) as one line, quoted for a shell."""
    words = [*name.split(), *(sys.argv[1:] if arguments is None else arguments)]
    return printable(shlex.join(words))


def run_command(name: str, run: Callable[[], int]) -> int:
    """Run the body of a command and return the exit code of the process.

    Returns:
        The result of `run`; 2 for a `UsageError`; 1 for another `CommandError` or a full disk; 141
        for a closed output; 130, 143 or 129 after SIGINT, SIGTERM or SIGHUP.
    """
    make_output_usable()

    def stop(number: int, frame: FrameType | None) -> None:
        complain_from_handler(name, 'stopping')
        signal.default_int_handler(number, frame)

    with on_stop_signals(_unclaimed_signals(), stop) as received:
        code = _exit_code(name, run)
        # A command may run another one, which does not see the signal.
        return 128 + received[0] if received and code == EXIT_INTERRUPTED else code


def _exit_code(name: str, run: Callable[[], int]) -> int:
    """Return the result of `run`, or print its error and return its code as in `run_command`."""
    try:
        code = run()
        sys.stdout.flush()
        return code
    except CommandError as error:
        complain(name, error)
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        discard_output(sys.stdout.fileno())
        return EXIT_CLOSED_PIPE
    except OSError as error:
        if error.filename is not None or error.errno not in _FULL:
            raise
        discard_output(sys.stdout.fileno())
        complain(name, f'cannot write: {error.strerror}')
        return EXIT_FAILURE


def _unclaimed_signals() -> list[signal.Signals]:
    """Return those of SIGINT, SIGTERM and SIGHUP that have the default handler.

    Returns [] if the program has its own handler of SIGINT. If SIGINT is ignored, as in background
    processes of shells, the other two are still returned.
    """
    if _handles_interrupt():
        return []
    others = (signal.SIGTERM, signal.SIGHUP)
    found = [each for each in others if signal.getsignal(each) == signal.SIG_DFL]
    return [signal.SIGINT, *found] if has_default_interrupt() else found


def _handles_interrupt() -> bool:
    """Return whether the program has its own handler of SIGINT."""
    is_ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    return not (is_ignored or has_default_interrupt())


def make_output_usable() -> None:
    """Replace a missing stdout or stderr by /dev/null; escape characters not in the encoding.

    Does nothing in a program with its own SIGINT handler, which called the command as a function.
    """
    if _handles_interrupt():
        return
    for name in ('stdout', 'stderr'):
        stream = getattr(sys, name)
        if stream is None:
            # Daemons may start a process without it; the replacement stays open to the end.
            setattr(sys, name, open(os.devnull, 'w'))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')


def start_command(name: str, module: str, *extras: str) -> int:
    """Import `module`, which needs `extras` of this package, and return the result of its `main`.

    If an extra is missing, print what to install and return 2.
    """
    try:
        for extra in extras:
            require_extra(extra)
    except UsageError as error:
        complain(name, error)
        return error.exit_code
    main: Callable[[], int] = import_module(module).main
    return main()


def require_extra(extra: str, *needed: str) -> None:
    """Raise UsageError, which names what to install, if modules of an extra are missing.

    `needed` names the modules to check; by default all modules of the extra are checked.
    """
    missing = [module for module in needed or EXTRAS[extra] if find_spec(module) is None]
    if missing:
        source = 'source a ROS 2 Jazzy installation or ' if extra == 'ros' else ''
        raise UsageError(
            f"{' and '.join(missing)} missing: {source}pip install 'fetch_hand_sim[{extra}]'"
        )
    if extra == 'ros':
        _require_rclpy()


def _require_rclpy() -> None:
    """Raise UsageError if rclpy cannot be imported, for example if it is for another Python."""
    try:
        import_module('rclpy')
    except (ImportError, OSError) as error:
        python = '.'.join(map(str, sys.version_info[:2]))
        raise UsageError(
            f'rclpy cannot be used by Python {python} (a sourced ROS 2 Jazzy is for 3.12): '
            f'{one_line(error)}'
        ) from None


@contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a progress bar up to `total` if stderr is a terminal; yield a function to advance it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(), Remaining())
    bars = Progress(
        *columns,
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
        # Lines printed meanwhile go above the bar, unless they go to a file.
        redirect_stdout=sys.stdout.isatty(),
    )
    with bars:
        bar = bars.add_task(description, total=total)
        try:
            yield lambda count: bars.advance(bar, count)
        finally:
            # The work is valid even if the terminal with the bar has closed.
            if is_unread(2):
                discard_unread_output()
