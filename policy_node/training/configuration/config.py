"""The training configuration: groups of fields, each field where it means something.

Field names are unique over all groups. `flat.py` maps them to the flat names of `--set`,
`train(**fields)` and stored runs; `groups.py` has the learners and what studies add to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Literal, TypeVar

from msgs_spec.disturbances import read_disturbances
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, GoalKind, TaskSpec, task_spec
from policy_node.policies.checkpoint import MOST_PAST_ACTIONS
from policy_node.policies.goal_features import goal_features
from policy_node.training.configuration.groups import (
    Advantages,
    Checked,
    Chosen,
    Count,
    Critics,
    Ddpg,
    Dense,
    Density,
    Held,
    Hierarchical,
    Horizon,
    Imitation,
    OffPolicy,
    OneStep,
    Ppo,
    Range,
    Returns,
    Share,
    Sparse,
    Threshold,
    Total,
)

Recipe = Literal['paper', 'best', 'robust', 'finetune']
Option = TypeVar('Option', bound=Checked)


@dataclass(frozen=True, slots=True)
class Collect(Checked):
    """Where episodes come from."""

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


@dataclass(frozen=True, slots=True)
class Goals(Checked):
    """Goals that replace those of the episodes in a batch."""

    strategy: Literal['final', 'future', 'episode', 'random', 'futureactual', 'none'] = 'future'
    """Source of hindsight goals; `none` is without hindsight."""
    hindsight_k: Annotated[int, Range(1, 1000)] = 4
    """Replaced goals for each goal kept: k/(k+1) of a batch is relabelled. With `ppo` also the
    number of goals of each episode."""
    goals: dict[str, float] = field(default_factory=dict)
    """Mixture of goal sources instead of `strategy`: `future=.4,actual=.3`. The rest keeps its
    goal. Also `displaced` (near the goal achieved before) and with `ppo` `outcome` (achieved by
    other episodes)."""


@dataclass(frozen=True, slots=True)
class Network(Checked):
    """Actor and critic."""

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


@dataclass(frozen=True, slots=True)
class Replay(Checked):
    """Episodes to learn from."""

    replay_transitions: Annotated[int, Range(1)] = 1_000_000
    """Capacity of the replay."""
    learning_starts: Total = 0
    """Steps in the replay before the first update."""
    kept_transitions: Total = 300_000
    """Newest transitions stored beside the training state for `--resume`."""
    moved_share: Share = 0.0
    """Share of a batch from episodes whose achieved goal moved; 0 draws uniformly. The landing of a
    `gamble` is no motion."""


@dataclass(frozen=True, slots=True)
class Limits(Checked):
    """Length of the run, evaluations and checkpoints."""

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


@dataclass(frozen=True, slots=True)
class Machine(Checked):
    """Threads, precision and device."""

    overlap: bool = True
    """Collect with the actor of the previous cycle while learning; False alternates."""
    simulation_threads: Count = 0
    """Threads that step simulations; 0 is the cores that tensors leave."""
    torch_threads: Count = 0
    """Threads of one tensor operation; 0 is 1 up to batches of 1024, then half of the cores."""
    precision: Literal['auto', 'float32', 'bfloat16'] = 'auto'
    """Of the learner; `auto`: bfloat16 where the processor has it. `ppo` uses float32."""
    device: Literal['auto', 'cpu', 'cuda'] = 'auto'
    """Device of the networks."""


@dataclass(frozen=True, slots=True)
class TrainConfig(Checked):
    """Everything that decides what a run learns; the same on every worker.

    `num_envs`, `batch_size` and `replay_transitions` are totals: with N workers each takes its
    share, so the `paper` recipe on 19 workers is the paper's set-up worker by worker.

    Raises:
        ValueError: If a value is not allowed, or fields exclude each other.
    """

    task: str
    """Task name, `FetchReach`, ..."""
    recipe: Recipe = 'best'
    """Recipe of the values, for the record."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of weights, exploration, relabelling and resets."""
    collect: Collect = Collect()
    reward: Sparse | Dense = field(default_factory=Sparse)
    goals: Goals = Goals()
    network: Network = Network()
    replay: Replay = Replay()
    learner: Ddpg | Hierarchical | Ppo | Imitation = field(default_factory=Ddpg)
    run: Limits = Limits()
    machine: Machine = Machine()

    def __post_init__(self) -> None:
        """Checks the fields, then the rules between groups."""
        Checked.__post_init__(self)
        spec = task_spec(self.task, control_hz=self.collect.control_hz)
        goal_features(self.network.goal_features, spec)
        read_disturbances(self.collect.disturbances)
        sizes = self.network.hidden_sizes
        if not 1 <= len(sizes) <= 64 or not all(1 <= size <= MOST_UNITS for size in sizes):
            raise ValueError(
                f'hidden_sizes {str(sizes)[:80]}; allowed: 1 to 64 widths of 1 ... {MOST_UNITS}'
            )
        _require_goals(self)
        _require_reward(self, spec)
        for holds, reason in _contradictions(self, spec):
            if holds:
                raise ValueError(reason)

    def find(self, kind: type[Option]) -> Option | None:
        """Return the learner or its option of this kind, or None where the run has none."""
        learner = self.learner
        options: list[object] = [self.reward, learner]
        if isinstance(learner, OffPolicy):
            options.append(learner.critic)
        if isinstance(learner, Ddpg):
            options += [learner.values, learner.imagined, learner.drop]
        return next((option for option in options if isinstance(option, kind)), None)

    @property
    def tick_share(self) -> float:
        """Duration of a tick in units of what `gamma` discounts."""
        per_time = isinstance(self.learner, OffPolicy) and self.learner.discount == 'time'
        return DEFAULT_CONTROL_HZ / self.collect.control_hz if per_time else 1.0

    @property
    def tick_gamma(self) -> float:
        """Discount of a tick."""
        return float(self.learner.gamma**self.tick_share)

    @property
    def lowest_value(self) -> float:
        """Value of a state after which every tick is rewarded with -1."""
        return -self.tick_share / (1.0 - self.tick_gamma)


