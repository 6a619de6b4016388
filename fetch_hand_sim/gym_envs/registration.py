"""Register the ids `fetch_hand_sim/<Task>-v0` and those of Gymnasium-Robotics with Gymnasium."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import gymnasium
from gymnasium.envs.registration import (
    EnvSpec,
    VectorizeMode,
    find_highest_version,
    get_env_id,
    parse_env_id,
)
from gymnasium.vector import VectorEnv

from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TASKS, task_spec

NAMESPACE = 'fetch_hand_sim'
VERSION = 0
_ENV = 'fetch_hand_sim.gym_envs.env:FetchHandEnv'
_VECTOR_ENV = 'fetch_hand_sim.gym_envs.vector_env:FetchHandVectorEnv'


def environment_id(task: str) -> str:
    """Return the Gymnasium id of a task, for example `fetch_hand_sim/FetchPush-v0`."""
    return f'{NAMESPACE}/{task}-v{VERSION}'


def register_environments() -> None:
    """Register the tasks that are not yet registered, without importing MuJoCo."""
    for task in TASKS:
        if environment_id(task) not in gymnasium.registry:
            _register(environment_id(task), _ENV, _VECTOR_ENV, task=task)


def _register(name: str, entry_point: str, vector_entry_point: str, **arguments: str) -> None:
    """Register single and vector environment under the id `name`, with constructor `arguments`."""
    gymnasium.register(
        name,
        entry_point=entry_point,
        vector_entry_point=vector_entry_point,
        max_episode_steps=TASKS[arguments['task']].episode_ticks,
        kwargs=arguments,
    )


def make(name: str | EnvSpec, **arguments: Any) -> gymnasium.Env[Any, Any]:
    """Make an environment whose episodes have the same duration at every `control_hz`.

    `gymnasium.make` itself ends episodes after the number of steps for 25 Hz, unless the user
    passes `max_episode_steps`.

    Args:
        name: A task of `msgs_spec.tasks.TASKS` such as `FetchPush`, a Gymnasium id, or the
            `spec` of an environment.
        **arguments: Arguments of `gymnasium.make` and `FetchHandEnv`, such as `reward_type`,
            `render_mode` and `control_hz`.

    Raises:
        ValueError: If the value of an argument is not allowed.
        gymnasium.error.NameNotFound: If there is no such task or id.
    """
    name = _id_of(name)
    mode = arguments.get('render_mode')
    if not isinstance(mode, str | None):
        raise ValueError(f'render_mode {mode!r:.60}; allowed: a name or None')
    return gymnasium.make(name, **_with_length(name, arguments))


def _id_of(name: str | EnvSpec) -> str | EnvSpec:
    """Replace a task name by its id; return other ids and specs unchanged.

    Raises:
        gymnasium.error.NameNotFound: If there is no such task or id.
    """
    # A package of another task that imports this one before the tasks are known leaves it out.
    register_environments()
    if not isinstance(name, str) or '/' in name or ':' in name or name in gymnasium.registry:
        return name
    if name in TASKS:
        return environment_id(name)
    # Gymnasium finds the version, or lists the existing ones.
    if find_highest_version(None, name.partition('-v')[0]) is not None:
        return name
    reference = '; register_gymnasium_robotics() brings it' if name in reference_ids() else ''
    try:
        return environment_id(task_spec(name).name)
    except ValueError as error:
        raise gymnasium.error.NameNotFound(f'{error}{reference}') from None


def _with_length(name: str | EnvSpec, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with `max_episode_steps` for the task's duration at `control_hz`.

    Arguments with `max_episode_steps`, or without `control_hz`, are returned unchanged.
    """
    rate = arguments.get('control_hz')
    if rate is None or arguments.get('max_episode_steps') is not None:
        return arguments
    known = (name if isinstance(name, EnvSpec) else _spec_of(name)).kwargs
    if 'task' not in known or rate == known.get('control_hz', DEFAULT_CONTROL_HZ):
        return arguments
    ticks = task_spec(known['task'], control_hz=rate).episode_ticks
    return {**arguments, 'max_episode_steps': ticks}


def _spec_of(name: str) -> EnvSpec:
    """Return the spec of an id `[module:]id[-v...]`, the form that `gymnasium.make` accepts."""
    module, _, short = name.rpartition(':')
    if module:
        import_module(module)
    namespace, bare, version = parse_env_id(short)
    if version is None:
        version = find_highest_version(namespace, bare)
    return gymnasium.spec(get_env_id(namespace, bare, version))


