"""Ctrl-C while a command is being loaded: one line and exit code 130 instead of a traceback.

What a command imports takes a second and more, and its `main` comes last. Both packages that have
commands therefore begin with `guard_loading`. It touches nothing in a program of somebody else that
imports them, and imports nothing that Python has not loaded by then.
"""

import os
import signal
import sys
from types import FrameType

# The console scripts of setup.py; a test holds them equal.
EXECUTABLES = frozenset(
    (
        'fetch_hand_sim sim_node policy_node replay_node visualization_node view train_her '
        'evaluate_policy generate_episodes benchmark export_actor list_episodes check_episode '
        'render_episode recover_episodes export_episodes'
    ).split()
)
_PACKAGES = ('fetch_hand_sim', 'policy_node')
# 128 + SIGINT, as shells say it.
EXIT_INTERRUPTED = 130


def guard_loading() -> None:
    """Lets Ctrl-C end this process at once, if it is a command of ours that is being loaded.

    `run_command` and `StopSignals` take over as soon as the command itself begins.
    """
    name = _command()
    if name and is_nobodys():
        signal.signal(signal.SIGINT, _Ending(name))


def is_nobodys() -> bool:
    """Whether Ctrl-C is as Python or `guard_loading` set it, and no handler of somebody else's."""
    handler = signal.getsignal(signal.SIGINT)
    return handler is signal.default_int_handler or isinstance(handler, _Ending)


def _command() -> str:
    """Returns the name of the command that this process is, '' if it is none of ours."""
    program = sys.argv[0] if sys.argv else ''
    if program == '-m':
        # As long as `python -m` imports the packages of the module; then it says the file.
        words = (word for word in sys.orig_argv if word.partition('.')[0] in _PACKAGES)
        return next(words, '').rpartition('.')[2]
    folder, name = os.path.split(program)
    # All lie in one folder; a script of somebody else's may well be called `view`.
    is_ours = name in EXECUTABLES and os.path.isfile(os.path.join(folder, _PACKAGES[0]))
    return name if is_ours else ''


class _Ending:
    """A handler that ends the process at once, because nothing has begun yet.

    KeyboardInterrupt in an import may come out of it as another error, or be swallowed.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        # Not `print`: the signal may have come in the middle of another one.
        os.write(2, f'{self._name}: stopping\n'.encode())
        os._exit(EXIT_INTERRUPTED)
