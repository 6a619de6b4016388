"""Parameters of the nodes as data, checks of their values, and the help text of a node."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from msgs_spec.disturbances import read_disturbances
from msgs_spec.robots import LONGEST_JOINT_PREFIX, MODEL_PREFIX, check_joint_prefix
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    REWARD_TYPES,
    SUCCESS_RULES,
    TASKS,
    substeps_per_tick,
)
from msgs_spec.text import did_you_mean

Value = str | int | float | bool
# Prefixes of the parameters for the quality of service of ROS's own topics.
_ROS_QOS = tuple(f'qos_overrides./{name}.' for name in ('clock', 'parameter_events', 'rosout'))


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter of a node.

    Attributes:
        choices: Allowed strings; if empty, any string is allowed.
        or_zero: Whether 0 is allowed, too, although it is less than `lower`.
        read_only: Whether the value cannot change while the node runs.
        check: Raises ValueError for an invalid value of the right type and range.
        former: Former name of the parameter, which is accepted with a warning.
        is_path: Whether the node replaces `~` by the home directory, because no shell does this in
            `<name>:=<value>`.
    """

    name: str
    type: Literal['string', 'integer', 'double', 'bool']
    default: Value
    description: str
    choices: tuple[str, ...] = ()
    lower: float = -math.inf
    upper: float = math.inf
    or_zero: bool = False
    read_only: bool = True
    check: Callable[[Any], object] | None = None
    former: str = ''
    is_path: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values as text, for messages and help."""
        if self.choices:
            return ', '.join(repr(choice) for choice in self.choices)
        if self.type == 'bool':
            return 'true, false'
        if self.type == 'string':
            return 'text'
        limits = f'{self.lower:.10g} ... {self.upper:.10g}'
        kind = 'whole numbers ' if self.type == 'integer' else ''
        return f'0 or {limits}' if self.or_zero else f'{kind}{limits}'


LARGEST_SEED = 2**32 - 1

# N. Larger forces throw the robots apart.
LARGEST_PERTURBATION = 100.0
# Pixels.
LARGEST_PICTURE_SIDE = 4096

SIM_NODE = (
    ParameterSpec('task', 'string', 'FetchReach', 'Task to run.', choices=tuple(TASKS)),
    ParameterSpec(
        'seed',
        'integer',
        0,
        'Seed of the first episode. A later change sets the seed of the next episode; each further '
        'episode takes the next seed.',
        lower=0,
        upper=LARGEST_SEED,
        read_only=False,
    ),
    ParameterSpec(
        'episodes',
        'integer',
        0,
        'Episodes to run before the node exits; 0 runs for ever.',
        lower=0,
        upper=2**31 - 1,
    ),
    ParameterSpec(
        'reward_type',
        'string',
        'sparse',
        'Sparse: 0 at the goal, -1 elsewhere. Dense: minus the distance to the goal.',
        choices=REWARD_TYPES,
    ),
    ParameterSpec(
        'disturbances',
        'string',
        'none',
        'Delays, noise, other physics: a preset, hardware*0.5 or a YAML file; new values count '
        'from the next episode.',
        check=read_disturbances,
        read_only=False,
    ),
    ParameterSpec(
        'success_rule',
        'string',
        'gymnasium',
        'Success rule: that of Gymnasium-Robotics, or that of the paper.',
        choices=SUCCESS_RULES,
    ),
    ParameterSpec(
        'control_hz',
        'double',
        DEFAULT_CONTROL_HZ,
        'Ticks per simulated second, 500/n for n = 1 ... 40; seconds per episode and speeds stay '
        'equal.',
        lower=12.5,
        upper=500.0,
        check=substeps_per_tick,
    ),
    ParameterSpec(
        'mode',
        'string',
        'realtime',
        'Realtime: ticks follow the wall clock. Lockstep: each tick waits for a command.',
        choices=('realtime', 'lockstep'),
    ),
    ParameterSpec(
        'real_time_factor',
        'double',
        1.0,
        'Simulated seconds per second in mode realtime; 0 is as fast as possible.',
        # A slower robot looks like one that hangs.
        lower=0.01,
        upper=1000.0,
        or_zero=True,
        read_only=False,
    ),
    ParameterSpec(
        'command_timeout',
        'double',
        0.5,
        'Seconds without a command after which the robot holds; 0 never within an episode.',
        lower=0.0,
        upper=3600.0,
        read_only=False,
    ),
    ParameterSpec(
        'answer_wait',
        'double',
        0.0,
        'Milliseconds that a tick in mode realtime waits at most for the command that answers the '
        'last observation; 0 never waits.',
        # A robot that waits longer is in lockstep.
        lower=0.0,
        upper=1000.0,
        read_only=False,
    ),
    ParameterSpec(
        'joint_prefix',
        'string',
        MODEL_PREFIX,
        f'Prefix of the joint names, such as left_, up to {LONGEST_JOINT_PREFIX} characters; model '
        'keeps the names of the model, robot0:.',
        check=check_joint_prefix,
    ),
    ParameterSpec(
        'wait_for_commands',
        'bool',
        False,
        'Let the first episode wait for a publisher of commands.',
    ),
    ParameterSpec(
        'publish_clock',
        'bool',
        True,
        'Publish /clock; one robot per graph should.',
    ),
    ParameterSpec(
        'perturb_limit',
        'double',
        0.0,
        'Largest force, N, and ten times the largest torque, N m, that `perturb` may apply; 0 '
        'rejects all.',
        lower=0.0,
        upper=LARGEST_PERTURBATION,
    ),
    ParameterSpec(
        'episode_dir',
        'string',
        '',
        'Directory for episode logs; empty for no logs.',
        is_path=True,
    ),
    ParameterSpec(
        'log_compiled_model',
        'bool',
        True,
        'Store the compiled model, 3 MB, in each log, beside its MJCF text.',
    ),
)

POLICY_NODE = (
    ParameterSpec(
        'policy',
        'string',
        '',
        'File, module:function, random, resting, robust or a shipped policy; empty: that of the '
        'task.',
        read_only=False,
        former='checkpoint',
    ),
    ParameterSpec(
        'trust',
        'bool',
        False,
        'Load a .zip or module:function, which runs the code in it.',
    ),
    ParameterSpec(
        'task',
        'string',
        '',
        'Task to act in; empty takes the task of episode_status.',
        choices=('', *TASKS),
    ),
)


REPLAY_NODE = (
    ParameterSpec('path', 'string', '', 'Episode: bag directory or MCAP file.', is_path=True),
    ParameterSpec(
        'rate',
        'double',
        1.0,
        'Recorded seconds per second.',
        lower=0.01,
        upper=100.0,
        read_only=False,
    ),
    ParameterSpec('loop', 'bool', False, 'Start again at the end.', read_only=False),
    ParameterSpec('start_paused', 'bool', False, 'Wait for ~/pause with false.'),
    ParameterSpec('start_offset', 'double', 0.0, 'Recorded seconds to skip.', lower=0.0, upper=1e6),
    ParameterSpec(
        'topics', 'string', '', 'Topics to publish, separated by commas; empty for all published.'
    ),
    ParameterSpec('inputs', 'bool', False, 'Publish also the recorded commands and goals.'),
    ParameterSpec('wait_for_commands', 'bool', False, 'Wait for a publisher of commands.'),
    ParameterSpec('force', 'bool', False, 'Publish on topics that have another publisher already.'),
)

VISUALIZATION_NODE = (
    ParameterSpec('camera_width', 'integer', 640, 'Pixels.', lower=16, upper=LARGEST_PICTURE_SIDE),
    ParameterSpec('camera_height', 'integer', 480, 'Pixels.', lower=16, upper=LARGEST_PICTURE_SIDE),
    ParameterSpec(
        'camera_hz',
        'double',
        10.0,
        'Pictures per second while the camera has subscribers; 0 for none.',
        lower=0.0,
        upper=60.0,
    ),
)

NODES = {
    'sim_node': SIM_NODE,
    'policy_node': POLICY_NODE,
    'replay_node': REPLAY_NODE,
    'visualization_node': VISUALIZATION_NODE,
}


def episode_seed(first: int, episode: int) -> int:
    """Return the seed of the episode with this index, from 0; `first` is the seed of episode 0.

    Seed 0 follows `LARGEST_SEED`.
    """
    return (first + episode) % (LARGEST_SEED + 1)


def validate(spec: ParameterSpec, value: object) -> None:
    """Raise ValueError if a value is not allowed; the message names the allowed values."""
    if not _is_allowed(spec, value):
        hint = did_you_mean(str(value), spec.choices)
        if spec.type == 'string' and not spec.choices and isinstance(value, (int, float)):
            # ROS reads values as YAML, where 2026 is a number and off is false.
            hint = f'; a number or off is text in two pairs of quotes: "{spec.name}:=\'2026\'"'
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        kind = 'a number, ' if spec.type == 'double' and not is_number else ''
        raise ValueError(f'{spec.name}: {value!r:.80} given; allowed: {kind}{spec.allowed}{hint}')
    if spec.check is not None:
        spec.check(value)


def _is_allowed(spec: ParameterSpec, value: object) -> bool:
    if spec.type == 'bool':
        return isinstance(value, bool)
    if spec.type == 'string':
        return isinstance(value, str) and (not spec.choices or value in spec.choices)
    kinds = (int,) if spec.type == 'integer' else (int, float)
    if isinstance(value, bool) or not isinstance(value, kinds):
        return False
    # Comparisons reject NaN.
    return spec.lower <= value <= spec.upper or (spec.or_zero and value == 0)


def unknown_parameter(specs: Sequence[ParameterSpec], name: str) -> str | None:
    """Return a warning about a parameter that a node with the parameters `specs` does not have.

    Returns None for parameters of ROS and of any node in `NODES`, because several nodes often share
    a parameter file.
    """
    is_known = any(name in (spec.name, spec.former) for node in NODES.values() for spec in node)
    if is_known or name == 'use_sim_time' or name.startswith(_ROS_QOS):
        return None
    if name.startswith('qos_overrides.'):
        return f'{name} is ignored: the quality of service of all topics is fixed'
    # Misspelt former names lead to the present name.
    names = {known: spec.name for spec in specs for known in (spec.former, spec.name)}
    hint = did_you_mean(name, names)
    return f'unknown parameter {name!r}{hint or "; it is ignored"}'


def usage(node: str, summary: str) -> str:
    """Return the help text of a node; `summary` describes it in one line."""
    entries = [
        f'  {spec.name} ({spec.type}, default {spec.default!r}'
        f'{"" if spec.read_only else ", settable at run time"})\n'
        + textwrap.fill(
            f'{spec.description} Allowed: {spec.allowed}.',
            width=79,
            initial_indent=' ' * 6,
            subsequent_indent=' ' * 6,
        )
        for spec in NODES[node]
    ]
    return '\n'.join(
        [
            f'usage: {node} [--ros-args [-p NAME:=VALUE] [--params-file FILE] ...]',
            '',
            summary,
            '',
            'parameters:',
            *entries,
        ]
    )
