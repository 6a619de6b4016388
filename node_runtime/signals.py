"""End a process of this project early: at a signal, a closed pipe or Ctrl-C during imports.

`fetch_hand_sim` and `policy_node` call `guard_loading` first, so this module imports little.
"""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# The console scripts of setup.py; a test compares the two.
EXECUTABLES = frozenset(
    ('fetch_hand_sim', 'sim_node', 'policy_node', 'replay_node', 'visualization_node', 'view')
)
_PACKAGES = ('fetch_hand_sim', 'policy_node')
# 128 + SIGINT, as in shells.
EXIT_INTERRUPTED = 130
# The option of prctl(2), `PR_SET_PDEATHSIG`.
_SET_PARENT_DEATH_SIGNAL = 1


def guard_loading() -> None:
    """Make Ctrl-C end this process with one line while a command of this project is imported.

    Imports take a second or more. `run_command` and `StopSignals` replace this handler as soon as
    the command begins. Other programs that import these packages keep their handlers.
    """
    name = _command()
    if name and has_default_interrupt():
        signal.signal(signal.SIGINT, _ExitAtOnce(name))


def has_default_interrupt() -> bool:
    """Return whether SIGINT has Python's handler or that of `guard_loading`."""
    handler = signal.getsignal(signal.SIGINT)
    return handler is signal.default_int_handler or isinstance(handler, _ExitAtOnce)


def _command() -> str:
    """Return the name of the command of this project that this process runs; else ''."""
    program = sys.argv[0] if sys.argv else ''
    if program == '-m':
        # `python -m` sets the file name only after it has imported the packages of the module.
        words = (word for word in sys.orig_argv if word.partition('.')[0] in _PACKAGES)
        return next(words, '').rpartition('.')[2]
    folder, name = os.path.split(program)
    # Our executables share a folder; a user's own script may be called `view`, too.
    is_ours = name in EXECUTABLES and os.path.isfile(os.path.join(folder, _PACKAGES[0]))
    return name if is_ours else ''


class _ExitAtOnce:
    """A signal handler that exits with code 130, because imports may swallow KeyboardInterrupt."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        # Not `print`: the signal may interrupt another one.
        os.write(2, f'{self._name}: stopping\n'.encode())
        os._exit(EXIT_INTERRUPTED)


@contextmanager
def on_stop_signals(
    numbers: Iterable[signal.Signals],
    stop: Callable[[int, FrameType | None], None],
    raises_again: bool = False,
) -> Iterator[list[int]]:
    """Context manager that calls `stop` at the first signal of each kind.

    It yields a list of the signal numbers received so far, which grows as signals arrive. A second
    signal of a kind ends the process. A second SIGHUP is ignored, because a closed terminal sends
    two. The end of the block restores the earlier handlers.

    Args:
        stop: Called with the signal number and the frame.
        raises_again: Whether a second SIGINT raises KeyboardInterrupt instead of ending the
            process. Set it in programs of users, such as notebooks.
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

    before = {number: signal.signal(number, handle) for number in available_signals(numbers)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            # After a first SIGHUP the second one must not interrupt the clean-up.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, handler)


def available_signals(numbers: Iterable[signal.Signals]) -> list[signal.Signals]:
    """Return those of `numbers` that this thread may handle; [] outside of the main thread.

    SIGHUP is excluded if the process ignores it, as under `nohup`.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [number for number in numbers if number != signal.SIGHUP or not ignored]


def discard_unread_output() -> None:
    """Redirect each of stdout and stderr to /dev/null if its terminal or pipe is closed.

    Commands use it to continue after the process that reads their output has ended.
    """
    for number in (1, 2):
        if is_unread(number):
            discard_output(number)


def is_unread(number: int) -> bool:
    """Return whether the other end of a pipe or terminal, file descriptor `number`, is closed."""
    poll = select.poll()
    poll.register(number, 0)
    return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))


def discard_output(number: int) -> None:
    """Redirect a file descriptor to /dev/null, so that the flush at exit raises no error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)


def end_with_parent(parent: int) -> None:
    """Make Linux send SIGTERM to this process when its parent, process id `parent`, ends.

    If the parent has ended already, SIGTERM follows at once. Processes outside of the process group
    of the parent need this, because Ctrl-C does not reach them. Outside of Linux, do nothing.
    """
    if sys.platform != 'linux':
        return
    import ctypes

    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    # The parent may have ended before the line above.
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGTERM)
