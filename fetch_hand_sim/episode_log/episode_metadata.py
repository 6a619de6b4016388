"""What makes an episode reproducible, as the strings of the metadata record `episode`."""

from __future__ import annotations

import json
import platform
from functools import cache
from importlib import metadata

from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, PHYSICS_TIMESTEP, TaskSpec

# What the messages of an episode mean. 1, which wrote no number: a robot ignored frame and stamp of
# a goal, and the orientations of `fingertip_poses` were identity.
INTERFACE_VERSION = 2

_PACKAGES = ('fetch_hand_sim', 'mujoco', 'numpy', 'gymnasium-robotics', 'mcap')


@cache
def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return 'unknown'


def episode_metadata(
    task: TaskSpec,
    *,
    episode: int,
    seed: int,
    reward_type: str,
    success_rule: str,
    control_hz: float,
    timing: str = 'seconds',
    joint_prefix: str = JOINT_PREFIX,
    model_sha256: str,
    source_revision: str | None = None,
    checkpoint_sha256: str | None = None,
    perturb_limit: float = 0.0,
    disturbances: str = '',
    variation: str = '',
    started: str | None = None,
) -> dict[str, str]:
    """Returns the contents of the record `episode`.

    Args:
        task: The task.
        episode: Number of the episode in this run, from 0; the number in the file name goes on over
            runs.
        seed: Seed of the reset.
        reward_type: 'sparse' or 'dense'.
        success_rule: 'gymnasium' or 'paper'.
        control_hz: Ticks per simulated second.
        timing: What stays at another rate than 25 Hz; recorded where it is another and `seconds`,
            because robots up to 1.0, which recorded nothing, kept `ticks`.
        joint_prefix: What the names of joints begin with; recorded where it is not the usual one.
        model_sha256: Fingerprint of the compiled model, see `model_sha256`.
        source_revision: Revision of this project, if known.
        checkpoint_sha256: Fingerprint of the actor that gives the commands, if known.
        perturb_limit: Largest force, N, by which the robot lets itself be pushed; recorded where it
            does at all, because such an episode is no plain one.
        disturbances: What is disturbed, JSON; recorded where something is.
        variation: What the episode drew from it, JSON; likewise.
        started: Wall-clock time of the start, ISO 8601. The one value that differs between equal
            runs; leave it out for files that are equal byte by byte.
    """
    in_seconds = timing == 'seconds' and control_hz != DEFAULT_CONTROL_HZ
    known = {
        'interface_version': str(INTERFACE_VERSION),
        'task': task.name,
        'episode': str(episode),
        'seed': str(seed),
        'reward_type': reward_type,
        'success_rule': success_rule,
        'control_hz': repr(float(control_hz)),
        'timing': timing if in_seconds else None,
        'physics_timestep_s': repr(PHYSICS_TIMESTEP),
        'episode_ticks': str(task.episode_ticks),
        'robot': task.robot.name,
        'joint_order': json.dumps(task.robot.joints),
        'joint_prefix': joint_prefix if joint_prefix != JOINT_PREFIX else None,
        'command_order': json.dumps([part.name for part in task.robot.command]),
        'model_sha256': model_sha256,
        'source_revision': source_revision,
        'checkpoint_sha256': checkpoint_sha256,
        'perturb_limit': repr(float(perturb_limit)) if perturb_limit else None,
        'disturbances': disturbances or None,
        'variation': variation or None,
        'started': started,
        'python_version': platform.python_version(),
        **{f'{package}_version': _version(package) for package in _PACKAGES},
    }
    return {key: value for key, value in known.items() if value is not None}
