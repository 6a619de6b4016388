"""Actors as ONNX files: written by `export_actor`, run without torch.

The graph takes `observation` (n, observation size) and `desired_goal` (n, goal size), float32, in
the units of the task, normalisation included, and returns `action` (n, action size) in [-1, 1]. The
file's metadata say what it was trained on.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.actions import command_from_action
from msgs_spec.tasks import TASKS, TaskSpec, task_spec

if TYPE_CHECKING:
    from policy_node.policies.commander import Observation

FORMAT = 'fetch_hand_actor'
INPUTS = ('observation', 'desired_goal')
OUTPUT = 'action'


class OnnxActor:
    """Runs an ONNX file on one thread.

    Attributes:
        task: The task it was trained on.
        control_hz: The action frequency it was trained at.
    """

    def __init__(self, path: Path) -> None:
        """Loads a file.

        Raises:
            ValueError: If onnxruntime is missing, or the file is none of this project or does not
                fit its task; one line says why.
        """
        try:
            import onnxruntime
        except ImportError:
            raise ValueError(f'{path.name} needs onnxruntime: pip install onnxruntime') from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(
                path, options, providers=['CPUExecutionProvider']
            )
        except Exception as error:
            # onnxruntime raises a type of its own for each kind of damage.
            line = ' '.join(str(error).split())[:200]
            raise ValueError(f'{path} is not a readable ONNX file: {line}') from None
        metadata = self._session.get_modelmeta().custom_metadata_map
        if metadata.get('format') != FORMAT:
            raise ValueError(f'{path} is no actor of this project; export_actor writes them')
        self.task, self.control_hz = _read_metadata(path, metadata)
        self._check_sizes(path, task_spec(self.task))

    def predict(self, observation: Observation) -> NDArray[np.float32]:
        """Returns the action (action size,) in [-1, 1] for one observation."""
        inputs = {name: np.asarray(observation[name], np.float32)[None] for name in INPUTS}
        (action,) = self._session.run([OUTPUT], inputs)
        return np.asarray(action[0], np.float32)

    def _check_sizes(self, path: Path, spec: TaskSpec) -> None:
        places = (*self._session.get_inputs(), *self._session.get_outputs())
        found = {place.name: place.shape[-1] for place in places}
        wanted = {
            'observation': spec.observation_size,
            'desired_goal': spec.goal.size,
            OUTPUT: spec.robot.action_size,
        }
        if found != wanted:
            raise ValueError(f'{path} has sizes {found}; {spec.name} has {wanted}')


def _read_metadata(path: Path, metadata: dict[str, str]) -> tuple[str, float]:
    try:
        task, control_hz = json.loads(metadata['task']), float(json.loads(metadata['control_hz']))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{path} has unreadable metadata: {error}') from None
    if task not in TASKS:
        raise ValueError(f'{path} was trained on unknown task {task!r}')
    return task, control_hz


class OnnxCommander:
    """An ONNX actor that fits the robot."""

    def __init__(self, path: Path, spec: TaskSpec, sha256: str) -> None:
        """Loads the file.

        Raises:
            ValueError: If it cannot be used.
        """
        self._actor = OnnxActor(path)
        if self._actor.task != spec.name:
            raise ValueError(f'{path.name} was trained on {self._actor.task}, not on {spec.name}')
        self.control_hz: float | None = self._actor.control_hz
        self.spec = spec
        self.description = f'actor {path.name}'
        self.sha256 = sha256

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the actor's command."""
        action: Any = self._actor.predict(observation)
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)
