"""What all command lines share: errors of one line, exit codes, Ctrl-C, closed pipes, progress.

Here, because commands of both packages use it and neither package knows the other.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import re
import select
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from types import FrameType
from typing import Any, NoReturn

from msgs_spec.text import did_you_mean, one_line, printable
from node_runtime.import_guard import EXIT_INTERRUPTED as EXIT_INTERRUPTED
from node_runtime.import_guard import is_nobodys

# Done; done, and something is wrong; not begun, because of what was given.
EXIT_SUCCESS, EXIT_FAILURE, EXIT_USAGE = 0, 1, 2
# What a stream says that takes nothing more.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
# As shells say it: 128 + SIGPIPE.
EXIT_CLOSED_PIPE = 141

# Modules by which an extra of this package is recognised, since ROS brings its own by apt.
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
    """Something is wrong; the message is one line."""

    exit_code = EXIT_FAILURE


class UsageError(CommandError):
    """The user asked for what is not possible; the message is one line that says what is."""

    exit_code = EXIT_USAGE


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line, as those of `run_command` are."""

    def error(self, message: str) -> NoReturn:
        """Says what is wrong and exits; of an unknown name, which one was probably meant."""
        complain(self.prog, f'{message}{self._hint(message)}')
        sys.exit(EXIT_USAGE)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Prints help and the like; that nobody reads them, argparse would swallow or trace."""

        def write() -> int:
            print(message, end='', file=file or sys.stderr)
            return EXIT_SUCCESS

        if code := _exit_code(self.prog, write, ()):
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
    """Returns what reads a number from `lower` to `upper`, for `add_argument(type=...)`."""
    allowed = f'{lower} or more' if upper is None else f'{lower} ... {upper}'

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = lower - 1
        if value < lower or (upper is not None and value > upper):
            raise argparse.ArgumentTypeError(f'{text[:80]!r} given; allowed: {allowed}')
        return value

    return read


class FormerOption(argparse.Action):
    """An option under its former name: it still works, and says what it is called now."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Says so and sets the option."""
        complain(parser.prog, f'{option_string} is now called --{self.dest}')
        setattr(namespace, self.dest, values)


def complain(name: str, text: object) -> None:
    """Prints one line on stderr.

    Args:
        name: The command that complains.
        text: What is wrong; line breaks become spaces, control characters are escaped.
    """
    print(f'{name}: {printable(" ".join(str(text).split()))}', file=sys.stderr, flush=True)


def complain_from_handler(name: str, text: object) -> None:
    """As `complain`, of a signal handler, which may have come in the middle of another line."""
    # Python refuses to write to a stream from within a write to it.
    with suppress(RuntimeError):
        complain(name, text)


def say(text: object) -> None:
    """Prints on stdout what may hold a name of somebody else's, escaped as `complain` does."""
    print(printable(str(text)), flush=True)


def given_command(name: str, arguments: Sequence[str] | None) -> str:
    """Returns the command line that was given, in one line, for the record.

    Args:
        name: The command.
        arguments: Of its `main`; None is those of the process.
    """
    words = [name, *(sys.argv[1:] if arguments is None else arguments)]
    return printable(shlex.join(words))


def run_command(name: str, run: Callable[[], int]) -> int:
    """Runs the body of a command and returns the exit code of the process.

    Args:
        name: Name of the command, for error lines.
        run: Returns the exit code; may raise `CommandError`.

    Returns:
        What `run` returns, or the exit code of what it raised: 1 or 2 for a `CommandError`, 130 for
        Ctrl-C (it is acknowledged at once with a line), 141 if nobody reads the output any more.
        SIGTERM and SIGHUP are as Ctrl-C, with 143 and 129.
    """
    make_output_usable()
    with _stopping_is_said(name) as stopping:
        code = _exit_code(name, run, stopping)
        if stopping and code == EXIT_INTERRUPTED:
            return 128 + stopping[0]
    return code


def _exit_code(name: str, run: Callable[[], int], stopping: Sequence[int]) -> int:
    """Runs the body of a command; `stopping` holds the signal once one came."""
    try:
        code = run()
        sys.stdout.flush()
    except CommandError as error:
        complain(name, error)
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _discard_output(sys.stdout.fileno())
        return EXIT_CLOSED_PIPE
    except OSError as error:
        if error.filename is not None or error.errno not in _FULL:
            raise
        _discard_output(sys.stdout.fileno())
        complain(name, f'cannot write: {error.strerror}')
        return EXIT_FAILURE
    except ImportError:
        # What becomes of KeyboardInterrupt in the initialisation of many a library.
        if not stopping:
            raise
        return EXIT_INTERRUPTED
    except RuntimeError as error:
        # And in `__set_name__` of what a class holds, before Python 3.12.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        return EXIT_INTERRUPTED
    return code


