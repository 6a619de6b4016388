"""The configuration of a training run: its fields in groups, and the rules between them.

Each class above `TrainConfig` is one group of fields, and `TrainConfig` inherits all of them. The
values that users set are parsed in `flat.py`.
"""

from __future__ import annotations

import ast
import inspect
import math
import sys
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, Literal

from msgs_spec.disturbances import read_disturbances
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, GoalKind, TaskSpec, task_spec
from policy_node.policies.checkpoint import MOST_PAST_ACTIONS
from policy_node.policies.goal_features import goal_features


@dataclass(frozen=True, slots=True)
class Range:
    """Smallest and largest allowed value of a number, both included."""

    low: float
    high: float = math.inf

    def __str__(self) -> str:
        low, high = (f'{n:.6g}' if isinstance(n, float) else str(n) for n in (self.low, self.high))
        return f'{low} or more' if self.high == math.inf else f'{low} ... {high}'


# Floats represent all whole numbers up to here.
LARGEST = 2**53
# Largest width of a hidden layer.
MOST_UNITS = 65_536

Share = Annotated[float, Range(0, 1)]
Below1 = Annotated[float, Range(0, 1 - 1e-6)]
Total = Annotated[int, Range(0)]
Count = Annotated[int, Range(0, 1024)]


@dataclass(frozen=True, kw_only=True)
class Start:
    """Settings of the run: task, recipe, seed and algorithm."""

    task: str
    """Task name, `FetchReach`, ..."""
    recipe: Literal['paper', 'best', 'robust', 'finetune'] = 'best'
    """Recipe of the values, for the record."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of weights, exploration, relabelling and resets."""
    algorithm: Literal['ddpg', 'ppo', 'imitation'] = 'ddpg'
    """`ddpg`, `ppo` (on policy: each cycle once, also with goals in hindsight) or `imitation` of
    the policy in `init_from`, which sees the true state."""


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Settings of the simulations that collect episodes."""

    num_envs: Annotated[int, Range(1, 100_000)] = 64
    """Simulations stepped together; each cycle collects one episode of each."""
    control_hz: float = DEFAULT_CONTROL_HZ
    """Action frequency, Hz. All fields that count steps count ticks at this rate."""
    success_rule: Literal['gymnasium', 'paper'] = 'gymnasium'
    """Success rule behind the sparse reward."""
    disturbances: str = ''
    """Disturbances of the simulated robot: a preset, `hardware*0.5`, a file or JSON."""
    gamble: bool = False
    """The idle gripper action above .9 moves the achieved goal to a random place and freezes the
    episode (FetchReach, FetchPush): the paper's own counterexample to hindsight."""


@dataclass(frozen=True, kw_only=True)
class Goals:
    """Settings of rewards and hindsight goals."""

    reward_type: Literal['sparse', 'dense'] = 'sparse'
    """`sparse` (-1 until success, then 0) or `dense` (negative distance)."""
    first_distance: Annotated[float, Range(1, 1000)] = 1.0
    """Factor on the task's success distance at the start of the run; it falls geometrically to 1
    over the first two thirds. Coarse goals, which are met often, come first."""
    first_rotation: Annotated[float, Range(1, 1000)] = 1.0
    """The same for the task's success rotation."""
    reward_grades: tuple[float, ...] = ()
    """Rising multiples of the success thresholds, as `.5,1,2,4`. The reward of training becomes the
    share of them that the distance meets, times that of the rotation, minus 1."""
    strategy: Literal['final', 'future', 'episode', 'random', 'futureactual', 'none'] = 'future'
    """Where hindsight goals come from: the same episode (`final`, `future`, `episode`), any episode
    (`random`), or half each `future` and desired goals of other episodes (`futureactual`). `none`
    is without hindsight."""
    hindsight_k: Annotated[int, Range(1, 1000)] = 4
    """Replaced goals for each goal kept: k/(k+1) of a batch is relabelled. With `ppo` also the
    number of goals of each episode."""
    goals: dict[str, float] = field(default_factory=dict)
    """Mixture of goal sources instead of `strategy`: `future=.4,actual=.3`. The rest keeps its
    goal. Also `actual` (desired goals of other episodes), `displaced` (near the goal achieved at
    the start of the transition) and, with `ppo`, `outcome` (achieved by other episodes)."""
    goal_choice: Literal['uniform', 'bellman', 'uncertain'] = 'uniform'
    """Choice among 8 future goals: `uniform` (any), `bellman` (largest error of the value) or
    `uncertain` (largest difference between critics)."""


