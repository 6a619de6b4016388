"""Load a policy of any format by its name; the actors in this package are found without torch."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.text import did_you_mean, one_line
from policy_node.policies.policy import (
    LoadedPolicy,
    MemorylessPolicy,
    Observation,
    Policy,
    RandomPolicy,
    RestingPolicy,
)

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor

# The best actor of a run of `fetch_hand_sim train`, and the suffixes of policy files.
_BEST_OF_A_RUN = 'best.safetensors'
_SUFFIXES = ('.safetensors', '.onnx', '.zip')


def shipped_actors() -> dict[str, Path]:
    """Return the checkpoint files of the actors in this package, by name."""
    folder = Path(__file__).parents[1] / 'actors'
    # `<task>.training.safetensors` contains the critic of an actor.
    files = sorted(folder.glob('*.safetensors'))
    return {path.stem: path for path in files if '.' not in path.stem}


def shipped_name(task: str, kind: str) -> str:
    """Return the name of a task's shipped actor of a kind: '' (the usual one) or `robust`."""
    return f'{task}_{kind}' if kind else task


def actor_path(name_or_path: str | Path, others: Sequence[str] = ()) -> Path:
    """Return the file of a shipped actor, or the path if it is a file.

    Args:
        name_or_path: Name of a shipped actor, or a path.
        others: Further names that the caller accepts; only the error message lists them.

    Raises:
        ValueError: If no such actor or file exists. The message lists the shipped actors, or
            the file of the best actor if the path is the folder of a run.
    """
    shipped = shipped_actors()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path, reason = Path(os.path.expanduser(name_or_path)), ''
    try:
        if path.is_file():
            return path
        is_run = (path / _BEST_OF_A_RUN).is_file()
    except OSError as error:
        # For example a name that is too long, or a folder without permission.
        is_run, reason = False, f' ({error.strerror})'
    if is_run:
        raise ValueError(
            f'{path} is a run, not an actor; its best actor is {path / _BEST_OF_A_RUN}'
        )
    if path.suffix in _SUFFIXES:
        raise ValueError(f'no actor {str(path)!r}: there is no such file{reason}')
    names = ', '.join(shipped) or 'none'
    choices = f', {", ".join(map(repr, others[:-1]))} or {others[-1]!r}' if others else ''
    hint = did_you_mean(str(name_or_path), [*shipped, *others])
    raise ValueError(
        f'no actor {str(name_or_path)!r}{reason}; shipped: {names}; '
        f'or the path of a file{choices}{hint}'
    )


RANDOM, RESTING, ROBUST = 'random', 'resting', 'robust'
# The first answers of a library take longest.
_WARM_UP_CALLS = 20
_PYTHON_NAME = re.compile(r'[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*')
# For help texts.
POLICY_NAMES = (
    'a shipped actor (FetchReach), a file (.safetensors, .onnx; .zip of Stable-Baselines3 if you '
    'trust it), a function of yours (module:function, if you trust it), random, resting, or robust '
    '(the shipped actor for disturbed robots); '
    'default: the shipped actor of the task'
)


class TaskMissing(ValueError):
    """Raised if the caller gives no task for a policy that does not name its task."""


def load_actor(name_or_path: str | Path, task: str | None = None) -> Actor:
    """Load an actor as a torch module, ready to `predict` on the CPU.

    Args:
        name_or_path: Task name of a shipped actor (`FetchReach`), or a checkpoint file.
        task: Reject a checkpoint of any other task.

    Raises:
        ValueError: If the actor is unknown or invalid; the message is one line.
    """
    from policy_node.policies import checkpoint

    return checkpoint.load(actor_path(name_or_path), task)[0]


def load_policy(
    name: str | Path = '', task: str | None = None, *, trust: bool = False
) -> LoadedPolicy:
    """Load a policy and try it once. Only models of Stable-Baselines3 need torch.

    Args:
        name: Task name of a shipped actor, a file (`.safetensors`, `.onnx`, `.zip` of
            Stable-Baselines3), `module:function`, `random`, `resting`, `robust` for the robust
            shipped actor of `task`, or '' for the usual one. A function gets the task name. It
            returns an object with `predict`, or a function from one observation to one action.
        task: Reject a policy of any other task. Required if the policy does not name its task.
        trust: Allow policies that run code of their own: `.zip` files and `module:function`.

    Raises:
        TaskMissing: If the policy needs a task and none is given.
        ValueError: If the policy is unknown, invalid or fails; the message is one line.
    """
    name = str(name)
    if name in (RANDOM, RESTING):
        return _untrained(name, task)
    if is_python_name(name) and not os.path.exists(name):
        if not trust:
            raise ValueError(
                f'{name} runs code. If you trust it, add --trust (policy_node: trust:=true)'
            )
        loaded = _load_python(name, _require_task(name, task))
    else:
        if name in ('', ROBUST):
            path = _shipped(task, name)
        else:
            path = actor_path(name, (RANDOM, RESTING, ROBUST))
        loaded = _read(path, task, trust)
        if task not in (None, loaded.task):
            raise ValueError(f'{path} was trained on {loaded.task}, not on {task}')
    spec = task_spec(loaded.task)
    goal = np.zeros(spec.goal.size)
    zeros = {'observation': np.zeros(spec.observation_size), 'achieved_goal': goal}
    for _ in range(_WARM_UP_CALLS):
        loaded.predict(zeros | {'desired_goal': goal})
    return loaded