# Largest width of a hidden layer.
MOST_UNITS = 65_536
# Noise of this standard deviation leaves next to nothing of actions in [-1, 1].
_NOISE_ALONE = 10.0
# Adam moves a weight by at most about the learning rate; float32 loses smaller sums.
_NO_CHANGE = 1e-7
# A value that keeps a larger share of its first value has not moved.
_KEPT = 0.99

# Sources of goals. `real` keeps the goal of the episode.
STRATEGIES = ('future', 'final', 'episode', 'random')
SOURCES = ('real', *STRATEGIES, 'actual', 'displaced', 'outcome')
# Sources that depend on where the transition led.
FROM_THE_EPISODE = ('future', 'final', 'episode')
# Tasks that ignore their gripper action.
GAMBLE_TASKS = ('FetchReach', 'FetchPush')


def unusual_networks(config: TrainConfig) -> list[str]:
    """Return the fields, as `name value`, whose networks no other kind of run can start from."""
    learner, found = config.learner, []
    if isinstance(learner, Ppo):
        found.append('algorithm ppo')
    if held := config.find(Held):
        found.append(f'longest_hold {held.longest_hold}')
    if config.find(Advantages):
        found.append('advantage True')
    if isinstance(learner, Hierarchical):
        found.append(f'subgoal_every {learner.subgoal_every}')
    if isinstance(learner, OffPolicy) and learner.critic.quantiles > 1:
        found.append(f'quantiles {learner.critic.quantiles}')
    return found