def make_output_usable() -> None:
    """Lets this process print where its stdout or stderr is closed, or cannot take every letter.

    Of a program of somebody else that runs a command, nothing is changed.
    """
    if not is_nobodys():
        return
    for name in ('stdout', 'stderr'):
        stream = getattr(sys, name)
        if stream is None:
            # What cron and daemons may start; it stays open to the end.
            setattr(sys, name, open(os.devnull, 'w'))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')


def start_command(name: str, module: str, *extras: str) -> int:
    """Runs the `main` of a module that needs extras, once it is known that they are there.

    Loading what they bring takes seconds: without this, Ctrl-C in them and what is missing would
    end in tracebacks.
    """

    def run() -> int:
        for extra in extras:
            require_extra(extra)
        main: Callable[[], int] = import_module(module).main
        return main()

    return run_command(name, run)


def require_extra(extra: str, *needed: str) -> None:
    """Checks that what an extra of this package brings is installed.

    Args:
        extra: Its name.
        needed: Those of its modules that are; none given are all of them.

    Raises:
        UsageError: If not; the message says what to install.
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
    """Refuses an rclpy that is found and cannot be used, as that of a ROS for another Python."""
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
    """Shows how far a command is and how long it will take; nothing unless somebody watches.

    Args:
        description: What is counted.
        total: How many there are.

    Yields:
        A function to call with the number of those that were done since the last call.
    """
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
            # What was counted is not lost with the terminal that it was shown on.
            if _is_unread(2):
                discard_unread_output()


@contextmanager
def _stopping_is_said(name: str) -> Iterator[list[int]]:
    """Ctrl-C says `stopping` before it raises KeyboardInterrupt; a second one ends the process.

    SIGTERM and SIGHUP do the same, unless somebody else takes or ignores them: what is half written
    is taken away.

    Yields:
        A list that will hold the signal.
    """

    def say_and_raise(number: int, frame: FrameType | None) -> None:
        complain_from_handler(name, 'stopping')
        signal.default_int_handler(number, frame)

    with on_stop_signals(_nobodys_signals(), say_and_raise) as received:
        yield received


@contextmanager
def on_stop_signals(
    numbers: Iterable[signal.Signals],
    stop: Callable[[int, FrameType | None], None],
    raises_again: bool = False,
) -> Iterator[list[int]]:
    """Calls `stop` when one of these signals comes for the first time; again, it ends the process.

    But not a second SIGHUP: a closed terminal sends one, and the shell in it another; so after the
    first they are ignored. One that is ignored from the start, as `nohup` has it, stays so.

    Args:
        numbers: The signals.
        stop: Is called with the number and the frame.
        raises_again: Whether a second SIGINT raises KeyboardInterrupt instead, because the process
            is somebody else's program, a notebook perhaps.

    Yields:
        A list that will hold the numbers of those that came.
    """
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        again: Any = signal.SIG_IGN if number == signal.SIGHUP else signal.SIG_DFL
        if raises_again and number == signal.SIGINT:
            again = signal.default_int_handler
        signal.signal(number, again)
        discard_unread_output()
        stop(number, frame)

    before = {number: signal.signal(number, handle) for number in heard(numbers)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            # A SIGHUP that is ignored by now has come once, here or in a part of what ran: the next
            # one must not kill what ends.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, handler)


def heard(numbers: Iterable[signal.Signals]) -> list[signal.Signals]:
    """Those of these signals that may be taken: all but a SIGHUP that `nohup` has ignored.

    None in a thread: Python hands signals to the main one.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [number for number in numbers if number != signal.SIGHUP or not ignored]


def _nobodys_signals() -> list[signal.Signals]:
    """The signals that a command takes: none inside of another one or of somebody else's program.

    What a shell starts in the background ignores Ctrl-C, and SIGTERM ends it all the same.
    """
    ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    if not (is_nobodys() or ignored):
        return []
    others = (signal.SIGTERM, signal.SIGHUP)
    found = [each for each in others if signal.getsignal(each) == signal.SIG_DFL]
    return found if ignored else [signal.SIGINT, *found]


def discard_unread_output() -> None:
    """Lets what this process prints go nowhere, where its terminal or pipe has been closed.

    For commands that have more to do than to print: writing there would be an error.
    """
    for number in (1, 2):
        if _is_unread(number):
            _discard_output(number)


def _is_unread(number: int) -> bool:
    """Whether nobody reads what is written to a file descriptor any more."""
    poll = select.poll()
    poll.register(number, 0)
    return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))


def _discard_output(number: int) -> None:
    """Lets Python flush a stream at its end without an error, although it is closed."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
