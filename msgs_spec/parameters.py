"""Every parameter of the nodes as data, with what makes a value valid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TASKS, substeps_per_tick

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.parameter import Parameter

Value = str | int | float | bool


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter.

    Attributes:
        name: Its name.
        type: Its ROS type.
        default: Value where none is given.
        description: What it is for, with its unit.
        choices: Allowed strings; empty for any.
        lower: Smallest allowed number.
        upper: Largest allowed number.
        read_only: Whether it is fixed once the node runs.
        check: Raises ValueError for what type and limits cannot tell. It comes before ROS's own
            check of the limits, which are then left out of the descriptor.
    """

    name: str
    type: Literal['string', 'integer', 'double', 'bool']
    default: Value
    description: str
    choices: tuple[str, ...] = ()
    lower: float = -math.inf
    upper: float = math.inf
    read_only: bool = True
    check: Callable[[float], object] | None = None

    @property
    def allowed(self) -> str:
        """Allowed values as text."""
        if self.choices:
            return ', '.join(repr(choice) for choice in self.choices)
        if self.type in ('string', 'bool'):
            return 'any string' if self.type == 'string' else 'true, false'
        kind = 'an integer' if self.type == 'integer' else 'a number'
        return kind if math.isinf(self.upper) else f'{self.lower:.10g} ... {self.upper:.10g}'


_LARGEST_SEED = 2**32 - 1

_SMALLEST_FACTOR = 0.01


def _check_real_time_factor(value: float) -> None:
    """Raises ValueError for what is too slow to be told from a robot that hangs."""
    if 0.0 < value < _SMALLEST_FACTOR:
        raise ValueError(
            f'real_time_factor: {value!r} given; allowed: 0 or {_SMALLEST_FACTOR:g} ... 1000'
        )


SIM_NODE = (
    ParameterSpec('task', 'string', 'FetchReach', 'Task to run.', choices=tuple(TASKS)),
    ParameterSpec(
        'seed',
        'integer',
        0,
        'Seed of the first episode; each further episode takes the next one.',
        lower=0,
        upper=_LARGEST_SEED,
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
        choices=('sparse', 'dense'),
    ),
    ParameterSpec(
        'success_rule',
        'string',
        'gymnasium',
        'Success as the released code of the benchmark has it, or as the paper defines it.',
        choices=('gymnasium', 'paper'),
    ),
    ParameterSpec(
        'control_hz',
        'double',
        DEFAULT_CONTROL_HZ,
        'Ticks per simulated second, 500/n for n = 1 ... 40.',
        lower=12.5,
        upper=500.0,
        check=substeps_per_tick,
    ),
    ParameterSpec(
        'mode',
        'string',
        'realtime',
        'Realtime: ticks come with the clock. Lockstep: each tick waits for a command.',
        choices=('realtime', 'lockstep'),
    ),
    ParameterSpec(
        'real_time_factor',
        'double',
        1.0,
        'Simulated seconds per second in mode realtime; 0 is as fast as possible.',
        lower=0.0,
        upper=1000.0,
        read_only=False,
        check=_check_real_time_factor,
    ),
    ParameterSpec(
        'command_timeout',
        'double',
        0.5,
        'Seconds without a command after which the robot holds; 0 never.',
        lower=0.0,
        upper=3600.0,
        read_only=False,
    ),
    ParameterSpec(
        'wait_for_commands',
        'bool',
        False,
        'Whether the first episode waits until somebody publishes commands.',
    ),
    ParameterSpec(
        'publish_clock',
        'bool',
        True,
        'Whether to publish /clock; one robot per graph should.',
    ),
    ParameterSpec(
        'episode_dir',
        'string',
        '',
        'Directory for episode logs; empty logs nothing.',
    ),
    ParameterSpec(
        'log_compiled_model',
        'bool',
        True,
        'Whether each log carries the compiled model, 3 MB, beside its MJCF text.',
    ),
)

POLICY_NODE = (
    ParameterSpec(
        'checkpoint',
        'string',
        '',
        'Actor file (.safetensors, .onnx, .zip), random or resting; empty takes the shipped actor.',
    ),
    ParameterSpec(
        'task',
        'string',
        '',
        'Task to act in; empty waits for what episode_status says.',
        choices=('', *TASKS),
    ),
)


def validate(spec: ParameterSpec, value: object) -> None:
    """Checks a value; integers pass for doubles.

    Raises:
        ValueError: If it is not allowed; the message is one line and says what is.
    """
    if not _is_allowed(spec, value):
        raise ValueError(f'{spec.name}: {value!r} given; allowed: {spec.allowed}')


def _is_allowed(spec: ParameterSpec, value: object) -> bool:
    if spec.type == 'bool':
        return isinstance(value, bool)
    if spec.type == 'string':
        return isinstance(value, str) and (not spec.choices or value in spec.choices)
    kinds = (int,) if spec.type == 'integer' else (int, float)
    if isinstance(value, bool) or not isinstance(value, kinds):
        return False
    if spec.check is not None:
        spec.check(value)
    # NaN is not within any limits.
    return spec.lower <= value <= spec.upper


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Returns the ROS descriptor.

    Doubles are typed dynamically, because ROS takes `1` on a command line for an integer and would
    refuse it.
    """
    from rcl_interfaces.msg import (
        FloatingPointRange,
        IntegerRange,
        ParameterDescriptor,
        ParameterType,
    )

    result = ParameterDescriptor(
        name=spec.name,
        type=getattr(ParameterType, f'PARAMETER_{spec.type.upper()}'),
        description=spec.description,
        additional_constraints=f'allowed: {spec.allowed}' if spec.choices else '',
        read_only=spec.read_only,
        dynamic_typing=spec.type == 'double',
    )
    if spec.type == 'integer':
        limits = IntegerRange(from_value=int(spec.lower), to_value=int(spec.upper), step=1)
        result.integer_range = [limits]
    elif spec.type == 'double' and spec.check is None:
        limits = FloatingPointRange(from_value=spec.lower, to_value=spec.upper)
        result.floating_point_range = [limits]
    return result


def set_callback(
    specs: Iterable[ParameterSpec],
) -> Callable[[list[Parameter]], SetParametersResult]:
    """Returns the callback for `Node.add_on_set_parameters_callback` that checks new values.

    Parameters of other names pass: they belong to ROS.
    """
    from rcl_interfaces.msg import SetParametersResult

    by_name = {spec.name: spec for spec in specs}

    def check(parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name in by_name:
                    validate(by_name[parameter.name], parameter.value)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    return check
