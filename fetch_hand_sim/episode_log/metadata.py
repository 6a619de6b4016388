"""Write and parse the two metadata records of an episode, `episode` and `episode_result`.

Files may come from unknown sources. So parsing accepts only numbers within bounds, and only known
names of tasks, reward types, success rules and timings.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import TypeVar

from msgs_spec.disturbances import Disturbances
from msgs_spec.parameters import LARGEST_PERTURBATION
from msgs_spec.robots import JOINT_PREFIX, check_joint_prefix
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    PHYSICS_TIMESTEP,
    REWARD_TYPES,
    SUCCESS_RULES,
    TIMINGS,
    RewardType,
    SuccessRule,
    TaskSpec,
    Timing,
    substeps_per_tick,
    task_spec,
)
from msgs_spec.text import one_of
from msgs_spec.topics import INTERFACE_VERSION

Strings = Mapping[str, str]
Number = TypeVar('Number', int, float)

# End reason of an episode that was cut off, in its recovered file.
RECOVERED = 'cut off, recovered later'
# End reason of an episode whose simulation diverged; its last tick is the state after the reset.
DIVERGED = 'diverged'
# Seeds and numbers of episodes are parameters of a node and columns of a table: int64.
_LARGEST = 2**63 - 1
_SHOWN = 40


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """Contents of the metadata record `episode`.

    Attributes:
        task: The task with the joint names of the messages and `episode_ticks` at 25 Hz.
        episode: Number of the episode in its run, from 0.
        control_hz: Ticks per simulated second.
        interface_version: Version of the messages, see `msgs_spec.topics.INTERFACE_VERSION`.
        perturb_limit: Largest force of a push, N; 0 if pushes were off.
        timing: What stays the same at rates other than 25 Hz: duration and gripper speed
            (`seconds`), or number of ticks and gripper motion per tick (`ticks`).
    """

    task: TaskSpec
    episode: int
    seed: int
    reward_type: RewardType
    success_rule: SuccessRule
    control_hz: float
    joint_prefix: str
    interface_version: int
    perturb_limit: float = 0.0
    timing: Timing = 'seconds'
    disturbances: Disturbances = field(default_factory=Disturbances)

    @classmethod
    def parse(cls, metadata: Strings) -> EpisodeRecord:
        """Parse the contents of the record; a ValueError names a missing or invalid value."""
        metadata = {'interface_version': '1', 'perturb_limit': '0', **metadata}
        return cls(
            task=parse_task(metadata),
            episode=_number(metadata, 'episode', int),
            seed=_number(metadata, 'seed', int),
            reward_type=one_of(_text(metadata, 'reward_type'), REWARD_TYPES, 'reward_type'),
            success_rule=one_of(_text(metadata, 'success_rule'), SUCCESS_RULES, 'success_rule'),
            control_hz=parse_control_hz(metadata),
            joint_prefix=_joint_prefix(metadata),
            interface_version=_number(metadata, 'interface_version', int),
            perturb_limit=_number(metadata, 'perturb_limit', float, LARGEST_PERTURBATION),
            timing=one_of(metadata.get('timing', 'ticks'), TIMINGS, 'timing'),
            disturbances=Disturbances.from_json(metadata.get('disturbances', '{}')),
        )

    @property
    def spec(self) -> TaskSpec:
        """The task with its default joint names and the `episode_ticks` of the episode."""
        # Robots up to 1.0 took the same number of ticks at every rate.
        rate = self.control_hz if self.timing == 'seconds' else DEFAULT_CONTROL_HZ
        return task_spec(self.task.name, control_hz=rate)


@dataclass(frozen=True, slots=True)
class EpisodeOutcome:
    """Contents of the metadata record `episode_result`; missing values are None.

    Attributes:
        is_complete: Whether the episode ran to its last step; False if the file lacks it.
        received_not_logged: Number of received messages, by topic, that the limits of a file left
            out; `<topic> (refused)` counts those that the robot had rejected. {} if none.
        late_commands: Steps whose command was not computed from the observation right before; None
            in lockstep, in generated episodes and in files of interface version 1.
    """

    is_complete: bool = True
    reason: str | None = None
    steps: int | None = None
    episode_return: float | None = None
    is_success: bool | None = None
    received_not_logged: Mapping[str, int] = field(default_factory=dict)
    late_commands: int | None = None

    @classmethod
    def parse(cls, result: Strings) -> EpisodeOutcome:
        """Parse the contents of the outcome record; missing and invalid numbers become None."""
        is_complete = _flag(result.get('complete', '')) is True
        return cls(
            is_complete=is_complete,
            reason=None if is_complete else result.get('reason'),
            steps=_number_or_none(result.get('steps', ''), int),
            episode_return=_number_or_none(result.get('return', ''), float),
            is_success=_flag(result.get('success', '')),
            received_not_logged=_counts(result.get('received_not_logged', '')),
            late_commands=_number_or_none(result.get('late_commands', ''), int),
        )

    def to_strings(self) -> dict[str, str]:
        """Return the contents of the record, without missing values."""
        values = {
            'steps': self.steps,
            'return': self.episode_return,
            'success': self.is_success,
            'late_commands': self.late_commands,
            'complete': self.is_complete,
            'received_not_logged': self.received_not_logged or None,
        }
        known = {key: json.dumps(value) for key, value in values.items() if value is not None}
        return known if self.reason is None else {**known, 'reason': self.reason}


class HasOutcome:
    """Base of classes whose attribute `result` is the record `episode_result` as strings."""

    __slots__ = ()

    result: dict[str, str]

    @property
    def outcome(self) -> EpisodeOutcome:
        """The parsed record `episode_result`: how the episode ended."""
        return EpisodeOutcome.parse(self.result)

    @property
    def is_complete(self) -> bool:
        """True if the episode ran to its last step, False if it was interrupted or diverged."""
        return self.outcome.is_complete


def parse_task(metadata: Strings) -> TaskSpec:
    """Return the task with the joint names of the messages; ValueError if a value is invalid."""
    return task_spec(_text(metadata, 'task'), _joint_prefix(metadata))


def parse_control_hz(metadata: Strings) -> float:
    """Return the ticks per simulated second; ValueError if missing or not supported."""
    text = _text(metadata, 'control_hz')
    try:
        rate = float(text)
        substeps_per_tick(rate)
    except ValueError as error:
        raise ValueError(f'control_hz {text[:_SHOWN]!r}: {error}') from None
    return rate


def integer_or_none(metadata: Strings, name: str) -> int | None:
    """Return the value `name` of the record `episode`; None unless an integer 0 ... 2**63 - 1."""
    try:
        return _number(metadata, name, int)
    except ValueError:
        return None


def _joint_prefix(metadata: Strings) -> str:
    prefix = metadata.get('joint_prefix', JOINT_PREFIX)
    check_joint_prefix(prefix)
    return prefix


def _text(content: Strings, name: str) -> str:
    if name not in content:
        raise ValueError(f'{name} is missing')
    return content[name]


def _number(content: Strings, name: str, kind: type[Number], highest: float = _LARGEST) -> Number:
    text = _text(content, name)
    value = _number_or_none(text, kind)
    if value is None or not 0 <= value <= highest:
        raise ValueError(f'{name} {text[:_SHOWN]!r}; allowed: 0 ... {highest}')
    return value


def _counts(text: str) -> dict[str, int]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    if not isinstance(content, dict):
        return {}
    return {name: count for name, count in content.items() if isinstance(count, int)}


def _flag(text: str) -> bool | None:
    return {'true': True, 'false': False}.get(text)


def _number_or_none(text: str, kind: type[Number]) -> Number | None:
    """Return the number in a text; None for other text and beyond +-(2**63 - 1)."""
    try:
        value = kind(text)
    except ValueError:
        return None
    return value if abs(value) <= _LARGEST else None


# Writing


_PACKAGES = ('fetch_hand_sim', 'mujoco', 'numpy', 'gymnasium-robotics', 'mcap')


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
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
    """Return the contents of the record `episode`.

    Args:
        episode: Number of the episode in this run, from 0; file names count over all runs.
        timing: See `EpisodeRecord`. Recorded only if it is `seconds` and the rate is not 25 Hz;
            files without it, such as those of version 1.0, are read as `ticks`.
        joint_prefix: Recorded only if it is not the default.
        model_sha256: Hash of the compiled model, see `recorder.model_sha256`.
        perturb_limit: Largest force of a push, N; recorded only if pushes are on.
        disturbances: Disturbances of the robot, JSON, or ''.
        variation: Values drawn from the disturbances for this episode, JSON, or ''.
        started: Wall-clock time of the start, ISO 8601. Without it, equal runs give equal files.
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