def idle_parts(config: TrainConfig, critic_first: int = 0) -> Iterator[str]:
    """Yield a line for each part of learning that never happens with these values.

    Three questions: will any update happen, will the targets ever move, will the policy ever act?

    Args:
        config: Configuration of the whole run.
        critic_first: Updates before the actor learns, where the run has more than its field.
    """
    learner, total, cycle = config.learner, config.run.total_steps, _cycle_steps(config)
    cycles = -(-total // cycle)
    updates = _updates_of(config, cycles)
    first = max(learner.critic_first, critic_first)
    delay = learner.policy_delay if isinstance(learner, OffPolicy) else 1
    if learner.learning_rate * updates < _NO_CHANGE:
        yield (
            f'nothing will be learnt: {updates} updates with learning_starts '
            f'{config.replay.learning_starts}, updates_per_cycle {learner.updates_per_cycle}, '
            f'learning_rate {learner.learning_rate:g}, total_steps {total}'
        )
    elif -(-first // delay) * delay >= updates:
        yield (
            f'the actor will not learn: critic_first {first}, policy_delay {delay} '
            f'of {updates} updates'
        )
    elif learner.actor_average**cycles > _KEPT:
        yield (
            f'the evaluated actor will not move: actor_average {learner.actor_average:g} '
            f'over {cycles} cycles'
        )
    if isinstance(learner, OffPolicy) and learner.target == 'polyak' and updates:
        interval = learner.target_update_interval
        if learner.polyak ** (updates // interval) > _KEPT:
            yield (
                f'the targets will not move: polyak {learner.polyak:g}, target_update_interval '
                f'{interval} of {updates} updates'
            )
    noise = learner.exploration
    epsilon, spread = (
        noise.final_exploration * each for each in (noise.random_epsilon, noise.noise_std)
    )
    if epsilon > _KEPT or spread >= _NOISE_ALONE:
        yield (
            f'the policy will not act while it collects: random_epsilon {noise.random_epsilon:g}, '
            f'noise_std {noise.noise_std:g}'
        )


def _cycle_steps(config: TrainConfig) -> int:
    """Return the environment steps of a cycle."""
    spec = task_spec(config.task, control_hz=config.collect.control_hz)
    return config.collect.num_envs * spec.episode_ticks


def _updates_of(config: TrainConfig, cycles: int) -> int:
    """Return the number of updates of a whole run; time limits and resumed runs apart."""
    cycle = _cycle_steps(config)
    # The replay holds whole episodes, at least those of one cycle.
    start = min(config.replay.learning_starts, max(config.replay.replay_transitions, cycle))
    waiting = max(-(-start // cycle) - 1, 0)
    return max(cycles - waiting, 0) * config.learner.updates_per_cycle


def _require_goals(config: TrainConfig) -> None:
    """Reject mixtures of goals that are not probabilities of known sources."""
    goals = config.goals.goals
    unknown = goals.keys() - set(SOURCES)
    if unknown:
        raise ValueError(f'goals {goals}: {unknown.pop()!r}; allowed: {", ".join(SOURCES)}')
    if goals and not (min(goals.values()) > 0.0 and sum(goals.values()) <= 1.0 + 1e-9):
        raise ValueError(f'goals {goals}: allowed are shares above 0 that add up to at most 1')
    if goals and config.goals.strategy == 'none':
        raise ValueError(f'goals {goals} excludes strategy none')


def _require_reward(config: TrainConfig, spec: TaskSpec) -> None:
    """Reject thresholds that the task does not have, and grades that do not rise."""
    sparse = config.find(Sparse)
    if sparse is None:
        return
    grades = sparse.reward_grades
    if not all(low < high for low, high in pairwise((0.0, *grades, 1e3))):
        raise ValueError(
            f'reward_grades {grades}: allowed are rising numbers above 0 and below 1000'
        )
    if spec.rotation_threshold is None and sparse.first_rotation != 1.0:
        raise ValueError(f'first_rotation: goals of {spec.name} have no rotation')
    if not spec.position_counts and sparse.first_distance != 1.0:
        raise ValueError(f'first_distance: the position of goals of {spec.name} does not count')


def _is_graded(reward: Sparse) -> bool:
    """Return whether the reward has thresholds of its own."""
    return reward.narrows or reward.reward_grades != ()


def _contradictions(config: TrainConfig, spec: TaskSpec) -> Iterator[tuple[bool, str]]:
    """Yield the rules between groups: whether one is broken, and its message."""
    learner, ppo = config.learner, isinstance(config.learner, Ppo)
    names = ', '.join(GAMBLE_TASKS)
    yield (
        config.collect.gamble and config.task not in GAMBLE_TASKS,
        f'gamble: {config.task} uses its gripper; allowed: {names}',
    )
    yield (
        config.replay.learning_starts > config.replay.replay_transitions,
        f'learning_starts needs replay_transitions of {config.replay.learning_starts} or more',
    )
    yield 'outcome' in config.goals.goals and not ppo, 'goals outcome needs algorithm ppo'
    yield ppo and config.machine.overlap, 'algorithm ppo needs overlap=false'
    scales = learner.disturbance_scales if isinstance(learner, Imitation) else (1.0,)
    yield (
        not scales or not all(0.0 <= scale <= 10.0 for scale in scales),
        f'disturbance_scales {scales}; allowed: one or more factors 0 ... 10',
    )
    yield (
        isinstance(learner, Imitation) and not config.network.init_from,
        'algorithm imitation needs init_from, the policy to imitate',
    )
    unusual = unusual_networks(config)
    yield bool(config.network.init_from and unusual), f'init_from excludes {", ".join(unusual)}'
    if isinstance(learner, OffPolicy):
        yield from _contradictions_of_values(config, learner)
        yield (
            config.network.past_actions > 0
            and (config.find(Held) is not None or learner.exploration.parameter_noise),
            'past_actions needs longest_hold=1 and parameter_noise=False',
        )
    if isinstance(learner, Ddpg):
        yield from _contradictions_of_options(config, learner, spec)
    if isinstance(learner, Hierarchical):
        yield (
            learner.subgoal_every > spec.episode_ticks,
            f'subgoal_every {learner.subgoal_every} is longer than an episode',
        )
        sparse = config.find(Sparse)
        yield (
            sparse is None or _is_graded(sparse) or learner.exploration.parameter_noise,
            'subgoal_every needs reward_type sparse and excludes reward_grades, first_distance, '
            'first_rotation and parameter_noise',
        )


def _contradictions_of_values(
    config: TrainConfig, learner: OffPolicy
) -> Iterator[tuple[bool, str]]:
    critic, seconds = learner.critic, learner.exploration.noise_seconds
    rate = config.collect.control_hz
    yield (
        0.0 < seconds * rate < 1.0 - 1e-6,
        f'noise_seconds {seconds:g} is less than a tick of {1.0 / rate:g} s',
    )
    yield critic.norm == 'batch' and learner.target != 'none', 'norm batch needs target none'
    yield (
        critic.quantiles > 1 and (critic.aggregate == 'min' or critic.norm == 'batch'),
        'quantiles above 1 exclude aggregate min and norm batch',
    )


def _contradictions_of_options(
    config: TrainConfig, learner: Ddpg, spec: TaskSpec
) -> Iterator[tuple[bool, str]]:
    """Yield the rules of what studies add to DDPG."""
    values, critic, sparse = learner.values, learner.critic, config.find(Sparse)
    noise = learner.exploration
    yield (
        isinstance(values, Held)
        and (noise.noise_seconds > 0.0 or noise.parameter_noise or config.collect.gamble),
        'longest_hold above 1 excludes noise_seconds, parameter_noise and gamble',
    )
    yield (
        isinstance(values, Advantages)
        and (
            learner.discount != 'time'
            or critic.norm == 'batch'
            or critic != Critics(norm=critic.norm)
        ),
        'advantage needs discount time and one critic of its mean, without norm batch',
    )
    yield (
        learner.imagined is not None and not isinstance(values, OneStep | Returns | Chosen),
        'subgoal_prior excludes longest_hold, advantage, condition and importance',
    )
    yield (
        isinstance(values, Threshold | Horizon) and sparse is not None and _is_graded(sparse),
        'condition excludes reward_grades, first_distance and first_rotation',
    )
    yield (
        isinstance(values, Threshold) and sparse is None,
        ('condition threshold needs reward_type sparse'),
    )
    if isinstance(values, Chosen):
        chosen_from = config.goals.goals or [config.goals.strategy[:6]]
        yield 'future' not in chosen_from, f'goal_choice {values.goal_choice} needs future goals'
        yield (
            values.goal_choice == 'uncertain' and critic.critics == 1,
            'goal_choice uncertain needs critics above 1',
        )
    if isinstance(values, Density):
        sources = set(config.goals.goals or {config.goals.strategy}) - {'real', 'none'}
        known = sources & set(FROM_THE_EPISODE)
        kept = config.goals.goals == {} or sum(config.goals.goals.values()) < 1.0 - 1e-9
        yield (
            not known or not (kept or sources - known),
            f'importance density needs goals of the episode ({", ".join(FROM_THE_EPISODE)}) '
            'beside others',
        )
    if learner.drop is not None:
        yield (
            spec.goal is not GoalKind.POSE,
            f'ticks_after_drop: {config.task} has no palm to drop an object from',
        )
        bellman = isinstance(values, Chosen) and values.goal_choice == 'bellman'
        yield (
            learner.drop.drop_is_lost
            and (sparse is None or bellman or isinstance(values, Horizon)),
            'drop_is_lost needs reward_type sparse; it excludes condition horizon and bellman',
        )
