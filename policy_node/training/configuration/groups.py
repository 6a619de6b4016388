"""Learners, rewards and what studies add to them: a group exists only where it is switched on.

`marks` are the flat fields that stand for a group: `condition=threshold` selects `Threshold`. A
group without marks is selected by its first field, where that differs from its default.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class Range:
    """Least and largest value of a number."""

    low: float
    high: float = math.inf

    def __str__(self) -> str:
        if self.high == math.inf:
            return f'{_number(self.low)} or more'
        return f'{_number(self.low)} ... {_number(self.high)}'


# Floats represent all whole numbers up to here.
LARGEST = 2**53

Share = Annotated[float, Range(0, 1)]
Below1 = Annotated[float, Range(0, 1 - 1e-6)]
Total = Annotated[int, Range(0)]
Count = Annotated[int, Range(0, 1024)]


class Checked:
    """A group of fields whose values are of their types and within their ranges.

    Attributes:
        marks: Flat fields, with their values, that a configuration with this group has.
    """

    __slots__ = ()
    marks: typing.ClassVar[dict[str, Any]] = {}

    def __post_init__(self) -> None:
        """Checks all fields.

        Raises:
            ValueError: One line names the field, its value and the allowed ones.
        """
        for name, kind in types_of(type(self)).items():
            require_within(name, getattr(self, name), kind)


_TYPES: dict[type, dict[str, Any]] = {}


def types_of(group: type) -> dict[str, Any]:
    """Return the annotated types of the fields of a group, by name."""
    if group not in _TYPES:
        _TYPES[group] = _find_types(group)
    return _TYPES[group]


def _find_types(group: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(group, include_extras=True)
    return {each.name: hints[each.name] for each in dataclasses.fields(group)}


def range_of(kind: Any) -> Range | None:
    """Return the range of an annotated number, or None."""
    return kind.__metadata__[0] if typing.get_origin(kind) is Annotated else None


def choices_of(kind: Any) -> tuple[str, ...]:
    """Return the values of a literal type; of any other none."""
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


def plain_type(kind: Any) -> Any:
    """Return a type without its range; a literal is a `str`."""
    if typing.get_origin(kind) is Annotated:
        return typing.get_args(kind)[0]
    return str if choices_of(kind) else kind


def require_within(name: str, value: Any, kind: Any) -> None:
    """Reject a value that the type of its field does not allow.

    Raises:
        ValueError: One line names the field, the value and the allowed ones.
    """
    choices, limits = choices_of(kind), range_of(kind)
    if choices and value not in choices:
        raise ValueError(f'{name} {value!r:.80}; allowed: {", ".join(choices)}')
    if plain_type(kind) is int and abs(value) > LARGEST:
        raise ValueError(f'{name} is too large; allowed: up to {LARGEST}')
    if plain_type(kind) is float and not math.isfinite(value):
        raise ValueError(f'{name} {value} is no finite number')
    if limits and not limits.low <= value <= limits.high:
        raise ValueError(f'{name} {value}; allowed: {limits}')


def typed(name: str, value: Any, kind: Any) -> Any:
    """Return a value of Python or JSON with the type of its field.

    Scalars of NumPy count as Python's, lists as tuples, whole numbers as floats.

    Raises:
        ValueError: If it has another type.
    """
    plain, origin = plain_type(kind), typing.get_origin(plain_type(kind))
    if origin is tuple and isinstance(value, list | tuple):
        part = typing.get_args(plain)[0]
        return tuple(typed(name, each, part) for each in value)
    if origin is dict and isinstance(value, dict):
        return {str(key): typed(name, each, float) for key, each in value.items()}
    value = value.item() if isinstance(value, np.generic) else value
    if plain is float and type(value) is int and abs(value) <= LARGEST:
        return float(value)
    if type(value) is not plain:
        raise ValueError(f'{name} {value!r:.80} is not of type {type_name(plain)}')
    return value


def type_name(kind: Any) -> str:
    """Return the name of a type for messages."""
    return str(kind) if isinstance(kind, types.GenericAlias) else str(kind.__name__)


def _number(value: float) -> str:
    """Return a limit as text; a whole one to its last digit."""
    return f'{value:.6g}' if isinstance(value, float) else str(value)


@dataclass(frozen=True, slots=True)
class Sparse(Checked):
    """-1 until success, then 0."""

    first_distance: Annotated[float, Range(1, 1000)] = 1.0
    """Factor on the task's success distance at the start of the run; it falls geometrically to 1
    over the first two thirds. Coarse goals, which are met often, come first."""
    first_rotation: Annotated[float, Range(1, 1000)] = 1.0
    """The same for the task's success rotation."""
    reward_grades: tuple[float, ...] = ()
    """Rising multiples of the success thresholds, as `.5,1,2,4`. The reward of training becomes the
    share of them that the distance meets, times that of the rotation, minus 1."""

    marks: ClassVar[dict[str, Any]] = {'reward_type': 'sparse'}

    @property
    def narrows(self) -> bool:
        """True if goals are easier to meet at the start of a run than at its end."""
        return self.first_distance != 1.0 or self.first_rotation != 1.0


