"""Actors that Stable-Baselines3 trained on the same dict observation: its `.zip` files.

Such a file holds pickles, and loading one runs the code in it: load only those you trust. It does
not say which task or rate it was trained at, so only sizes can be checked.
"""

from __future__ import annotations

import json
import zipfile
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.actions import command_from_action
from msgs_spec.tasks import TaskSpec

if TYPE_CHECKING:
    from policy_node.policies.commander import Observation

# Packages of policy classes, and the algorithm that loads each.
_ALGORITHMS = {
    'stable_baselines3.sac': 'SAC',
    'stable_baselines3.td3': 'TD3',
    'stable_baselines3.common': 'PPO',
    'sb3_contrib.tqc': 'TQC',
}
# A stored replay buffer class may ask for an environment, and any buffer for its full memory.
_WITHOUT_TRAINING: dict[str, Any] = {
    'replay_buffer_class': None,
    'replay_buffer_kwargs': {},
    'buffer_size': 1,
    'learning_rate': 0.0,
    'lr_schedule': lambda progress: 0.0,
}


class StableBaselines3Commander:
    """A policy of Stable-Baselines3 that fits the robot."""

    control_hz: float | None = None

    def __init__(self, path: Path, spec: TaskSpec, sha256: str) -> None:
        """Loads the file.

        Raises:
            ValueError: If the library is missing, the file cannot be read or its sizes do not fit.
        """
        algorithm = _algorithm(path)
        try:
            self._policy: Any = algorithm.load(
                path, device='cpu', custom_objects=_WITHOUT_TRAINING
            ).policy
        except Exception as error:
            # Unpickling a file of another version can raise anything.
            line = ' '.join(str(error).split())[:200]
            raise ValueError(f'{path} cannot be loaded: {line}') from None
        _check_sizes(path, spec, self._policy)
        self.spec = spec
        self.description = f'Stable-Baselines3 {algorithm.__name__} {path.name}'
        self.sha256 = sha256

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the policy's command, without exploration noise."""
        action, _ = self._policy.predict(observation, deterministic=True)
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)


def _algorithm(path: Path) -> Any:
    """The class that loads a file, told by the policy class in it."""
    try:
        with zipfile.ZipFile(path) as file:
            module = json.loads(file.read('data'))['policy_class']['__module__']
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f'{path} is not a file of Stable-Baselines3: {error}') from None
    for package, name in _ALGORITHMS.items():
        if str(module).startswith(f'{package}.'):
            library = package.partition('.')[0]
            try:
                return getattr(import_module(library), name)
            except ImportError:
                missing = library.replace('_', '-')
                raise ValueError(f'{path.name} needs {missing}: pip install {missing}') from None
    raise ValueError(f'{path} has a policy of {module}; allowed: {", ".join(_ALGORITHMS.values())}')


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
