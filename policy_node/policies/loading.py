"""Load a policy by one name, in every format that the node and the commands accept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.text import one_line
from policy_node.policies.policy import LoadedPolicy, Policy, RandomPolicy, RestingPolicy
from policy_node.policies.python_policy import is_python_name, load_python
from policy_node.policies.shipped import actor_path, shipped_actors, shipped_name

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor

RANDOM, RESTING, ROBUST = 'random', 'resting', 'robust'
_WARM_UP_CALLS = 20
# For help texts and descriptions of parameters.
POLICY_NAMES = (
    'a shipped actor (FetchReach), a file (.safetensors, .onnx; .zip of Stable-Baselines3 if you '
    'trust it), a function of yours (module:function, if you trust it), random, resting, or robust '
    '(the shipped actor for disturbed robots); '
    'default: the shipped actor of the task'
)


class TaskMissing(ValueError):
    """A policy that fits any task, or does not say which, was asked for without one."""


def load_actor(name_or_path: str | Path, task: str | None = None) -> Actor:
    """Loads an actor as a torch module, ready to `predict` on the CPU.

    Args:
        name_or_path: Task name of a shipped actor (`FetchReach`), or a checkpoint file.
        task: Refuse a checkpoint of any other task.

    Raises:
        ValueError: If there is no such actor or it does not fit; one line says why.
    """
    from policy_node.policies import checkpoint

    return checkpoint.load(actor_path(name_or_path), task)[0]


def load_policy(
    name: str | Path = '', task: str | None = None, *, trust: bool = False
) -> LoadedPolicy:
    """Loads the policy called `name`; torch is imported only for those of Stable-Baselines3.

    Args:
        name: Task name of a shipped actor; file of an actor of this project, as checkpoint or ONNX;
            .zip of Stable-Baselines3; `module:function` of somebody's code (`python_policy.py`);
            `random`, `resting`; '' for the shipped actor of `task`, `robust` for its robust one.
        task: Refuse a policy of any other task. Needed where the name does not tell.
        trust: Whether code may be run: a .zip of Stable-Baselines3 holds some, a function is some.

    Raises:
        TaskMissing: If the policy needs a task and none is given.
        ValueError: If there is no such policy, or it does not fit; one line says why.
    """
    name = str(name)
    if name in (RANDOM, RESTING):
        return _untrained(name, task)
    if is_python_name(name) and not Path(name).exists():
        loaded = _made_by(name, task, trust)
    else:
        if name in ('', ROBUST):
            path = _shipped(task, name)
        else:
            path = actor_path(name, (RANDOM, RESTING, ROBUST))
        loaded = _read(path, task, trust)
    _try_out(loaded, task_spec(loaded.task))
    return loaded


def _untrained(name: str, task: str | None) -> LoadedPolicy:
    size = task_spec(_require_task(name, task)).robot.action_size
    policy: Policy = RandomPolicy(size) if name == RANDOM else RestingPolicy(size)
    return LoadedPolicy(policy, _require_task(name, task), f'a {name} policy')


def _shipped(task: str | None, kind: str) -> Path:
    """Return the shipped policy of a task: the usual one (kind ''), or the robust one."""
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
    """Reads a file by the ending of its name; each format brings its own libraries."""
    if path.suffix == '.onnx':
        from policy_node.policies.onnx import load_onnx

        return load_onnx(path, task)
    if path.suffix == '.zip':
        from policy_node.policies.stable_baselines3 import load_stable_baselines3

        if not trust:
            raise ValueError(
                f'{path} is a model of Stable-Baselines3: loading it runs the code in it; if you '
                'trust who made it, say so (--trust; trust:=true for policy_node)'
            )
        return load_stable_baselines3(path, _require_task(path.name, task))
    from policy_node.policies.numpy_actor import load_checkpoint

    return load_checkpoint(path, task)


def _made_by(name: str, task: str | None, trust: bool) -> LoadedPolicy:
    if not trust:
        raise ValueError(
            f'{name} is code that would be run; if you trust it, say so (--trust; trust:=true for '
            'policy_node)'
        )
    return load_python(name, _require_task(name, task))


def _require_task(name: str, task: str | None) -> str:
    if task is None:
        raise TaskMissing(f'{name} needs a task; allowed: {", ".join(TASKS)}')
    return task


def _try_out(loaded: LoadedPolicy, spec: TaskSpec) -> None:
    """Refuses a policy that cannot answer; the first answers of a library take longest, too."""
    zeros = {
        'observation': np.zeros(spec.observation_size),
        'achieved_goal': np.zeros(spec.goal.size),
        'desired_goal': np.zeros(spec.goal.size),
    }
    try:
        for _ in range(_WARM_UP_CALLS):
            action, _ = loaded.predict(zeros)
        action = np.asarray(action, dtype=np.float64)
    except Exception as error:
        # Libraries raise types of their own for a model that loads but does not run.
        raise ValueError(f'{loaded.description} does not run: {one_line(error)}') from None
    if action.shape != (spec.robot.action_size,) or not np.isfinite(action).all():
        raise ValueError(
            f'{loaded.description} answers with {one_line(action)}; '
            f'allowed: {spec.robot.action_size} finite numbers'
        )
