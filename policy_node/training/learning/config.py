"""The training configuration: its fields, what they allow, and how they are read."""

from __future__ import annotations

import types
import typing
from dataclasses import dataclass
from typing import Any

from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    REWARD_TYPES,
    SUCCESS_RULES,
    GoalKind,
    TaskSpec,
    task_spec,
)
from policy_node.policies.goal_features import GOAL_FEATURES, goal_features
from policy_node.training.learning.goal_choice import GOAL_CHOICES
from policy_node.training.learning.hindsight import parse_mixture
from policy_node.training.learning.multi_step import CORRECTIONS

RECIPES = ('paper', 'best')
# Tasks that ignore their gripper action.
GAMBLE_TASKS = ('FetchReach', 'FetchPush')


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Everything that decides what a run learns; the same file on every worker.

    `num_envs`, `batch_size` and `replay_transitions` are totals: with N workers each takes its
    share, so the `paper` recipe on 19 workers is the paper's set-up worker by worker.
    """

    task: str
    """Task name, `FetchReach`, ..."""
    recipe: str = 'best'
    """Recipe the values come from, for the record."""
    seed: int = 0
    """Seed of weights, exploration, relabelling and resets."""
    algorithm: str = 'ddpg'
    """`ddpg`, or `ppo` (on policy: each cycle's episodes once, also under goals in hindsight)."""
    control_hz: float = DEFAULT_CONTROL_HZ
    """Action frequency, Hz. Steps, also those of this configuration, are ticks at this rate."""
    reward_type: str = 'sparse'
    """`sparse` (-1 until success, then 0) or `dense` (negative distance)."""
    success_rule: str = 'gymnasium'
    """Success rule behind the sparse reward: `gymnasium` or `paper`."""
    gamble: bool = False
    """The idle gripper action above .9 teleports the achieved goal at random and freezes the
    episode (FetchReach, FetchPush): the paper's own case against hindsight."""
    reward_distance: float = 1.0
    """Share of the task's success distance within which the sparse reward of training is 0. Below 1
    the actor learns to come closer than it has to; evaluation keeps the task's distance."""
    reward_rotation: float = 1.0
    """Share of the task's success rotation likewise."""
    first_distance: float = 1.0
    """What `reward_distance` is multiplied by at the start of the run; this factor falls
    geometrically to 1 over the first two thirds. Coarse goals, which are met often, come first."""
    first_rotation: float = 1.0
    """What `reward_rotation` is multiplied by at the start, likewise."""
    strategy: str = 'future'
    """Hindsight goals: final, future, episode, random, futureactual, or none (no hindsight)."""
    hindsight_k: int = 4
    """Relabelled goals for each goal kept, so k/(k+1) of a batch is relabelled."""
    goals: str = ''
    """Goal sources as a mixture instead of `strategy`: `future=.4,actual=.3,near=.1`; what is left
    of 1 keeps the goal. Also `next` (what this step achieved) and `near` (one of the next ten)."""
    goal_choice: str = 'uniform'
    """Which of 8 future goals is taken: `uniform` (any), `bellman` (the value that errs most) or
    `uncertain` (that critics differ in most)."""
    importance: str = 'none'
    """Weights of transitions: `none`; `density` (in the critic's loss) takes back that a goal in
    hindsight depends on where the transition led; `decision` (of `ppo`) that the actions of a
    replayed episode are those for another goal."""
    moved_share: float = 0.0
    """Share of a batch drawn by `episode_weights`; 0 draws uniformly."""
    episode_weights: str = 'moved'
    """Weights of episodes: `moved` (1 where the achieved goal moved, else 0) or `energy` (given to
    the object)."""
    ticks_after_drop: int = -1
    """Ticks after an object fell off the palm that are still learnt from; -1 is all."""
    drop_is_lost: bool = False
    """With `ticks_after_drop`, what follows the last of them counts -1 for ever. Without it nothing
    teaches that a drop is final."""

    condition: str = 'none'
    """One input more of actor and critic: `none`, `threshold` (log-uniform, .5 ... 8 times that of
    success, also in the reward) or `horizon` (steps left, of which values count the rewards). The
    actor acts at the threshold of the task and with a whole episode left."""
    n_step: int = 1
    """Most steps of a return before it bootstraps."""
    correction: str = 'none'
    """Of longer returns, whose actions are not the actor's: `none`, `lambda` (their mean is the
    lambda-return) or `cut` (they end before an action far from the actor's)."""
    trace: float = 0.7
    """With `lambda`, the probability of going on after each step; of `ppo` the same lambda."""
    cut_distance: float = 0.3
    """With `cut`, the farthest action from the actor's, root mean square."""

    init_from: str = ''
    """Networks and normalisers to start from: a run folder, a shipped actor or the file of one;
    empty starts from nothing."""
    critic_first: int = 0
    """Updates of the critic alone before the actor learns too; 0 is 5,000 where `init_from` is an
    actor without its critic, else none."""
    total_steps: int = 5_000_000
    """Environment steps of the run."""
    time_limit: float = 0.0
    """Seconds after which the run ends; 0 is no limit."""
    success_target: float = 0.0
    """The run ends when an evaluation reaches this success; 0 is never."""

    num_envs: int = 64
    """Simulations stepped together; each cycle collects one episode of each."""
    updates_per_cycle: int = 40
    """Gradient updates after each cycle."""
    batch_size: int = 1024
    """Transitions per update."""
    replay_transitions: int = 1_000_000
    """Capacity of the replay."""
    random_steps: int = 0
    """Steps with uniformly random actions before the policy acts."""
    learning_starts: int = 0
    """Steps in the replay before the first update."""
    kept_transitions: int = 300_000
    """Newest transitions kept beside the training state for `--resume`."""
    future_only_steps: int = 0
    """Steps during which futureactual is replaced by future."""

    goal_features: str = 'plain'
    """Inputs of actor and critic: `plain` (observation and goal), `relative` (how far
    the goal is as well) or `symmetric` (alike poses are one, of the goal only the distance)."""
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Width of each hidden layer of actor and critic."""
    layer_norm: bool = False
    """LayerNorm in hidden layers of actor and critic."""
    learning_rate: float = 1e-3
    """Adam step size of actor and critic."""
    final_learning_rate: float = 1.0
    """Share of `learning_rate` left at `total_steps`, falling linearly; 1 keeps it constant."""
    actor_average: float = 0.0
    """Share of an average of actor weights kept each cycle; the average is what is evaluated and
    saved as best. 0 evaluates the actor itself."""
    gamma: float = 0.98
    """Discount; targets are clipped to [-1/(1-gamma), 0]."""
    discount: str = 'tick'
    """What `gamma` discounts: one `tick`, or `time`: 40 ms, whatever a tick is. A tick's reward is
    then that for its share of 40 ms, so that values are as large at every rate."""
    advantage: bool = False
    """Critics learn values of states and advantages per 40 ms (DAU) instead of action values."""
    action_l2: float = 1.0
    """Weight of the mean squared action in the actor loss."""
    polyak: float = 0.95
    """Share of the old target network kept by a target update."""
    target_update_interval: int = 40
    """Updates between target updates."""
    target: str = 'polyak'
    """Networks that targets are computed with: `polyak` (slow copies) or `none` (those that
    learn)."""
    norm: str = 'none'
    """What normalises hidden layers of the critic alone: `none`, `layer` or `batch` (as CrossQ,
    without target networks); `layer_norm` is for both networks."""
    critics: int = 1
    """Critics that start differently; the actor follows their mean."""
    aggregate: str = 'mean'
    """What targets take of several critics: `mean`, `min` or `truncated` (the mean without the
    highest)."""

    random_epsilon: float = 0.3
    """Probability of a uniformly random action."""
    noise_std: float = 0.2
    """Standard deviation of the Gaussian noise on other actions."""
    noise_spread: float = 0.0
    """Exploration differs between simulations: from 1 - spread to 1 + spread times both."""
    noise_seconds: float = 0.0
    """How long noise and random actions hold once they are drawn; 0 is one tick."""
    parameter_noise: bool = False
    """Instead of Gaussian noise on actions, noise on weights that moves actions by `noise_std`."""
    longest_hold: int = 1
    """Most ticks for which the actor lets an action hold while it collects; above 1 it learns how
    long. The actor that is evaluated and saved decides at every tick."""
    subgoal_every: int = 0
    """Ticks for which a subgoal holds that a second, high level proposes to the actor while it
    collects; 0 has none. The actor that is evaluated and saved is given the goal itself."""
    subgoal_prior: float = 0.0
    """Weight of the distance between the actor's actions and those for an imagined subgoal, halfway
    to the goal by value, in the actor loss; 0 imagines none."""
    final_exploration: float = 1.0
    """Share of `random_epsilon` and `noise_std` left at `total_steps`; both fall linearly in
    the last third of the run. 1 keeps them constant."""

    evaluate_every: int = 50_000
    """Environment steps between evaluations."""
    evaluation_episodes: int = 200
    """Episodes behind a decision which actor is best; hopeless evaluations end earlier."""
    checkpoint_seconds: float = 180.0
    """Seconds between checkpoints."""

    overlap: bool = True
    """Collect with the actor of one cycle ago while learning; False alternates strictly."""
    simulation_threads: int = 0
    """Threads that step simulations; 0 is the cores that tensors leave."""
    torch_threads: int = 0
    """Threads of one tensor operation; 0 is 1 up to batches of 1024, then half of the cores."""
    precision: str = 'auto'
    """`float32`, `bfloat16` (autocast), or `auto`: bfloat16 where the processor has it."""
    device: str = 'auto'
    """`auto`, `cpu` or `cuda`."""

    def __post_init__(self) -> None:
        spec = task_spec(self.task)
        for name, allowed in CHOICES.items():
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(f'{name} {value!r}; allowed: {", ".join(allowed)}')
        for name, lowest, highest in RANGES:
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise ValueError(f'{name} {value}; allowed: {lowest:.6g} ... {highest:.6g}')
        goal_features(self.goal_features, spec)
        self._refuse_what_has_no_effect(spec)
        if not self.hidden_sizes or min(self.hidden_sizes) < 1:
            raise ValueError(f'hidden_sizes {self.hidden_sizes}; allowed: one or more widths >= 1')

    @property
    def has_plain_networks(self) -> bool:
        """Whether other runs have networks of the same kind, so that they can start from these."""
        return all(getattr(self, name) == value for name, value in PLAIN_NETWORKS.items())

    @property
    def narrows(self) -> bool:
        """Whether goals are met more easily at the start of a run than at its end."""
        return self.first_distance != 1.0 or self.first_rotation != 1.0

    @property
    def tick_share(self) -> float:
        """Duration of a tick in units of what `gamma` discounts."""
        return DEFAULT_CONTROL_HZ / self.control_hz if self.discount == 'time' else 1.0

    @property
    def tick_gamma(self) -> float:
        """Discount of a tick."""
        return float(self.gamma**self.tick_share)

    @property
    def lowest_value(self) -> float:
        """Value of a state from which every tick is rewarded with -1 for ever."""
        return -self.tick_share / (1.0 - self.tick_gamma)

    @property
    def _episode_ticks(self) -> int:
        """Steps of an episode."""
        return task_spec(self.task, control_hz=self.control_hz).episode_ticks

    @property
    def noise_ticks(self) -> int:
        """For how many ticks noise holds."""
        return max(round(self.noise_seconds * self.control_hz), 1)

    def _refuse_what_has_no_effect(self, spec: TaskSpec) -> None:
        if self.goals:
            parse_mixture(self.goals)
            if self.strategy == 'none':
                raise ValueError(f'goals {self.goals!r} excludes strategy none')
        for wrong, reason in self._contradictions():
            if wrong:
                raise ValueError(reason)
        if self.gamble:
            require_idle_gripper(self.task)
        if self.ticks_after_drop >= 0 and spec.goal is not GoalKind.POSE:
            raise ValueError(f'ticks_after_drop: {self.task} has no palm to drop an object from')
        if self.drop_is_lost and (self.ticks_after_drop < 0 or self.reward_type != 'sparse'):
            raise ValueError('drop_is_lost needs ticks_after_drop of 0 or more and sparse rewards')
        self._require_rotation(spec)

    def _require_rotation(self, spec: TaskSpec) -> None:
        for name in ('reward_rotation', 'first_rotation'):
            if spec.rotation_threshold is None and getattr(self, name) != 1.0:
                raise ValueError(f'{name}: goals of {self.task} have no rotation')

    def _contradictions(self) -> list[tuple[bool, str]]:
        """Fields that exclude each other, or that nothing would look at, and why."""
        sources = self.goals or self.strategy
        replays_later = 'future' in sources or 'near' in sources
        conditioned, chosen = self.condition != 'none', self.goal_choice != 'uniform'
        weighted, on_policy = self.importance != 'none', self.algorithm == 'ppo'
        others = self._set_for_ddpg() if on_policy else []
        return [
            *self._contradictions_of_rates(),
            *self._contradictions_of_subgoals(),
            (
                self.correction != 'none' and self.n_step == 1,
                f'correction {self.correction} needs n_step above 1',
            ),
            (
                self.aggregate != 'mean' and self.critics == 1,
                f'aggregate {self.aggregate} needs critics above 1',
            ),
            (
                self.norm != 'none' and self.layer_norm,
                f'norm {self.norm} excludes layer_norm, which is for the critic too',
            ),
            (
                self.norm == 'batch' and self.target != 'none',
                'norm batch needs target none: both values come from one pass',
            ),
            (
                chosen and not replays_later,
                f'goal_choice {self.goal_choice} needs future or near goals',
            ),
            (
                self.goal_choice == 'uncertain' and self.critics == 1,
                'goal_choice uncertain needs critics above 1',
            ),
            (
                conditioned and (chosen or weighted),
                f'condition {self.condition} excludes goal_choice and importance',
            ),
            (
                self.condition == 'horizon' and self.n_step > 1,
                'condition horizon excludes n_step above 1',
            ),
            (
                self.condition == 'threshold' and self.reward_type == 'dense',
                'condition threshold needs reward_type sparse',
            ),
            (
                self.narrows and (conditioned or self.reward_type == 'dense'),
                'first_distance and first_rotation need reward_type sparse and condition none',
            ),
            (
                self.narrows and self.subgoal_every > 0,
                'first_distance and first_rotation exclude subgoal_every',
            ),
            (weighted and self.n_step > 1, f'importance {self.importance} excludes n_step above 1'),
            (
                weighted and self.strategy == 'none' and not self.goals,
                f'importance {self.importance} needs goals chosen in hindsight',
            ),
            (
                weighted and on_policy != (self.importance == 'decision'),
                f'importance {self.importance} excludes algorithm {self.algorithm}',
            ),
            (on_policy and self.noise_std == 0.0, 'algorithm ppo needs noise_std above 0'),
            (bool(others), f'algorithm ppo needs {", ".join(others)}'),
            (
                bool(self.init_from) and not self.has_plain_networks,
                'init_from excludes algorithm ppo, condition, norm, advantage, subgoal_every, '
                'critics and longest_hold above 1',
            ),
        ]

    def _set_for_ddpg(self) -> list[str]:
        """What `ppo` would not look at, as it has to be: `name=value`."""
        return [
            f'{name}={str(value).lower()}'
            for name, value in ON_POLICY.items()
            if getattr(self, name) != value
        ]

    def _contradictions_of_rates(self) -> list[tuple[bool, str]]:
        """The same of what is for other rates than 25 Hz."""
        holds, several = self.longest_hold > 1, self.n_step > 1
        chosen = self.goal_choice != 'uniform'
        weighted = self.importance != 'none'
        return [
            (
                0.0 < self.noise_seconds * self.control_hz < 1.0 - 1e-6,
                f'noise_seconds {self.noise_seconds:g} is less than a tick of '
                f'{1.0 / self.control_hz:g} s',
            ),
            (
                self.parameter_noise and self.noise_spread > 0.0,
                'parameter_noise excludes noise_spread: its copies are alike',
            ),
            (
                holds and (several or self.noise_seconds > 0.0 or self.parameter_noise),
                'longest_hold above 1 excludes n_step above 1, noise_seconds and parameter_noise',
            ),
            (
                holds and (self.condition == 'horizon' or weighted or chosen),
                'longest_hold above 1 excludes condition horizon, importance and goal_choice',
            ),
            (
                holds and self.gamble,
                'longest_hold above 1 excludes gamble',
            ),
            (
                self.advantage and self.discount != 'time',
                'advantage needs discount time: it is per 40 ms',
            ),
            (
                self.advantage and (self.critics > 1 or self.norm == 'batch'),
                'advantage excludes critics above 1 and norm batch',
            ),
            (
                self.advantage and (several or holds),
                'advantage is of one tick: it excludes n_step and longest_hold above 1',
            ),
            (
                self.advantage and (weighted or chosen),
                'advantage excludes importance and goal_choice',
            ),
        ]

    def _contradictions_of_subgoals(self) -> list[tuple[bool, str]]:
        """The same of a high level."""
        guided, every = self.subgoal_every > 0, self.subgoal_every
        conditioned, chosen = self.condition != 'none', self.goal_choice != 'uniform'
        return [
            (
                guided and every > self._episode_ticks,
                f'subgoal_every {every} is longer than an episode',
            ),
            (
                guided and (self.n_step > 1 or self.longest_hold > 1 or self.parameter_noise),
                'subgoal_every excludes n_step and longest_hold above 1 and parameter_noise',
            ),
            (
                guided and (conditioned or chosen or self.importance != 'none' or self.advantage),
                'subgoal_every excludes condition, goal_choice, importance and advantage',
            ),
            (
                guided and self.ticks_after_drop >= 0,
                'subgoal_every excludes ticks_after_drop',
            ),
            (
                guided and self.reward_type != 'sparse',
                'subgoal_every needs reward_type sparse: a subgoal is reached or missed',
            ),
            (
                self.subgoal_prior > 0.0 and (guided or conditioned or self.advantage),
                'subgoal_prior excludes subgoal_every, condition and advantage',
            ),
            (
                self.subgoal_prior > 0.0 and self.longest_hold > 1,
                'subgoal_prior excludes longest_hold above 1',
            ),
        ]


PLAIN_NETWORKS: dict[str, Any] = {
    'algorithm': 'ddpg',
    'critics': 1,
    'norm': 'none',
    'condition': 'none',
    'longest_hold': 1,
    'advantage': False,
    'subgoal_every': 0,
}
"""Fields that decide what kind of networks there are, as most runs have them."""


def require_idle_gripper(task: str) -> None:
    """Refuses a task that has no action to spare for a gamble.

    Raises:
        ValueError: One line names the tasks that have.
    """
    if task not in GAMBLE_TASKS:
        allowed = ', '.join(GAMBLE_TASKS)
        raise ValueError(f'gamble: {task} uses its gripper; allowed: {allowed}')


ON_POLICY: dict[str, Any] = {
    'overlap': False,
    'random_epsilon': 0.0,
    'noise_spread': 0.0,
    'final_exploration': 1.0,
    'random_steps': 0,
    'moved_share': 0.0,
    'ticks_after_drop': -1,
    'first_distance': 1.0,
    'first_rotation': 1.0,
    'goal_choice': 'uniform',
    'condition': 'none',
    'n_step': 1,
    'discount': 'tick',
    'advantage': False,
    'noise_seconds': 0.0,
    'parameter_noise': False,
    'longest_hold': 1,
    'subgoal_every': 0,
    'subgoal_prior': 0.0,
    'critics': 1,
    'norm': 'none',
    'target': 'polyak',
}
"""Fields that `ppo` has no choice of: it learns from what its own noise did, and from values of
states."""
CHOICES = {
    'recipe': RECIPES,
    'algorithm': ('ddpg', 'ppo'),
    'reward_type': REWARD_TYPES,
    'success_rule': SUCCESS_RULES,
    'strategy': ('final', 'future', 'episode', 'random', 'futureactual', 'none'),
    'goal_features': GOAL_FEATURES,
    'episode_weights': ('moved', 'energy'),
    'importance': ('none', 'density', 'decision'),
    'goal_choice': ('uniform', *GOAL_CHOICES),
    'condition': ('none', 'threshold', 'horizon'),
    'correction': CORRECTIONS,
    'target': ('polyak', 'none'),
    'norm': ('none', 'layer', 'batch'),
    'aggregate': ('mean', 'min', 'truncated'),
    'discount': ('tick', 'time'),
    'precision': ('auto', 'float32', 'bfloat16'),
    'device': ('auto', 'cpu', 'cuda'),
}
"""Allowed values of the fields that have a few."""
_INFINITY = float('inf')
RANGES = (
    ('seed', 0, 2**31 - 1),
    ('hindsight_k', 1, 1000),
    ('reward_distance', 1e-3, 1000),
    ('reward_rotation', 1e-3, 1000),
    ('first_distance', 1, 1000),
    ('first_rotation', 1, 1000),
    ('moved_share', 0, 1),
    ('ticks_after_drop', -1, _INFINITY),
    ('n_step', 1, 100),
    ('trace', 0, 1 - 1e-6),
    ('cut_distance', 0, 2),
    ('critics', 1, 100),
    ('noise_spread', 0, 1),
    ('noise_seconds', 0, 10),
    ('longest_hold', 1, 1000),
    ('subgoal_every', 0, 1000),
    ('subgoal_prior', 0, _INFINITY),
    ('critic_first', 0, _INFINITY),
    ('total_steps', 1, _INFINITY),
    ('time_limit', 0, _INFINITY),
    ('success_target', 0, 1),
    ('num_envs', 1, 100_000),
    ('updates_per_cycle', 0, 100_000),
    ('batch_size', 1, 1_000_000),
    ('replay_transitions', 1, _INFINITY),
    ('random_steps', 0, _INFINITY),
    ('learning_starts', 0, _INFINITY),
    ('kept_transitions', 0, _INFINITY),
    ('future_only_steps', 0, _INFINITY),
    ('learning_rate', 0, 1),
    ('final_learning_rate', 0, 1),
    ('actor_average', 0, 1 - 1e-6),
    ('gamma', 0, 1 - 1e-6),
    ('action_l2', 0, _INFINITY),
    ('polyak', 0, 1),
    ('target_update_interval', 1, _INFINITY),
    ('random_epsilon', 0, 1),
    ('noise_std', 0, _INFINITY),
    ('final_exploration', 0, 1),
    ('evaluate_every', 1, _INFINITY),
    ('evaluation_episodes', 1, 1_000_000),
    ('checkpoint_seconds', 0, _INFINITY),
    ('simulation_threads', 0, 1024),
    ('torch_threads', 0, 1024),
)
"""Least and largest value of the fields that have them."""


def parse_assignment(text: str) -> tuple[str, Any]:
    """Parses `name=value` into a field of `TrainConfig` and a value of its type.

    Raises:
        ValueError: If there is no such field or the value does not fit its type.
    """
    name, separator, value = text.partition('=')
    hints = typing.get_type_hints(TrainConfig)
    if not separator or name not in hints:
        raise ValueError(f'{text!r} is not name=value; names: {", ".join(hints)}')
    try:
        return name, _parse(value, hints[name])
    except ValueError:
        kind = getattr(hints[name], '__name__', str(hints[name]))
        raise ValueError(f'{name} {value!r} is not of type {kind}') from None


def _parse(value: str, kind: Any) -> Any:
    if kind is bool:
        choices = {'true': True, 'false': False, '1': True, '0': False}
        if value.lower() not in choices:
            raise ValueError(value)
        return choices[value.lower()]
    if isinstance(kind, types.GenericAlias):
        return tuple(int(part) for part in value.split(',') if part)
    if kind is int:
        return int(value.replace('_', ''))
    return kind(value)


def config_from_dict(values: dict[str, Any]) -> TrainConfig:
    """Rebuilds a configuration from `dataclasses.asdict` that went through JSON.

    Fields that came later have their default.

    Raises:
        ValueError: If a field is unknown or a value not allowed.
    """
    hints = typing.get_type_hints(TrainConfig)
    unknown = sorted(values.keys() - hints.keys())
    if unknown:
        raise ValueError(f'unknown configuration fields: {", ".join(unknown)}')
    return TrainConfig(**{name: _typed(name, value, hints[name]) for name, value in values.items()})


def _typed(name: str, value: Any, kind: Any) -> Any:
    """A value from JSON as its field has it."""
    if isinstance(kind, types.GenericAlias):
        fits = isinstance(value, list | tuple) and all(type(part) is int for part in value)
        value = tuple(value) if fits else value
    else:
        fits = type(value) is kind or (kind is float and type(value) is int)
    if not fits:
        raise ValueError(f'{name} {value!r} is not of type {getattr(kind, "__name__", kind)}')
    return value
