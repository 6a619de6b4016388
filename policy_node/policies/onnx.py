"""Actors as ONNX files: written by `fetch_hand_sim export`, run without torch.

The graph takes `observation` (n, observation size) and `desired_goal` (n, goal size), float32, in
the units of the task. It normalises them and returns `action` (n, action size) in [-1, 1]. The
metadata are those of a checkpoint.

A few hundred bytes of ONNX can request gigabytes. So a file first runs once in its own process,
`python -m policy_node.policies.onnx`, with limited memory and time. This limits the cost of loading
and of one observation; a crafted graph can still cost more for other observations.
"""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.text import one_line
from policy_node.policies.checkpoint import ActorInfo, loaded_actor, parse_metadata
from policy_node.policies.files import read_file, sha256
from policy_node.policies.network_shape import NetworkPolicy
from policy_node.policies.policy import LoadedPolicy

INPUTS = ('observation', 'desired_goal')
OUTPUT = 'action'
# Field `location` of a tensor with weights in another file, encoded by protobuf: tag, length, text.
# The value may come before it, and tag and length may have more bytes than they need.
_EXTERNAL = re.compile(rb'(\n|\x8a\x80*\x00)(\x08|\x88\x80*\x00)location')

# Limits of the trial; onnxruntime itself needs 100 MiB and 0.1 s.
_TRIAL_MEMORY = 400 * 2**20
_TRIAL_CPU_SECONDS = 2
_TRIAL_TIMEOUT = 30.0


class OnnxActor(NetworkPolicy):
    """An actor that runs an ONNX file with the contents `data` on one thread.

    Raises:
        ValueError: If onnxruntime is missing, or the file is invalid or does not fit its task. The
            message is one line with `path`.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        self._session = _session(data, path)
        metadata = self._session.get_modelmeta().custom_metadata_map
        # Old files have version 1 and do not contain it.
        self.info: ActorInfo = parse_metadata({'format_version': '1', **metadata}, path)
        self.shape = self.info.shape
        self._check_sizes(path)

    def act(self, seen: NDArray[np.float32], goal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (..., action size) for observation `seen` and `goal`, (..., size) each."""
        flat = [part.reshape(-1, part.shape[-1]) for part in (seen, goal)]
        (action,) = self._session.run([OUTPUT], dict(zip(INPUTS, flat, strict=True)))
        return np.asarray(action, np.float32).reshape(*seen.shape[:-1], -1)

    def _check_sizes(self, path: Path) -> None:
        places = (*self._session.get_inputs(), *self._session.get_outputs())
        found = {place.name: place.shape[-1] if place.shape else None for place in places}
        wanted = {
            'observation': self.shape.observation_size,
            'desired_goal': self.info.goal_size,
            OUTPUT: self.info.action_size,
        }
        if found != wanted:
            raise ValueError(f'{path} has sizes {one_line(found)}; {self.info.task} has {wanted}')


def load_onnx(path: Path) -> LoadedPolicy:
    """Load an ONNX file as a policy.

    Raises:
        ValueError: If onnxruntime is missing, or the file is invalid or needs too much memory or
            time.
    """
    data = read_file(path)
    if _EXTERNAL.search(data):
        # onnxruntime would read them from the working directory; the SHA-256 would not cover them.
        raise ValueError(f'{path} keeps weights in other files; allowed: one file with all weights')
    _require_onnxruntime(path)
    _try_out(data, path)
    actor = OnnxActor(data, path)
    return loaded_actor(actor, actor.info, path, sha256(data))


def _require_onnxruntime(path: Path) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(f'{path.name} needs onnxruntime: pip install onnxruntime') from None
    return onnxruntime


def _session(data: bytes, path: Path) -> Any:
    onnxruntime = _require_onnxruntime(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(data, options, providers=['CPUExecutionProvider'])
    except Exception as error:
        # onnxruntime raises its own type for each kind of damage.
        raise ValueError(f'{path} is not a readable ONNX file: {one_line(error)}') from None


def _try_out(data: bytes, path: Path) -> None:
    """Run the ONNX file `data` in a process with limited memory and time; ValueError on failure."""
    # -P: do not import modules of the working directory.
    command = [sys.executable, '-P', '-m', __name__, str(path)]
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(p or os.getcwd() for p in sys.path)}
    try:
        trial = subprocess.run(
            command,
            input=data,
            capture_output=True,
            env=environment,
            timeout=_TRIAL_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ValueError(f'{path} cannot be tried: {one_line(error)}') from None
    if trial.returncode == 1:
        raise ValueError(one_line(trial.stderr.decode(errors='replace')))
    if trial.returncode != 0:
        raise ValueError(
            f'{path} needs more than {_TRIAL_MEMORY >> 20} MiB or {_TRIAL_CPU_SECONDS} s for one '
            f'observation, the largest values allowed (exit code {trial.returncode})'
        )


def _trial(path: Path) -> int:
    """Run the ONNX file on stdin once; return 0, or print an error with `path` and return 1."""
    data = sys.stdin.buffer.read()
    try:
        _require_onnxruntime(path)
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        seconds = int(used) + 1 + _TRIAL_CPU_SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_DATA, (_TRIAL_MEMORY, _TRIAL_MEMORY))
        actor = OnnxActor(data, path)
        sizes = (actor.shape.observation_size, actor.shape.goal_size)
        actor.predict({name: np.zeros(n) for name, n in zip(INPUTS, sizes, strict=True)})
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    except Exception as error:
        print(f'{path} does not run: {one_line(error)}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(_trial(Path(sys.argv[1])))
