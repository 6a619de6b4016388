"""Policies in `.zip` files of Stable-Baselines3, trained on the observations of this package.

**Such a file contains pickles, and loading it can run code**: load only files of authors you trust.
It contains neither task nor action frequency, so only sizes are checked. A model that was trained
under `VecNormalize` needs the file of its statistics beside it.
"""

from __future__ import annotations

import io
import json
import logging
import pickle
import re
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.text import one_line
from policy_node.policies.files import read_file, sha256
from policy_node.policies.policy import LoadedPolicy, Observation

# Algorithms by package of the policy class. PPO and A2C have the same one.
_ALGORITHMS = {
    'stable_baselines3.sac': ('SAC',),
    'stable_baselines3.td3': ('TD3',),
    'stable_baselines3.common': ('PPO', 'A2C'),
    'sb3_contrib.tqc': ('TQC',),
}
# A stored replay buffer could require an environment or its full memory.
_WITHOUT_TRAINING: dict[str, Any] = {
    'replay_buffer_class': None,
    'replay_buffer_kwargs': {},
    'buffer_size': 1,
    'learning_rate': 0.0,
    'lr_schedule': lambda progress: 0.0,
}
# Networks of the paper's size have 10 MB with optimisers.
_LARGEST_FILE = 256 * 2**20
# Statistics of `VecNormalize` beside a model, as rl-zoo3 and the documentation of
# Stable-Baselines3 name them.
_STATISTICS = ('vecnormalize.pkl', 'vec_normalize.pkl')


class StableBaselines3Policy:
    """The policy of a Stable-Baselines3 model; by default it acts without exploration noise.

    Args:
        statistics: The `VecNormalize` of the training, to normalise observations, or None.
    """

    def __init__(self, policy: Any, statistics: Any = None) -> None:
        self._policy = policy
        self._statistics = statistics

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return actions (..., action size) in [-1, 1] and state, as `BasePolicy.predict` does."""
        seen: Any = dict(observation)
        if self._statistics is not None:
            seen = self._statistics.normalize_obs(seen)
        action, state = self._policy.predict(seen, state, episode_start, deterministic)
        return action, state


def load_stable_baselines3(path: Path, task: str) -> LoadedPolicy:
    """Load a model for running; this can run code that the file contains.

    Raises:
        ValueError: If the library is missing, the file is invalid or its sizes do not fit the task.
    """
    data = read_file(path, _LARGEST_FILE)
    algorithm = _algorithm(data, path)
    try:
        model = algorithm.load(io.BytesIO(data), device='cpu', custom_objects=_WITHOUT_TRAINING)
    except Exception as error:
        # Unpickling a file of another version can raise anything.
        raise ValueError(f'{path} cannot be loaded: {one_line(error)}') from None
    _check_sizes(path, task_spec(task), model.policy)
    statistics, ending = None, ''
    if file := _statistics_file(path):
        content = read_file(file)
        data += content
        statistics, ending = _statistics(file, content), f' with {file.name}'
    else:
        logging.getLogger(__name__).warning(
            '%s has no %s beside it: if it was trained under VecNormalize, its actions are wrong',
            path,
            _STATISTICS[0],
        )
    return LoadedPolicy(
        policy=StableBaselines3Policy(model.policy, statistics),
        task=task,
        description=f'Stable-Baselines3 {algorithm.__name__} {path.name}{ending}',
        sha256=sha256(data),
    )


def _statistics_file(path: Path) -> Path | None:
    """Return the file with the `VecNormalize` statistics beside a model, or None.

    `CheckpointCallback` writes `a_vecnormalize_9_steps.pkl` for `a_9_steps.zip`.
    """
    of_checkpoint = re.sub(r'(\d+_steps)$', r'vecnormalize_\1', path.stem)
    names = (f'{of_checkpoint}.pkl', f'{path.stem}_vecnormalize.pkl', *_STATISTICS)
    files = [path.with_name(name) for name in names]
    return next((file for file in files if file.is_file() and file.stem != path.stem), None)


def _statistics(file: Path, content: bytes) -> Any:
    """Return the `VecNormalize` pickled in `content`, the bytes of `file`; this can run code."""
    try:
        statistics = pickle.loads(content)
    except Exception as error:
        # Unpickling a file of another version can raise anything.
        raise ValueError(f'{file} cannot be loaded: {one_line(error)}') from None
    if type(statistics).__name__ != 'VecNormalize':
        raise ValueError(f'{file} contains {type(statistics).__name__}; allowed: VecNormalize')
    return statistics


def _algorithm(data: bytes, path: Path) -> Any:
    """Return the class of the algorithm that saved a model, such as `SAC`, or raise ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            settings = json.loads(file.read('data'))
        module = settings['policy_class']['__module__']
    except Exception as error:
        # Each compression method raises its own types for a damaged file.
        line = one_line(error)
        raise ValueError(f'{path} is not a file of Stable-Baselines3: {line}') from None
    for package, names in _ALGORITHMS.items():
        if str(module).startswith(f'{package}.'):
            library = package.partition('.')[0]
            # Only PPO has a clip range.
            name = names[0] if 'clip_range' in settings else names[-1]
            try:
                return getattr(import_module(library), name)
            except ImportError:
                missing = library.replace('_', '-')
                raise ValueError(f'{path.name} needs {missing}: pip install {missing}') from None
    allowed = ', '.join(name for names in _ALGORITHMS.values() for name in names)
    raise ValueError(f'{path} has a policy of {one_line(module)}; allowed: {allowed}')


def _check_sizes(path: Path, spec: TaskSpec, policy: Any) -> None:
    spaces = getattr(policy.observation_space, 'spaces', {})
    found = {name: space.shape for name, space in spaces.items()}
    found['action'] = policy.action_space.shape
    wanted = {
        'observation': (spec.observation_size,),
        'achieved_goal': (spec.goal.size,),
        'desired_goal': (spec.goal.size,),
        'action': (spec.robot.action_size,),
    }
    if found != wanted:
        raise ValueError(f'{path} has shapes {found}; {spec.name} has {wanted}')
    limits = [getattr(policy.action_space, name, 0.0) for name in ('low', 'high')]
    if not (np.all(limits[0] == -1.0) and np.all(limits[1] == 1.0)):
        # The file does not contain the scaling of its training.
        raise ValueError(
            f'{path} has actions in {one_line(policy.action_space)}; allowed: -1 ... 1'
        )