def _untrained(name: str, task: str | None) -> LoadedPolicy:
    task = _require_task(name, task)
    size = task_spec(task).robot.action_size
    policy: Policy = RandomPolicy(size) if name == RANDOM else RestingPolicy(size)
    return LoadedPolicy(policy, task, f'a {name} policy')


def _shipped(task: str | None, kind: str) -> Path:
    """Return the file of a task's shipped actor, kind '' or `robust`; ValueError if missing."""
    what = f'{kind} actor' if kind else 'actor'
    task, shipped = _require_task(f'the shipped {what}', task), shipped_actors()
    if shipped_name(task, kind) not in shipped:
        names = [name for name in shipped if name.endswith(shipped_name('', kind))]
        raise ValueError(
            f'no {what} is shipped for {task} (shipped: {", ".join(names) or "none"}); '
            f'give a policy: a file, {RANDOM!r} or {RESTING!r}'
        )
    return shipped[shipped_name(task, kind)]


def _read(path: Path, task: str | None, trust: bool) -> LoadedPolicy:
    """Load a `.onnx` file, a `.zip` file (only with `trust`) or, for other names, a checkpoint."""
    if path.suffix == '.onnx':
        from policy_node.policies.onnx import load_onnx

        return load_onnx(path)
    if path.suffix == '.zip':
        from policy_node.policies.stable_baselines3 import load_stable_baselines3

        if not trust:
            raise ValueError(
                f'{path} is a model of Stable-Baselines3, which can run code when it is loaded. '
                'If you trust its author, add --trust (policy_node: trust:=true)'
            )
        return load_stable_baselines3(path, _require_task(path.name, task))
    from policy_node.policies.numpy_actor import load_checkpoint

    return load_checkpoint(path)


def _require_task(name: str, task: str | None) -> str:
    if task is None:
        raise TaskMissing(f'{name} needs a task; allowed: {", ".join(TASKS)}')
    return task


# Policies of the user's own code.


class _FunctionPolicy(MemorylessPolicy):
    """A policy that calls a function from one observation to one action, also in a batch."""

    def __init__(self, function: Callable[[Observation], Any]) -> None:
        self._function = function

    def act(self, observation: Observation) -> NDArray[Any]:
        parts = {name: np.asarray(values) for name, values in observation.items()}
        leading = parts['observation'].shape[:-1]
        rows = [
            np.asarray(self._function({name: values[index] for name, values in parts.items()}))
            for index in np.ndindex(leading)
        ]
        return np.reshape(rows, (*leading, *np.shape(rows)[1:]))


def is_python_name(name: str) -> bool:
    """Return whether a name has the form `module:function`, as `my_policies.reach:make`."""
    return _PYTHON_NAME.fullmatch(name) is not None


@contextlib.contextmanager
def working_directory_first() -> Iterator[None]:
    """Put the working directory first in `sys.path` during the block, and last if it is new there.

    Executables otherwise search their own folder first. In the last place, the directory hides no
    installed module from later imports.
    """
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
        if here not in sys.path:
            sys.path.append(here)


def _load_python(name: str, task: str) -> LoadedPolicy:
    """Import '<module>:<function>', also from the working directory; call it with the task.

    Raise ValueError if this fails, or if the result is neither a policy nor a function.
    """
    module_name, _, function_name = name.partition(':')
    try:
        with working_directory_first():
            made = getattr(import_module(module_name), function_name)(task)
        control_hz = getattr(made, 'control_hz', None)
        control_hz = None if control_hz is None else float(control_hz)
    except (Exception, SystemExit) as error:
        problem = f'{type(error).__name__}: {one_line(error)}'
        raise ValueError(f'{name} returned no policy: {problem}') from None
    if not (callable(made) or hasattr(made, 'predict')):
        raise ValueError(
            f'{name} returned {one_line(type(made).__name__)}; allowed: an object with predict, or '
            'a function from observation to action'
        )
    policy: Policy = made if hasattr(made, 'predict') else _FunctionPolicy(made)
    return LoadedPolicy(policy, task, name, control_hz)