def make_vec(
    name: str | EnvSpec,
    num_envs: int = 1,
    wrappers: Sequence[Callable[[Any], VectorEnv[Any, Any, Any]]] | None = None,
    **arguments: Any,
) -> VectorEnv[Any, Any, Any]:
    """Make a vector environment like `gymnasium.make_vec`, with optional wrappers.

    Episodes have the same duration at every `control_hz`, as with `make`.

    Args:
        name: As in `make`.
        wrappers: Wrappers of the vector environment, the innermost first. A wrapper of single
            environments is replaced by the one of the same name in `gymnasium.wrappers.vector`.
        **arguments: Arguments of `FetchHandVectorEnv`.

    Raises:
        ValueError: If a wrapper exists for single environments only, or an argument is not allowed.
        gymnasium.error.NameNotFound: If there is no such task or id.
    """
    name = _id_of(name)
    wrappers = [] if wrappers is None else wrappers
    if not isinstance(wrappers, list | tuple) or not all(map(callable, wrappers)):
        raise ValueError(f'wrappers {wrappers!r:.60}; allowed: a list of them')
    batch = VectorizeMode.VECTOR_ENTRY_POINT
    mode = arguments.pop('vectorization_mode', None)
    if mode not in (None, batch, batch.value):
        raise ValueError(
            f'vectorization_mode {mode!r} is for gymnasium.make_vec with the id; this makes '
            f'batches; allowed: None, {batch.value!r}'
        )
    chosen = [_wrapper_of_batches(wrapper) for wrapper in wrappers]
    env = gymnasium.make_vec(
        name,
        num_envs=num_envs,
        vectorization_mode=batch,
        **_with_length(name, arguments),
    )
    spec = env.unwrapped.spec
    assert spec is not None
    # Gymnasium keeps the registered length there, and shows no limit (-1) as None in `make`.
    length = spec.kwargs.get('max_episode_steps')
    spec.max_episode_steps = None if length == -1 else length
    for wrapper in chosen:
        env = wrapper(env)
    return env


def _wrapper_of_batches(wrapper: Any) -> Any:
    if isinstance(wrapper, functools.partial):
        inner = _wrapper_of_batches(wrapper.func)
        return functools.partial(inner, *wrapper.args, **wrapper.keywords)
    if not (isinstance(wrapper, type) and issubclass(wrapper, gymnasium.Wrapper)):
        return wrapper
    name = wrapper.__name__
    counterpart = getattr(gymnasium.wrappers.vector, name, None)
    if counterpart is None or wrapper is not getattr(gymnasium.wrappers, name, None):
        raise ValueError(
            f'{name} wraps single environments only; for them use '
            "gymnasium.make_vec(..., vectorization_mode='sync', wrappers=[...])"
        )
    if name.startswith('Transform'):
        # Its function is one of a single environment; the counterpart's is one of the batch.
        each = getattr(gymnasium.wrappers.vector, f'Vectorize{name}')
        return functools.partial(each, wrapper=wrapper)
    return counterpart


_REFERENCE_ENV = 'fetch_hand_sim.gym_envs.gymnasium_robotics_env:make_env'
_REFERENCE_VECTOR_ENV = 'fetch_hand_sim.gym_envs.gymnasium_robotics_env:GymnasiumRoboticsVectorEnv'


def register_gymnasium_robotics(override: bool = False) -> None:
    """Register the ids of Gymnasium-Robotics 1.4.2: `FetchPush-v4`, `HandReachDense-v3`, ...

    Code written for Gymnasium-Robotics then runs on this package without another change.

    Args:
        override: Whether to replace ids that another package has registered. If True, this
            function first imports Gymnasium-Robotics. A later import then registers no ids again.

    Raises:
        gymnasium.error.Error: If another package has registered one of the ids and `override` is
            False. No id is registered then.
    """
    if override:
        from fetch_hand_sim.gym_envs.gymnasium_robotics_parts import import_goal_env

        import_goal_env()
    ids = reference_ids()
    foreign = [name for name in ids if _is_foreign(name)]
    if foreign and not override:
        raise gymnasium.error.Error(
            f'{foreign[0]} and {len(foreign) - 1} more are registered by another package; '
            'register_gymnasium_robotics(override=True) replaces them'
        )
    for name, (task, reward_type) in ids.items():
        gymnasium.registry.pop(name, None)
        both = _REFERENCE_ENV, _REFERENCE_VECTOR_ENV
        _register(name, *both, task=task, reward_type=reward_type)


def reference_ids() -> dict[str, tuple[str, str]]:
    """Return (task, reward type) by Gymnasium-Robotics id, for ids that this package can replace.

    Older versions (Fetch -v1, HandReach -v0, HandManipulate* -v0) need mujoco-py and are left out.
    """
    ids = {}
    for task, spec in TASKS.items():
        if spec.reference_id is None:
            continue
        name, version = spec.reference_id.split('-')
        # `HandManipulateBlock` is another name of `HandManipulateBlockFull`.
        for alias in dict.fromkeys((name, name.removesuffix('Full'))):
            ids[f'{alias}-{version}'] = (task, 'sparse')
            ids[f'{alias}Dense-{version}'] = (task, 'dense')
    return ids


def _is_foreign(name: str) -> bool:
    spec = gymnasium.registry.get(name)
    return spec is not None and spec.entry_point != _REFERENCE_ENV
