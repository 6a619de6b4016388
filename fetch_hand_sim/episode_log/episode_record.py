"""What the two metadata records of an episode say, typed; nothing else reads their text.

The text may be anybody's: a number is a number within its bounds, a word one of those allowed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from msgs_spec.disturbances import Disturbances
from msgs_spec.parameters import LARGEST_PERTURBATION
from msgs_spec.robots import JOINT_PREFIX, LONGEST_JOINT_PREFIX
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    REWARD_TYPES,
    SUCCESS_RULES,
    TASKS,
    TIMINGS,
    RewardType,
    SuccessRule,
    TaskSpec,
    Timing,
    substeps_per_tick,
    task_spec,
)
from msgs_spec.text import one_of

Strings = Mapping[str, str]
Number = TypeVar('Number', int, float)

# Seeds and numbers of episodes are parameters of a node and columns of a table: int64.
_LARGEST = 2**63 - 1
_SHOWN = 40


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """What an episode is: the record `episode`.

    Attributes:
        task: The task, with the joint names that its messages have, `episode_ticks` at 25 Hz.
        episode: Number of the episode in its run, from 0.
        seed: Seed of the reset.
        reward_type: 'sparse' or 'dense'.
        success_rule: 'gymnasium' or 'paper'.
        control_hz: Ticks per simulated second.
        joint_prefix: What the names of joints begin with.
        interface_version: What its messages mean, see `INTERFACE_VERSION`.
        perturb_limit: Largest force of a push, N; 0 where none was taken.
        timing: What stayed where the rate is not 25 Hz.
        disturbances: What was disturbed.
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
        """Reads the contents of the record.

        Raises:
            ValueError: If something is missing or not allowed; one line that names it.
        """
        return cls(
            task=parse_task(metadata),
            episode=_integer(metadata, 'episode'),
            seed=_integer(metadata, 'seed'),
            reward_type=one_of(_text(metadata, 'reward_type'), REWARD_TYPES, 'reward_type'),
            success_rule=one_of(_text(metadata, 'success_rule'), SUCCESS_RULES, 'success_rule'),
            control_hz=parse_control_hz(metadata),
            joint_prefix=_joint_prefix(metadata),
            interface_version=_integer(metadata, 'interface_version', default='1'),
            perturb_limit=_perturb_limit(metadata),
            timing=one_of(metadata.get('timing', 'ticks'), TIMINGS, 'timing'),
            disturbances=Disturbances.from_json(metadata.get('disturbances', '{}')),
        )

    @property
    def spec(self) -> TaskSpec:
        """The task with its usual joint names, `episode_ticks` as many as the episode has."""
        # Robots up to 1.0 took as many at every rate.
        rate = self.control_hz if self.timing == 'seconds' else DEFAULT_CONTROL_HZ
        return task_spec(self.task.name, control_hz=rate)


@dataclass(frozen=True, slots=True)
class EpisodeOutcome:
    """How an episode ended: the record `episode_result`. What it does not say is None.

    Attributes:
        is_complete: Whether the episode ran to its end.
        reason: Why it did not.
        steps: Steps taken.
        episode_return: Sum of rewards.
        is_success: Whether the goal was reached at the end.
        received_not_logged: Topics on which the robot received more than its log takes, and how
            many messages; empty if there were none.
    """

    is_complete: bool = True
    reason: str | None = None
    steps: int | None = None
    episode_return: float | None = None
    is_success: bool | None = None
    received_not_logged: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def parse(cls, result: Strings) -> EpisodeOutcome:
        """Reads the contents of the record."""
        is_complete = _flag(result.get('complete', '')) is True
        return cls(
            is_complete=is_complete,
            reason=None if is_complete else result.get('reason'),
            steps=_number_or_none(result.get('steps', ''), int),
            episode_return=_number_or_none(result.get('return', ''), float),
            is_success=_flag(result.get('success', '')),
            received_not_logged=_counts(result.get('received_not_logged', '')),
        )

    def to_strings(self) -> dict[str, str]:
        """Returns the contents of the record."""
        known = {
            'steps': None if self.steps is None else str(self.steps),
            'return': None if self.episode_return is None else repr(self.episode_return),
            'success': None if self.is_success is None else str(self.is_success).lower(),
            'complete': str(self.is_complete).lower(),
            'reason': self.reason,
            'received_not_logged': (
                json.dumps(self.received_not_logged) if self.received_not_logged else None
            ),
        }
        return {key: text for key, text in known.items() if text is not None}


class HasOutcome:
    """What is read of a file, with the text of its records; `outcome` is the second one, typed."""

    __slots__ = ()

    result: dict[str, str]

    @property
    def outcome(self) -> EpisodeOutcome:
        """How the episode ended."""
        return EpisodeOutcome.parse(self.result)

    @property
    def is_complete(self) -> bool:
        """Whether the episode ran to its end; False if it was interrupted."""
        return self.outcome.is_complete


def parse_task(metadata: Strings) -> TaskSpec:
    """Returns the task of an episode, with the joint names that its messages have.

    Raises:
        ValueError: If it is unknown.
    """
    name = _text(metadata, 'task')
    return task_spec(name if name in TASKS else name[:_SHOWN], _joint_prefix(metadata))


def parse_control_hz(metadata: Strings) -> float:
    """Returns the ticks per simulated second of an episode.

    Raises:
        ValueError: If it is no rate that the simulation has.
    """
    text = _text(metadata, 'control_hz')
    try:
        rate = float(text)
        substeps_per_tick(rate)
    except ValueError as error:
        raise ValueError(f'control_hz {text[:_SHOWN]!r}: {error}') from None
    return rate


def integer_or_none(metadata: Strings, name: str) -> int | None:
    """Returns a number of the record `episode`, None if it is missing or not allowed."""
    try:
        return _integer(metadata, name)
    except ValueError:
        return None


def _joint_prefix(metadata: Strings) -> str:
    prefix = metadata.get('joint_prefix', JOINT_PREFIX)
    if len(prefix) > LONGEST_JOINT_PREFIX:
        raise ValueError(
            f'joint_prefix of {len(prefix)} characters; allowed: {LONGEST_JOINT_PREFIX}'
        )
    return prefix


def _text(content: Strings, name: str) -> str:
    if name not in content:
        raise ValueError(f'{name} is missing')
    return content[name]


def _integer(content: Strings, name: str, default: str | None = None) -> int:
    text = _text({name: default, **content} if default is not None else content, name)
    value = _number_or_none(text, int)
    if value is None or not 0 <= value <= _LARGEST:
        raise ValueError(f'{name} {text[:_SHOWN]!r}; allowed: 0 ... {_LARGEST}')
    return value


def _perturb_limit(metadata: Strings) -> float:
    text = _text({'perturb_limit': '0', **metadata}, 'perturb_limit')
    value = _number_or_none(text, float)
    if value is None or not 0.0 <= value <= LARGEST_PERTURBATION:
        allowed = f'0 ... {LARGEST_PERTURBATION:g}'
        raise ValueError(f'perturb_limit {text[:_SHOWN]!r}; allowed: {allowed}')
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
    """A finite number, and no larger than int64; None for everything else."""
    try:
        value = kind(text)
    except ValueError:
        return None
    return value if abs(value) <= _LARGEST else None