@dataclass(frozen=True, slots=True)
class Dense(Checked):
    """The negative distance."""

    marks: ClassVar[dict[str, Any]] = {'reward_type': 'dense'}


@dataclass(frozen=True, slots=True)
class Exploration(Checked):
    """Noise on collected actions."""

    random_epsilon: Share = 0.3
    """Probability of a uniformly random action."""
    noise_std: Annotated[float, Range(0)] = 0.2
    """Standard deviation of the Gaussian noise on other actions."""
    final_exploration: Share = 1.0
    """Share of `random_epsilon` and `noise_std` left at `total_steps`; both fall linearly in
    the last third of the run. 1 keeps them constant."""
    noise_seconds: Annotated[float, Range(0, 10)] = 0.0
    """Seconds for which noise and random actions hold; 0 is one tick."""
    parameter_noise: bool = False
    """Noise on weights, which moves actions by `noise_std`, instead of noise on actions."""

    def noise_ticks(self, control_hz: float) -> int:
        """Return the number of ticks for which noise holds."""
        return max(round(self.noise_seconds * control_hz), 1)


@dataclass(frozen=True, slots=True)
class Critics(Checked):
    """Networks that values come from."""

    critics: Annotated[int, Range(1, 100)] = 1
    """Critics that start differently; the actor follows their mean."""
    aggregate: Literal['mean', 'min', 'truncated'] = 'mean'
    """Target from several critics; `truncated` is the mean without the highest."""
    norm: Literal['none', 'layer', 'batch'] = 'none'
    """Normalisation of the critic's hidden layers; `batch` as CrossQ, without target networks.
    `layer_norm` is for both networks."""
    quantiles: Annotated[int, Range(1, 1000)] = 1
    """Quantiles of the return that each critic learns; 1 is its mean. Targets take all of them
    (`mean`) or leave out the highest 2 in 25 (`truncated`: TQC, arXiv 2005.04269)."""


@dataclass(frozen=True, slots=True)
class Learner(Checked):
    """Fields of every learner."""

    batch_size: Annotated[int, Range(1, 1_000_000)] = 1024
    """Transitions per update."""
    updates_per_cycle: Annotated[int, Range(0, 100_000)] = 40
    """Gradient updates after each cycle."""
    learning_rate: Share = 1e-3
    """Adam step size of actor and critic."""
    final_learning_rate: Share = 1.0
    """Share of `learning_rate` left at `total_steps`, falling linearly; 1 keeps it constant. The
    network that imagines subgoals keeps the whole."""
    actor_average: Below1 = 0.0
    """Share of an average of actor weights kept each cycle. The average is evaluated and saved. 0
    evaluates the actor itself."""
    gamma: Below1 = 0.98
    """Discount. Targets are clipped to [-1/(1-gamma), 0], as in the paper's code, with dense
    rewards too, although these lie below -1 far from the goal."""
    action_l2: Annotated[float, Range(0)] = 1.0
    """Weight of the mean squared action in the actor loss."""
    critic_first: Total = 0
    """Updates of the critics before the actor learns too. 0 is 5,000 where `init_from` gives an
    actor without its critic or fewer than `critics`, else none."""


@dataclass(frozen=True, slots=True)
class OffPolicy(Learner):
    """Learners with a replay and target networks."""

    polyak: Share = 0.95
    """Share of the old target network kept by a target update."""
    target_update_interval: Annotated[int, Range(1)] = 40
    """Updates between target updates."""
    policy_delay: Annotated[int, Range(1, 1000)] = 1
    """Updates of the critic for each of the actor (TD3, arXiv 1802.09477); 2 takes three quarters
    of the time."""
    target: Literal['polyak', 'none'] = 'polyak'
    """Networks of the targets: `polyak` (slow copies) or `none` (the learning networks)."""
    discount: Literal['tick', 'time'] = 'tick'
    """Unit of `gamma`: a `tick`, or `time`: 40 ms at any rate. The reward of a tick is then
    multiplied by its share of 40 ms, so that values are equal at every rate."""
    exploration: Exploration = Exploration()
    critic: Critics = Critics()


@dataclass(frozen=True, slots=True)
class OneStep(Checked):
    """Values of one step, for the task's goals alone."""


@dataclass(frozen=True, slots=True)
class Returns(Checked):
    """Returns of several steps."""

    n_step: Annotated[int, Range(1, 100)] = 1
    """Most steps of a return before it bootstraps."""
    correction: Literal['none', 'lambda', 'cut'] = 'none'
    """Correction of longer returns, whose actions are not the actor's: `lambda` (their mean is the
    truncated lambda-return) or `cut` (they end before an action far from the actor's)."""
    trace: Below1 = 0.7
    """With `lambda`, the probability of going on after each step; with `ppo` its lambda."""


@dataclass(frozen=True, slots=True)
class Held(Checked):
    """Actions with a length."""

    longest_hold: Annotated[int, Range(1, 1000)] = 1
    """Most ticks for which the actor holds an action while it collects; above 1 it learns how
    long. The evaluated and saved actor decides at every tick."""