@dataclass(frozen=True, kw_only=True)
class Network:
    """Settings of the networks of actor and critic."""

    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Width of each hidden layer of actor and critic."""
    layer_norm: bool = False
    """LayerNorm in hidden layers of actor and critic."""
    goal_features: Literal['plain', 'relative', 'symmetric'] = 'plain'
    """Inputs: `plain` (observation and goal), `relative` (also the difference to the goal) or
    `symmetric` (equivalent poses are equal; of the goal only the difference)."""
    past_actions: Annotated[int, Range(0, MOST_PAST_ACTIONS)] = 0
    """Number of past actions that the networks see."""
    init_from: str = ''
    """Networks and normalisers to start from: a run folder, a shipped actor or an actor file.
    Without it, weights are random."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Settings of the replay and of the episodes to learn from."""

    replay_transitions: Annotated[int, Range(1)] = 1_000_000
    """Capacity of the replay."""
    learning_starts: Total = 0
    """Steps in the replay before the first update."""
    kept_transitions: Total = 300_000
    """Newest transitions stored beside the training state for `--resume`."""
    moved_share: Share = 0.0
    """Share of a batch from episodes whose achieved goal moved; 0 draws uniformly. The landing of a
    `gamble` is no motion."""
    ticks_after_drop: Annotated[int, Range(-1)] = -1
    """Ticks after an object fell off the palm that are still learnt from; -1 is all."""
    drop_is_lost: bool = False
    """With `ticks_after_drop`, every tick after the last of them counts -1. Otherwise the learner
    never sees that a drop is final."""


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Settings of the gradient updates."""

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
    start_share: Below1 = 0.0
    """Share of the weights from `init_from` in the evaluated and saved actor; it keeps part of what
    they did (WiSE-FT, arXiv 2109.01903). The training does not change."""
    gamma: Below1 = 0.98
    """Discount. Targets are clipped to [-1/(1-gamma), 0], as in the paper's code, with dense
    rewards too, although these lie below -1 far from the goal."""
    action_l2: Annotated[float, Range(0)] = 1.0
    """Weight of the mean squared action in the actor loss."""
    critic_first: Total = 0
    """Updates of the critics before the actor learns too. 0 is 5,000 where `init_from` gives an
    actor without its critic or fewer than `critics`, else none."""
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


@dataclass(frozen=True, kw_only=True)
class Exploration:
    """Settings of the exploration noise."""

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


@dataclass(frozen=True, kw_only=True)
class Critics:
    """Settings of the critics: number, normalisation and quantiles."""

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


@dataclass(frozen=True, kw_only=True)
class Values:
    """Settings of the returns and values that the critics learn."""

    n_step: Annotated[int, Range(1, 100)] = 1
    """Most steps of a return before it bootstraps."""
    correction: Literal['none', 'lambda', 'cut'] = 'none'
    """Correction of longer returns, whose actions are not the actor's: `lambda` (their mean is the
    truncated lambda-return) or `cut` (they end before an action far from the actor's)."""
    trace: Below1 = 0.7
    """With `lambda`, the probability of going on after each step; with `ppo` its lambda."""
    longest_hold: Annotated[int, Range(1, 1000)] = 1
    """Most ticks for which the actor holds an action while it collects; above 1 it learns how
    long. The evaluated and saved actor decides at every tick."""
    advantage: bool = False
    """Critics learn values of states and advantages per 40 ms (DAU) instead of action values."""
    condition: Literal['none', 'threshold', 'horizon'] = 'none'
    """An input more for actor and critic: `threshold` (log-uniform, .5 ... `widest_threshold` times
    that of success, also in the reward) or `horizon` (steps left, whose rewards are the value). The
    actor acts at the threshold of the task and with a whole episode left."""
    widest_threshold: Annotated[float, Range(1, 10_000)] = 8.0
    """Largest threshold of `condition=threshold`, in those of success. It should reach from the
    start of episodes to their goals."""
    importance: Literal['none', 'density', 'decision'] = 'none'
    """Weights of transitions: `decision` (with `ppo`) corrects that actions of a replayed episode
    were for another goal; `density` (with `ddpg`), in the critic's loss, that a goal in hindsight
    depends on where the transition led."""


@dataclass(frozen=True, kw_only=True)
class Subgoals:
    """Settings of subgoals, imagined or proposed by a second, high-level policy."""

    subgoal_prior: Annotated[float, Range(0)] = 0.0
    """Weight in the actor loss of the distance between its actions and those for an imagined
    subgoal, halfway to the goal by value; 0 imagines none."""
    imagination_interval: Annotated[int, Range(1, 1000)] = 1
    """Actor updates for each update of the network that imagines subgoals, which costs almost as
    much as one of actor and critic."""
    subgoal_every: Annotated[int, Range(0, 1000)] = 0
    """Ticks for which a subgoal holds that a second, high level proposes to the actor while it
    collects; 0 has none. The evaluated and saved actor is given the goal itself."""


@dataclass(frozen=True, kw_only=True)
class Ppo:
    """Settings of the initial networks for proximal policy optimisation (PPO)."""

    first_value: Annotated[float, Range(-1_000_000, 0)] = 0.0
    """Value that the critic of `ppo` starts with. With -1 / (1 - gamma), the value of failing for
    ever, no state looks good because it is new."""
    first_action_gain: Share = 1.0
    """Factor on the last layer of the actor of `ppo` at the start: near 0 it begins with noise
    around no action, with any seed."""


@dataclass(frozen=True, kw_only=True)
class Imitation:
    """Settings of imitation (DAgger). The imitated policy, `init_from`, observes the true state."""

    value_weight: Annotated[float, Range(0, 1000)] = 0.0
    """Weight of the value that an action loses against the action of the imitated policy, by its
    critic. It is added to the mean squared difference of the actions."""
    disturbance_scales: tuple[float, ...] = (1.0,)
    """Factors on `disturbances`, one for each cycle of collecting in turn."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Settings of the length of the run, evaluations and checkpoints."""

    total_steps: Annotated[int, Range(1)] = 5_000_000
    """Environment steps of the run."""
    time_limit: Annotated[float, Range(0)] = 0.0
    """Seconds after which the run ends; 0 is no limit."""
    success_target: Share = 0.0
    """The run ends when an evaluation reaches this success; 0 never ends it."""
    evaluate_every: Annotated[int, Range(1)] = 50_000
    """Environment steps between evaluations; the last actor is always evaluated."""
    evaluation_episodes: Annotated[int, Range(1, 1_000_000)] = 200
    """Episodes of an evaluation; hopeless evaluations end earlier."""
    checkpoint_seconds: Annotated[float, Range(0)] = 180.0
    """Seconds between checkpoints."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Settings of threads, precision and device."""

    overlap: bool = True
    """Collect with the actor of the previous cycle while learning; False alternates."""
    simulation_threads: Count = 0
    """Threads that step simulations; 0 is the cores that tensors leave."""
    torch_threads: Count = 0
    """Threads of one tensor operation; 0 is 1 up to batches of 1024, then half of the cores."""
    precision: Literal['auto', 'float32', 'bfloat16'] = 'auto'
    """Of `ddpg`; others use float32. `auto`: bfloat16 where the processor has it."""
    device: Literal['auto', 'cpu', 'cuda'] = 'auto'
    """Device of the networks; `imitation` uses the CPU."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(
    Machine,
    Limits,
    Imitation,
    Ppo,
    Subgoals,
    Values,
    Critics,
    Exploration,
    Learner,
    Replay,
    Network,
    Goals,
    Collect,
    Start,
):
    """All settings of a training run except its folder. All workers have the same settings.

    `num_envs`, `batch_size` and `replay_transitions` are totals, divided among the workers. With
    19 workers, the `paper` recipe gives each worker the settings of one worker in the paper.

    Raises:
        ValueError: If a value is not allowed, or fields exclude each other.
    """

    def __post_init__(self) -> None:
        """Check each field, then the rules between fields; store `disturbances` as JSON text."""
        for name, each in FIELDS.items():
            each.require(getattr(self, name))
        # A file may change, or be missing where the run is resumed.
        given = read_disturbances(self.disturbances)
        object.__setattr__(self, 'disturbances', '' if given.is_off else given.to_json())
        for is_broken, reason in _rules(self, task_spec(self.task, control_hz=self.control_hz)):
            if is_broken:
                raise ValueError(reason)

    @property
    def tick_share(self) -> float:
        """Length of a tick / 40 ms with `discount=time`, else 1.

        `gamma` is raised to this power, and rewards are multiplied by it.
        """
        return DEFAULT_CONTROL_HZ / self.control_hz if self.discount == 'time' else 1.0

    @property
    def tick_gamma(self) -> float:
        """Discount factor from one tick to the next."""
        return float(self.gamma**self.tick_share)

    @property
    def lowest_value(self) -> float:
        """Lowest possible value: the discounted return if every reward is -1 times `tick_share`."""
        return -self.tick_share / (1.0 - self.tick_gamma)

    @property
    def noise_ticks(self) -> int:
        """Number of ticks for which exploration noise is held, at least 1."""
        return max(round(self.noise_seconds * self.control_hz), 1)

    @property
    def narrows(self) -> bool:
        """True if the success thresholds start wider than those of the task and shrink to them."""
        return self.first_distance != 1.0 or self.first_rotation != 1.0


@dataclass(frozen=True, slots=True)
class Field:
    """One field of `TrainConfig`, for help texts and parsing.

    Attributes:
        group: Title of its group of fields in `--help`.
        meaning: Description of the field, on one line.
        kind: Type of the field without its range, such as `int`; `str` for a set of names.
        choices: Allowed values if the field has a fixed set of them, else an empty tuple.
        limits: Allowed range if the field is a number with limits, else None.
        default: Default of the field; None for `task`, which has no default.
    """

    name: str
    group: str
    meaning: str
    kind: Any
    choices: tuple[str, ...]
    limits: Range | None
    default: Any

    def require(self, value: Any) -> None:
        """Raise ValueError if `value` is outside the choices or limits of the field."""
        name, limits = self.name, self.limits
        if self.choices and value not in self.choices:
            raise ValueError(f'{name} {value!r:.80}; allowed: {", ".join(self.choices)}')
        if self.kind is int and abs(value) > LARGEST:
            raise ValueError(f'{name} is too large; allowed: up to {LARGEST}')
        if self.kind is float and not math.isfinite(value):
            raise ValueError(f'{name} {value} is no finite number')
        if limits and not limits.low <= value <= limits.high:
            raise ValueError(f'{name} {value}; allowed: {limits}')


def _describe() -> Iterator[Field]:
    """Yield all fields, group by group; titles and meanings are the docstrings in this module."""
    hints = typing.get_type_hints(TrainConfig, include_extras=True)
    # The whole module is parsed once: for the source of one class, Python parses all of it.
    source = ast.parse(inspect.getsource(sys.modules[__name__]))
    classes = {each.name: each for each in source.body if isinstance(each, ast.ClassDef)}
    for group in reversed(TrainConfig.__mro__[1:-1]):
        tree = classes[group.__name__]
        title = (ast.get_docstring(tree) or '').splitlines()[0].rstrip('.')
        for pair in pairwise(tree.body):
            match pair:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    kind, choices, limits = _parts(hints[name])
                    default = {} if name == 'goals' else getattr(TrainConfig, name, None)
                    meaning = ' '.join(text.split())
                    yield Field(name, title, meaning, kind, choices, limits, default)


def _parts(hint: Any) -> tuple[Any, tuple[str, ...], Range | None]:
    """Return type, choices (or an empty tuple) and range (or None) of a type annotation."""
    if typing.get_origin(hint) is Literal:
        return str, typing.get_args(hint), None
    is_ranged = typing.get_origin(hint) is Annotated
    return (hint.__origin__, (), hint.__metadata__[0]) if is_ranged else (hint, (), None)


FIELDS = {each.name: each for each in _describe()}
"""All fields by name, in the order of the groups."""
DEFAULTS = {name: each.default for name, each in FIELDS.items() if name != 'task'}


# Fields that have an effect only together with others: their names; the needed field and value, in
# words and as a function of the configuration.
NEEDS: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
    (
        'subgoal_every polyak target_update_interval policy_delay target discount critics '
        'aggregate norm quantiles random_epsilon final_exploration noise_seconds '
        'first_distance first_rotation',
        'algorithm ddpg',
        lambda c: c.algorithm == 'ddpg',
    ),
    (
        'noise_std actor_average learning_starts critic_first',
        'algorithm ddpg or ppo',
        lambda c: c.algorithm != 'imitation',
    ),
    (
        'n_step longest_hold condition goal_choice ticks_after_drop parameter_noise',
        'algorithm ddpg and no subgoal_every',
        lambda c: c.algorithm == 'ddpg' and not c.subgoal_every,
    ),
    (
        'start_share',
        'init_from and algorithm ddpg',
        lambda c: bool(c.init_from) and c.algorithm == 'ddpg',
    ),
    (
        'importance',
        'algorithm ppo (decision) or algorithm ddpg and no subgoal_every (density)',
        lambda c: (
            c.algorithm == ('ppo' if c.importance == 'decision' else 'ddpg') and not c.subgoal_every
        ),
    ),
    (
        'advantage',
        'algorithm ddpg, no subgoal_every, discount time and one critic of its mean without batch '
        'normalisation',
        lambda c: (
            c.algorithm == 'ddpg'
            and (c.subgoal_every, c.discount, c.critics, c.quantiles) == (0, 'time', 1, 1)
            and c.aggregate == 'mean'
            and c.norm != 'batch'
        ),
    ),
    (
        'subgoal_prior',
        'algorithm ddpg without subgoal_every, longest_hold, advantage, condition and importance',
        lambda c: (
            c.algorithm == 'ddpg'
            and not (c.subgoal_every or c.advantage or c.longest_hold > 1)
            and c.condition == c.importance == 'none'
        ),
    ),
    ('correction', 'n_step other than 1', lambda c: c.n_step > 1),
    (
        'trace',
        'correction lambda or algorithm ppo',
        lambda c: c.correction == 'lambda' or c.algorithm == 'ppo',
    ),
    ('widest_threshold', 'condition threshold', lambda c: c.condition == 'threshold'),
    ('imagination_interval', 'subgoal_prior other than 0.0', lambda c: c.subgoal_prior > 0.0),
    (
        'drop_is_lost',
        'ticks_after_drop other than -1 and reward_type sparse, without condition horizon and '
        'goal_choice bellman',
        lambda c: (
            (c.ticks_after_drop >= 0 and c.reward_type == 'sparse')
            and (c.condition != 'horizon' and c.goal_choice != 'bellman')
        ),
    ),
    (
        'first_distance first_rotation reward_grades',
        'reward_type sparse without condition and subgoal_every',
        lambda c: c.reward_type == 'sparse' and c.condition == 'none' and not c.subgoal_every,
    ),
    ('first_value first_action_gain', 'algorithm ppo', lambda c: c.algorithm == 'ppo'),
    (
        'value_weight disturbance_scales',
        'algorithm imitation',
        lambda c: c.algorithm == 'imitation',
    ),
)
# Values without effect that differ from the default: only `ddpg` takes random actions.
WITHOUT_EFFECT: dict[str, Any] = {'random_epsilon': 0.0}

# Sources of goals: the functions in `experience.hindsight.SOURCES`, `real` (keeps the goal of the
# episode) and, with `ppo` only, `outcome`.
SOURCES = ('real', 'future', 'final', 'episode', 'random', 'actual', 'displaced', 'outcome')
# Sources of goals that depend on what the robot did after the transition.
FROM_THE_EPISODE = ('future', 'final', 'episode')
# Tasks that ignore their gripper action.
GAMBLE_TASKS = ('FetchReach', 'FetchPush')
# Fields that change what values are of; at most one of them differs from its default.
_ALTERNATIVES = ('n_step', 'longest_hold', 'advantage', 'condition', 'importance', 'goal_choice')


def changed_fields(config: TrainConfig, names: typing.Iterable[str]) -> list[str]:
    """Return 'name value' for each field in `names` that differs from its default."""
    values = {name: getattr(config, name) for name in names}
    return [f'{name} {value}' for name, value in values.items() if value != DEFAULTS[name]]


def unusual_networks(config: TrainConfig) -> list[str]:
    """Return 'name value' for each changed field that makes networks unfit for `init_from`.

    A run with such networks cannot use `init_from`, and no other run can start from them.
    """
    learner = () if config.algorithm == 'imitation' else ('algorithm',)
    return changed_fields(
        config, (*learner, 'longest_hold', 'advantage', 'subgoal_every', 'quantiles')
    )


def _rules(config: TrainConfig, spec: TaskSpec) -> Iterator[tuple[bool, str]]:
    """Yield each rule between fields as a pair: whether it is broken, and the error message.

    Raises:
        ValueError: If `goal_features` is unknown, or invalid for this task.
    """
    c = config
    goal_features(c.goal_features, spec)
    ppo, is_sparse = c.algorithm == 'ppo', c.reward_type == 'sparse'
    yield (
        not 1 <= len(c.hidden_sizes) <= 64 or not all(1 <= n <= MOST_UNITS for n in c.hidden_sizes),
        f'hidden_sizes {str(c.hidden_sizes)[:80]}; allowed: 1 to 64 widths of 1 ... {MOST_UNITS}',
    )
    yield (
        not all(low < high for low, high in pairwise((0.0, *c.reward_grades, 1e3))),
        f'reward_grades {c.reward_grades}: allowed are rising numbers above 0 and below 1000',
    )
    yield (
        spec.rotation_threshold is None and c.first_rotation != 1.0,
        f'first_rotation: goals of {spec.name} have no rotation',
    )
    yield (
        not spec.position_counts and c.first_distance != 1.0,
        f'first_distance: the position of goals of {spec.name} does not count',
    )
    yield (
        c.gamble and c.task not in GAMBLE_TASKS,
        f'gamble: {c.task} uses its gripper; allowed: {", ".join(GAMBLE_TASKS)}',
    )
    yield (
        c.learning_starts > c.replay_transitions,
        f'learning_starts needs replay_transitions of {c.learning_starts} or more',
    )
    yield ppo and c.overlap, 'algorithm ppo needs overlap=false'
    yield ppo and c.noise_std < 1e-6, f'noise_std {c.noise_std}; allowed: {Range(1e-6)}'
    scales = c.disturbance_scales
    yield (
        not scales or not all(0.0 <= scale <= 10.0 for scale in scales),
        f'disturbance_scales {scales}; allowed: one or more factors 0 ... 10',
    )
    yield (
        c.algorithm == 'imitation' and not c.init_from,
        'algorithm imitation needs init_from, the policy to imitate',
    )
    unusual, chosen = unusual_networks(c), changed_fields(c, _ALTERNATIVES)
    yield bool(c.init_from and unusual), f'init_from excludes {", ".join(unusual)}'
    yield len(chosen) > 1, f'{" excludes ".join(chosen)}'
    yield (
        c.past_actions > 0 and (c.longest_hold > 1 or c.parameter_noise or c.subgoal_every > 0),
        'past_actions needs longest_hold=1, parameter_noise=False and subgoal_every=0',
    )
    yield (
        0.0 < c.noise_seconds * c.control_hz < 1.0 - 1e-6,
        f'noise_seconds {c.noise_seconds:g} is less than a tick of {1.0 / c.control_hz:g} s',
    )
    yield c.norm == 'batch' and c.target != 'none', 'norm batch needs target none'
    yield (
        c.quantiles > 1 and (c.aggregate == 'min' or c.norm == 'batch'),
        'quantiles above 1 exclude aggregate min and norm batch',
    )
    yield (
        c.longest_hold > 1 and (c.noise_seconds > 0.0 or c.parameter_noise or c.gamble),
        'longest_hold above 1 excludes noise_seconds, parameter_noise and gamble',
    )
    yield (
        c.condition == 'threshold' and not is_sparse,
        'condition threshold needs reward_type sparse',
    )
    yield (
        c.subgoal_every > spec.episode_ticks,
        f'subgoal_every {c.subgoal_every} is longer than an episode',
    )
    yield (
        c.subgoal_every > 0 and not is_sparse,
        'subgoal_every needs reward_type sparse',
    )
    yield (
        c.ticks_after_drop >= 0 and spec.goal is not GoalKind.POSE,
        f'ticks_after_drop: {c.task} has no palm to drop an object from',
    )
    yield from _rules_of_goals(c)


def _rules_of_goals(config: TrainConfig) -> Iterator[tuple[bool, str]]:
    """Yield each rule between the fields for goal sources, as pairs like those of `_rules`."""
    c, goals, total = config, config.goals, sum(config.goals.values())
    unknown = ', '.join(map(repr, goals.keys() - set(SOURCES)))
    yield bool(unknown), f'goals {goals}: {unknown}; allowed: {", ".join(SOURCES)}'
    yield (
        not (min(goals.values(), default=1.0) > 0.0 and total <= 1.0 + 1e-9),
        f'goals {goals}: allowed are shares above 0 that add up to at most 1',
    )
    yield bool(goals) and c.strategy == 'none', f'goals {goals} excludes strategy none'
    yield 'outcome' in goals and c.algorithm != 'ppo', 'goals outcome needs algorithm ppo'
    yield (
        c.goal_choice != 'uniform'
        and 'future' not in (goals or [c.strategy.removesuffix('actual')]),
        f'goal_choice {c.goal_choice} needs future goals',
    )
    yield (
        c.goal_choice == 'uncertain' and c.critics == 1,
        'goal_choice uncertain needs critics above 1',
    )
    sources = set(goals or {c.strategy}) - {'real', 'none'}
    known, keeps_some = sources & set(FROM_THE_EPISODE), not goals or total < 1.0 - 1e-9
    yield (
        c.importance == 'density' and (not known or not (keeps_some or sources - known)),
        f'importance density needs goals of the episode ({", ".join(FROM_THE_EPISODE)}) '
        'beside others',
    )


def idle_note(config: TrainConfig, critic_first: int = 0) -> str:
    """Return a warning if the run ends before its first update or that of the actor, else ''.

    Args:
        critic_first: Number of first updates in which only the critic of the learner is trained;
            the larger one of this number and `config.critic_first` counts.
    """
    c = config
    cycle = c.num_envs * task_spec(c.task, control_hz=c.control_hz).episode_ticks
    # The replay holds whole episodes, at least those of one cycle.
    start = min(c.learning_starts, max(c.replay_transitions, cycle))
    cycles = -(-c.total_steps // cycle) - max(-(-start // cycle) - 1, 0)
    updates, first = max(cycles, 0) * c.updates_per_cycle, max(c.critic_first, critic_first)
    if not updates:
        return (
            f'nothing will be learnt: total_steps {c.total_steps}, learning_starts '
            f'{c.learning_starts}, updates_per_cycle {c.updates_per_cycle}'
        )
    if -(-first // c.policy_delay) * c.policy_delay >= updates:
        return (
            f'the actor will not learn: critic_first {first}, policy_delay {c.policy_delay} '
            f'of {updates} updates'
        )
    return ''
