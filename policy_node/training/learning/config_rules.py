"""What a training configuration allows: values of fields, and which fields exclude each other."""

from __future__ import annotations

from typing import Any

from msgs_spec.tasks import REWARD_TYPES, SUCCESS_RULES, GoalKind, TaskSpec, task_spec
from policy_node.policies.goal_features import GOAL_FEATURES, goal_features
from policy_node.training.learning.config_fields import ConfigFields
from policy_node.training.learning.goal_choice import GOAL_CHOICES
from policy_node.training.learning.hindsight import parse_mixture
from policy_node.training.learning.multi_step import CORRECTIONS

RECIPES = ('paper', 'best')
# Tasks that ignore their gripper action.
GAMBLE_TASKS = ('FetchReach', 'FetchPush')
_PLAIN_NETWORKS: dict[str, Any] = {
    'algorithm': 'ddpg',
    'critics': 1,
    'norm': 'none',
    'condition': 'none',
    'longest_hold': 1,
    'advantage': False,
    'subgoal_every': 0,
}
"""Fields that decide what kind of networks there are, as most runs have them."""
_ON_POLICY: dict[str, Any] = {
    'overlap': False,
    'random_epsilon': 0.0,
    'noise_spread': 0.0,
    'final_exploration': 1.0,
    'random_steps': 0,
    'moved_share': 0.0,
    'ticks_after_drop': -1,
    'first_distance': 1.0,
    'first_rotation': 1.0,
    'narrow_above': 0.0,
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
    ('narrow_above', 0, 1),
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


def require_allowed(config: ConfigFields) -> None:
    """Refuses values that are not allowed, and fields that exclude each other.

    Raises:
        ValueError: One line names the field, what was given and what is allowed.
    """
    spec = task_spec(config.task)
    for name, allowed in CHOICES.items():
        value = getattr(config, name)
        if value not in allowed:
            raise ValueError(f'{name} {value!r}; allowed: {", ".join(allowed)}')
    for name, lowest, highest in RANGES:
        value = getattr(config, name)
        if not lowest <= value <= highest:
            raise ValueError(f'{name} {value}; allowed: {lowest:.6g} ... {highest:.6g}')
    goal_features(config.goal_features, spec)
    _refuse_what_has_no_effect(config, spec)
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ValueError(f'hidden_sizes {config.hidden_sizes}; allowed: one or more widths >= 1')


def unusual_networks(config: ConfigFields) -> list[str]:
    """Fields, `name value`, by which a run has networks that few others could start from."""
    found = {name: getattr(config, name) for name in _PLAIN_NETWORKS}
    return [f'{name} {value}' for name, value in found.items() if value != _PLAIN_NETWORKS[name]]


def require_idle_gripper(task: str) -> None:
    """Refuses a task that has no action to spare for a gamble.

    Raises:
        ValueError: One line names the tasks that have.
    """
    if task not in GAMBLE_TASKS:
        allowed = ', '.join(GAMBLE_TASKS)
        raise ValueError(f'gamble: {task} uses its gripper; allowed: {allowed}')


def _refuse_what_has_no_effect(config: ConfigFields, spec: TaskSpec) -> None:
    if config.goals:
        parse_mixture(config.goals)
        if config.strategy == 'none':
            raise ValueError(f'goals {config.goals!r} excludes strategy none')
    for wrong, reason in _contradictions(config):
        if wrong:
            raise ValueError(reason)
    if config.gamble:
        require_idle_gripper(config.task)
    if config.ticks_after_drop >= 0 and spec.goal is not GoalKind.POSE:
        raise ValueError(f'ticks_after_drop: {config.task} has no palm to drop an object from')
    if config.drop_is_lost and (config.ticks_after_drop < 0 or config.reward_type != 'sparse'):
        raise ValueError('drop_is_lost needs ticks_after_drop of 0 or more and sparse rewards')
    _require_rotation(config, spec)


def _require_rotation(config: ConfigFields, spec: TaskSpec) -> None:
    for name in ('reward_rotation', 'first_rotation'):
        if spec.rotation_threshold is None and getattr(config, name) != 1.0:
            raise ValueError(f'{name}: goals of {config.task} have no rotation')


def _contradictions(config: ConfigFields) -> list[tuple[bool, str]]:
    """Fields that exclude each other, or that nothing would look at, and why."""
    sources = config.goals or config.strategy
    replays_later = 'future' in sources or 'near' in sources
    conditioned, chosen = config.condition != 'none', config.goal_choice != 'uniform'
    weighted, on_policy = config.importance != 'none', config.algorithm == 'ppo'
    others = _set_for_ddpg(config) if on_policy else []
    unusual = unusual_networks(config)
    return [
        *_contradictions_of_rates(config),
        *_contradictions_of_subgoals(config),
        (
            config.correction != 'none' and config.n_step == 1,
            f'correction {config.correction} needs n_step above 1',
        ),
        (
            config.aggregate != 'mean' and config.critics == 1,
            f'aggregate {config.aggregate} needs critics above 1',
        ),
        (
            config.norm != 'none' and config.layer_norm,
            f'norm {config.norm} excludes layer_norm, which is for the critic too',
        ),
        (
            config.norm == 'batch' and config.target != 'none',
            'norm batch needs target none: both values come from one pass',
        ),
        (
            chosen and not replays_later,
            f'goal_choice {config.goal_choice} needs future or near goals',
        ),
        (
            config.goal_choice == 'uncertain' and config.critics == 1,
            'goal_choice uncertain needs critics above 1',
        ),
        (
            conditioned and (chosen or weighted),
            f'condition {config.condition} excludes goal_choice and importance',
        ),
        (
            config.condition == 'horizon' and config.n_step > 1,
            'condition horizon excludes n_step above 1',
        ),
        (
            config.condition == 'threshold' and config.reward_type == 'dense',
            'condition threshold needs reward_type sparse',
        ),
        (
            config.narrows and (conditioned or config.reward_type == 'dense'),
            'first_distance and first_rotation need reward_type sparse and condition none',
        ),
        (
            config.narrow_above > 0 and not config.narrows,
            'narrow_above needs first_distance or first_rotation above 1',
        ),
        (
            config.narrows and config.subgoal_every > 0,
            'first_distance and first_rotation exclude subgoal_every',
        ),
        (weighted and config.n_step > 1, f'importance {config.importance} excludes n_step above 1'),
        (
            weighted and config.strategy == 'none' and not config.goals,
            f'importance {config.importance} needs goals chosen in hindsight',
        ),
        (
            weighted and on_policy != (config.importance == 'decision'),
            f'importance {config.importance} excludes algorithm {config.algorithm}',
        ),
        (on_policy and config.noise_std == 0.0, 'algorithm ppo needs noise_std above 0'),
        (bool(others), f'algorithm ppo needs {", ".join(others)}'),
        (bool(config.init_from and unusual), f'init_from excludes {", ".join(unusual)}'),
    ]


def _set_for_ddpg(config: ConfigFields) -> list[str]:
    """What `ppo` would not look at, as it has to be: `name=value`."""
    return [
        f'{name}={str(value).lower()}'
        for name, value in _ON_POLICY.items()
        if getattr(config, name) != value
    ]


def _contradictions_of_rates(config: ConfigFields) -> list[tuple[bool, str]]:
    """The same of what is for other rates than 25 Hz."""
    holds, several = config.longest_hold > 1, config.n_step > 1
    chosen = config.goal_choice != 'uniform'
    weighted = config.importance != 'none'
    return [
        (
            0.0 < config.noise_seconds * config.control_hz < 1.0 - 1e-6,
            f'noise_seconds {config.noise_seconds:g} is less than a tick of '
            f'{1.0 / config.control_hz:g} s',
        ),
        (
            config.parameter_noise and config.noise_spread > 0.0,
            'parameter_noise excludes noise_spread: its copies are alike',
        ),
        (
            holds and (several or config.noise_seconds > 0.0 or config.parameter_noise),
            'longest_hold above 1 excludes n_step above 1, noise_seconds and parameter_noise',
        ),
        (
            holds and (config.condition == 'horizon' or weighted or chosen),
            'longest_hold above 1 excludes condition horizon, importance and goal_choice',
        ),
        (
            holds and config.gamble,
            'longest_hold above 1 excludes gamble',
        ),
        (
            config.advantage and config.discount != 'time',
            'advantage needs discount time: it is per 40 ms',
        ),
        (
            config.advantage and (config.critics > 1 or config.norm == 'batch'),
            'advantage excludes critics above 1 and norm batch',
        ),
        (
            config.advantage and (several or holds),
            'advantage is of one tick: it excludes n_step and longest_hold above 1',
        ),
        (
            config.advantage and (weighted or chosen),
            'advantage excludes importance and goal_choice',
        ),
    ]


def _contradictions_of_subgoals(config: ConfigFields) -> list[tuple[bool, str]]:
    """The same of a high level."""
    guided, every = config.subgoal_every > 0, config.subgoal_every
    conditioned, chosen = config.condition != 'none', config.goal_choice != 'uniform'
    return [
        (
            guided and every > task_spec(config.task, control_hz=config.control_hz).episode_ticks,
            f'subgoal_every {every} is longer than an episode',
        ),
        (
            guided and (config.n_step > 1 or config.longest_hold > 1 or config.parameter_noise),
            'subgoal_every excludes n_step and longest_hold above 1 and parameter_noise',
        ),
        (
            guided and (conditioned or chosen or config.importance != 'none' or config.advantage),
            'subgoal_every excludes condition, goal_choice, importance and advantage',
        ),
        (
            guided and config.ticks_after_drop >= 0,
            'subgoal_every excludes ticks_after_drop',
        ),
        (
            guided and config.reward_type != 'sparse',
            'subgoal_every needs reward_type sparse: a subgoal is reached or missed',
        ),
        (
            config.subgoal_prior > 0.0 and (guided or conditioned or config.advantage),
            'subgoal_prior excludes subgoal_every, condition and advantage',
        ),
        (
            config.subgoal_prior > 0.0 and config.longest_hold > 1,
            'subgoal_prior excludes longest_hold above 1',
        ),
    ]