@dataclass(frozen=True, slots=True)
class Advantages(Checked):
    """Values of states and advantages of actions apart."""

    advantage: bool = False
    """Critics learn values of states and advantages per 40 ms (DAU) instead of action values."""


@dataclass(frozen=True, slots=True)
class Threshold(Checked):
    """Values for a success threshold as well."""

    widest_threshold: Annotated[float, Range(1, 10_000)] = 8.0
    """Largest threshold of `condition=threshold`, in those of success. It should reach from the
    start of episodes to their goals."""

    marks: ClassVar[dict[str, Any]] = {'condition': 'threshold'}


@dataclass(frozen=True, slots=True)
class Horizon(Checked):
    """Values for a number of steps left as well."""

    marks: ClassVar[dict[str, Any]] = {'condition': 'horizon'}


@dataclass(frozen=True, slots=True)
class Density(Checked):
    """Importance weights in the critic's loss, which remove the bias of hindsight."""

    marks: ClassVar[dict[str, Any]] = {'importance': 'density'}


@dataclass(frozen=True, slots=True)
class Chosen(Checked):
    """The best of several future goals."""

    goal_choice: Literal['uniform', 'bellman', 'uncertain'] = 'uniform'
    """Choice among 8 future goals: `uniform` (any), `bellman` (largest error of the value) or
    `uncertain` (largest difference between critics)."""


@dataclass(frozen=True, slots=True)
class Imagined(Checked):
    """Subgoals that the actor only imagines."""

    subgoal_prior: Annotated[float, Range(0)] = 0.0
    """Weight in the actor loss of the distance between its actions and those for an imagined
    subgoal, halfway to the goal by value; 0 imagines none."""
    imagination_interval: Annotated[int, Range(1, 1000)] = 1
    """Actor updates for each update of the network that imagines subgoals, which costs almost as
    much as one of actor and critic."""


@dataclass(frozen=True, slots=True)
class Drop(Checked):
    """Ticks after an object fell."""

    ticks_after_drop: Annotated[int, Range(-1)] = -1
    """Ticks after an object fell off the palm that are still learnt from; -1 is all."""
    drop_is_lost: bool = False
    """With `ticks_after_drop`, every tick after the last of them counts -1. Otherwise the learner
    never sees that a drop is final."""


@dataclass(frozen=True, slots=True)
class Ddpg(OffPolicy):
    """Deep deterministic policy gradient with hindsight."""

    values: OneStep | Returns | Held | Advantages | Threshold | Horizon | Density | Chosen = (
        OneStep()
    )
    imagined: Imagined | None = None
    drop: Drop | None = None

    marks: ClassVar[dict[str, Any]] = {'algorithm': 'ddpg'}


@dataclass(frozen=True, slots=True)
class Hierarchical(OffPolicy):
    """Two levels of DDPG."""

    subgoal_every: Annotated[int, Range(0, 1000)] = 0
    """Ticks for which a subgoal holds that a second, high level proposes to the actor while it
    collects; 0 has none. The evaluated and saved actor is given the goal itself."""


@dataclass(frozen=True, slots=True)
class Ppo(Learner):
    """Proximal policy optimisation: each cycle's episodes once, also for goals in hindsight."""

    noise_std: Annotated[float, Range(1e-6)] = 0.2
    importance: Literal['none', 'decision'] = 'none'
    """Weights of transitions: `decision` (with `ppo`) corrects that actions of a replayed episode
    were for another goal; `density` (with `ddpg`), in the critic's loss, that a goal in hindsight
    depends on where the transition led."""
    trace: Below1 = 0.7
    first_value: Annotated[float, Range(-1_000_000, 0)] = 0.0
    """Value that the critic of `ppo` starts with. With -1 / (1 - gamma), the value of failing for
    ever, no state looks good because it is new."""
    first_action_gain: Share = 1.0
    """Factor on the last layer of the actor of `ppo` at the start: near 0 it begins with noise
    around no action, with any seed."""

    marks: ClassVar[dict[str, Any]] = {'algorithm': 'ppo', 'random_epsilon': 0.0}

    @property
    def exploration(self) -> Exploration:
        """The noise of the policy."""
        return Exploration(random_epsilon=0.0, noise_std=self.noise_std)


@dataclass(frozen=True, slots=True)
class Imitation(Learner):
    """Imitate the policy in `init_from` on true states (DAgger)."""

    value_weight: Annotated[float, Range(0, 1000)] = 0.0
    """Weight of the value that an action loses against the action of the imitated policy, by its
    critic. It is added to the mean squared difference of the actions."""
    disturbance_scales: tuple[float, ...] = (1.0,)
    """Factors on `disturbances`, one for each cycle of collecting in turn."""

    marks: ClassVar[dict[str, Any]] = {'algorithm': 'imitation'}

    @property
    def exploration(self) -> Exploration:
        """No noise: the imitating policy acts."""
        return Exploration(random_epsilon=0.0, noise_std=0.0)
