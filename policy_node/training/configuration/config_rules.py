"""What a training configuration allows: values of fields, and which fields exclude each other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

from msgs_spec.disturbances import read_disturbances
from msgs_spec.tasks import (
    REWARD_TYPES,
    SUCCESS_RULES,
    GoalKind,
    TaskSpec,
    substeps_per_tick,
    task_spec,
)
from policy_node.policies.checkpoint import MOST_PAST_ACTIONS
from policy_node.policies.goal_features import GOAL_FEATURES, goal_features
from policy_node.training.configuration.config_fields import ConfigFields
from policy_node.training.goals.goal_choice import GOAL_CHOICES
from policy_node.training.goals.graded import parse_grades
from policy_node.training.goals.hindsight import FROM_THE_EPISODE, OUTCOME, parse_mixture
from policy_node.training.replay.multi_step import CORRECTIONS

# Recipes of runs that start from nothing.
FROM_NOTHING = ('paper', 'best', 'robust')
RECIPES = (*FROM_NOTHING, 'finetune')
# Tasks that ignore their gripper action.
GAMBLE_TASKS = ('FetchReach', 'FetchPush')
DEFAULTS = {field.name: field.default for field in dataclasses.fields(ConfigFields)}
_OF_NETWORKS = 'algorithm longest_hold advantage subgoal_every quantiles'.split()
"""Fields that decide what kind of networks there are; most runs have their defaults."""
_ON_POLICY = {
    'overlap': False,
    'random_epsilon': 0.0,
    **{
        name: DEFAULTS[name]
        for name in (
            'noise_spread final_exploration random_steps ticks_after_drop '
            'first_distance first_rotation narrow_above goal_choice condition n_step discount '
            'advantage noise_seconds parameter_noise longest_hold subgoal_every subgoal_prior '
            'critics quantiles norm target policy_delay target_noise temporal_smoothness'
        ).split()
    },
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
    ('past_actions', 0, MOST_PAST_ACTIONS),
    ('hindsight_k', 1, 1000),
    ('reward_distance', 1e-3, 1000),
    ('reward_rotation', 1e-3, 1000),
    ('reward_apart', 0, 1),
    ('retry_failed', 0, 0.9),
    ('first_distance', 1, 1000),
    ('first_rotation', 1, 1000),
    ('narrow_above', 0, 1),
    ('moved_share', 0, 1),
    ('ticks_after_drop', -1, _INFINITY),
    ('widest_threshold', 1, 10_000),
    ('n_step', 1, 100),
    ('trace', 0, 1 - 1e-6),
    ('cut_distance', 0, 2),
    ('critics', 1, 100),
    ('quantiles', 1, 1000),
    ('noise_spread', 0, 1),
    ('noise_seconds', 0, 10),
    ('longest_hold', 1, 1000),
    ('subgoal_every', 0, 1000),
    ('subgoal_prior', 0, _INFINITY),
    ('imagination_interval', 1, 1000),
    ('first_value', -1_000_000, 0),
    ('first_action_gain', 0, 1),
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
    ('temporal_smoothness', 0, _INFINITY),
    ('polyak', 0, 1),
    ('target_update_interval', 1, _INFINITY),
    ('policy_delay', 1, 1000),
    ('target_noise', 0, 1),
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


def _require_disturbances(config: ConfigFields) -> None:
    read_disturbances(config.disturbances)
    if config.past_actions and (config.longest_hold > 1 or config.parameter_noise):
        raise ValueError('past_actions needs longest_hold=1 and parameter_noise=False')


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
        if not math.isfinite(value):
            raise ValueError(f'{name} {value} is no finite number')
        if not lowest <= value <= highest:
            raise ValueError(f'{name} {value}; allowed: {_number(lowest)} ... {_number(highest)}')
    _require_disturbances(config)
    substeps_per_tick(config.control_hz)
    goal_features(config.goal_features, spec)
    if config.goals:
        parse_mixture(config.goals)
    if config.reward_grades:
        parse_grades(config.reward_grades)
    for reason in _contradictions(config, spec):
        raise ValueError(reason)
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ValueError(f'hidden_sizes {config.hidden_sizes}; allowed: one or more widths >= 1')


def _number(value: float) -> str:
    """A limit as text; a whole one to its last digit."""
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def unusual_networks(config: ConfigFields) -> list[str]:
    """Fields, `name value`, by which a run has networks that few others could start from."""
    found = {name: getattr(config, name) for name in _OF_NETWORKS}
    return [f'{name} {value}' for name, value in found.items() if value != DEFAULTS[name]]


def require_idle_gripper(task: str) -> None:
    """Refuses a task that has no action to spare for a gamble.

    Raises:
        ValueError: One line names the tasks that have.
    """
    if task not in GAMBLE_TASKS:
        allowed = ', '.join(GAMBLE_TASKS)
        raise ValueError(f'gamble: {task} uses its gripper; allowed: {allowed}')


def _contradictions(config: ConfigFields, spec: TaskSpec) -> Iterator[str]:
    """Why fields exclude each other, or why nothing would look at them."""
    if config.goals and config.strategy == 'none':
        yield f'goals {config.goals!r} excludes strategy none'
    if config.future_only_steps > 0 and (config.goals or config.strategy != 'futureactual'):
        yield 'future_only_steps above 0 needs strategy futureactual, and no goals'
    yield from _contradictions_of_noise(config)
    yield from _contradictions_of_rates(config)
    yield from _contradictions_of_subgoals(config)
    yield from _contradictions_of_values(config)
    yield from _contradictions_of_targets(config)
    yield from _contradictions_of_goals(config)
    yield from _contradictions_of_conditions(config)
    yield from _contradictions_of_importance(config)
    yield from _contradictions_of_algorithm(config)
    yield from _contradictions_of_task(config, spec)


def _contradictions_of_noise(config: ConfigFields) -> Iterator[str]:
    """Conflicts between kinds of exploration."""
    if 0.0 < config.noise_seconds * config.control_hz < 1.0 - 1e-6:
        tick = 1.0 / config.control_hz
        yield f'noise_seconds {config.noise_seconds:g} is less than a tick of {tick:g} s'
    holds_nothing = config.random_epsilon == 0.0 and config.random_steps == 0
    if config.parameter_noise and config.noise_seconds > 0.0 and holds_nothing:
        yield 'parameter_noise with noise_seconds above 0 needs random_epsilon or random_steps'
    if config.parameter_noise and config.noise_spread > 0.0:
        yield 'parameter_noise excludes noise_spread: its copies are alike'


def _contradictions_of_rates(config: ConfigFields) -> Iterator[str]:
    """Conflicts between fields for other rates than 25 Hz, and with other fields."""
    holds, several = config.longest_hold > 1, config.n_step > 1
    chosen, weighted = config.goal_choice != 'uniform', config.importance != 'none'
    if holds and (several or config.noise_seconds > 0.0 or config.parameter_noise):
        yield 'longest_hold above 1 excludes n_step above 1, noise_seconds and parameter_noise'
    if holds and (config.condition == 'horizon' or weighted or chosen):
        yield 'longest_hold above 1 excludes condition horizon, importance and goal_choice'
    if holds and config.gamble:
        yield 'longest_hold above 1 excludes gamble'
    if config.advantage and config.discount != 'time':
        yield 'advantage needs discount time: it is per 40 ms'
    if config.advantage and (config.critics > 1 or config.norm == 'batch'):
        yield 'advantage excludes critics above 1 and norm batch'
    if config.advantage and (several or holds):
        yield 'advantage is of one tick: it excludes n_step and longest_hold above 1'
    if config.advantage and (weighted or chosen or config.target_noise > 0.0):
        yield 'advantage excludes importance, goal_choice and target_noise'


def _contradictions_of_subgoals(config: ConfigFields) -> Iterator[str]:
    """Conflicts between subgoals, proposed or imagined, and other fields."""
    every, guided, imagined = (
        config.subgoal_every,
        config.subgoal_every > 0,
        config.subgoal_prior > 0,
    )
    conditioned, chosen = config.condition != 'none', config.goal_choice != 'uniform'
    if every > task_spec(config.task, control_hz=config.control_hz).episode_ticks:
        yield f'subgoal_every {every} is longer than an episode'
    if guided and (config.n_step > 1 or config.longest_hold > 1 or config.parameter_noise):
        yield 'subgoal_every excludes n_step and longest_hold above 1 and parameter_noise'
    if guided and (conditioned or chosen or config.importance != 'none' or config.advantage):
        yield 'subgoal_every excludes condition, goal_choice, importance and advantage'
    if guided and config.ticks_after_drop >= 0:
        yield 'subgoal_every excludes ticks_after_drop'
    if guided and (config.reward_type != 'sparse' or config.reward_grades):
        yield 'subgoal_every needs reward_type sparse: a subgoal is reached or missed'
    if imagined and (guided or conditioned or config.advantage):
        yield 'subgoal_prior excludes subgoal_every, condition and advantage'
    if config.imagination_interval > 1 and not imagined:
        yield 'imagination_interval above 1 needs subgoal_prior above 0'
    if imagined and config.longest_hold > 1:
        yield 'subgoal_prior excludes longest_hold above 1'


def _contradictions_of_values(config: ConfigFields) -> Iterator[str]:
    """Conflicts between fields of how values are learnt and of what is learnt from."""
    if config.learning_starts > config.replay_transitions:
        yield f'learning_starts needs replay_transitions of {config.learning_starts} or more'
    if config.correction != 'none' and config.n_step == 1:
        yield f'correction {config.correction} needs n_step above 1'
    traces = config.correction == 'lambda' or config.algorithm == 'ppo'
    if config.trace != DEFAULTS['trace'] and not traces:
        yield 'trace needs correction lambda, or algorithm ppo'
    if config.cut_distance != DEFAULTS['cut_distance'] and config.correction != 'cut':
        yield 'cut_distance needs correction cut'
    if config.episode_weights != DEFAULTS['episode_weights'] and config.moved_share == 0.0:
        yield f'episode_weights {config.episode_weights} needs moved_share above 0'
    truncates = config.aggregate == 'truncated' and config.quantiles > 1
    if config.aggregate != 'mean' and config.critics == 1 and not truncates:
        yield f'aggregate {config.aggregate} needs critics above 1'
    if config.temporal_smoothness > 0 and (config.n_step > 1 or config.longest_hold > 1):
        yield 'temporal_smoothness is of one tick: it excludes n_step and longest_hold above 1'
    if config.quantiles > 1 and config.aggregate == 'min':
        yield 'quantiles above 1 exclude aggregate min; allowed: mean, truncated'
    if config.quantiles > 1 and (config.norm == 'batch' or config.advantage):
        yield 'quantiles above 1 exclude norm batch and advantage'


def _contradictions_of_targets(config: ConfigFields) -> Iterator[str]:
    """Conflicts between the targets of values and what normalises them."""
    if config.target_noise > 0.0 and (config.longest_hold > 1 or config.subgoal_every > 0):
        yield 'target_noise excludes longest_hold above 1 and subgoal_every'
    if config.norm != 'none' and config.layer_norm:
        yield f'norm {config.norm} excludes layer_norm, which is for the critic too'
    if config.norm == 'batch' and config.target != 'none':
        yield 'norm batch needs target none: both values come from one pass'


def _contradictions_of_goals(config: ConfigFields) -> Iterator[str]:
    """Conflicts between the choice of goals, their thresholds and the reward."""
    sources = config.goals or config.strategy
    replays_later = 'future' in sources or 'near' in sources
    conditioned, chosen = config.condition != 'none', config.goal_choice != 'uniform'
    if chosen and not replays_later:
        yield f'goal_choice {config.goal_choice} needs future or near goals'
    if config.goal_choice == 'bellman' and (config.n_step > 1 or config.drop_is_lost):
        yield 'goal_choice bellman is of one step: it excludes n_step above 1 and drop_is_lost'
    if config.goal_choice == 'uncertain' and config.critics == 1:
        yield 'goal_choice uncertain needs critics above 1'
    if config.narrows and (conditioned or config.reward_type == 'dense'):
        yield 'first_distance and first_rotation need reward_type sparse and condition none'
    shares = config.reward_distance, config.reward_rotation
    if shares != (1.0, 1.0) and config.reward_type == 'dense':
        yield 'reward_distance and reward_rotation need reward_type sparse'
    if config.reward_grades and (conditioned or config.reward_type == 'dense'):
        yield 'reward_grades needs reward_type sparse and condition none'
    if config.narrow_above > 0 and not config.narrows:
        yield 'narrow_above needs first_distance or first_rotation above 1'
    if config.narrows and config.subgoal_every > 0:
        yield 'first_distance and first_rotation exclude subgoal_every'


def _contradictions_of_conditions(config: ConfigFields) -> Iterator[str]:
    """Conflicts between `condition`, one input more of the networks, and other fields."""
    others = config.goal_choice != 'uniform' or config.importance != 'none'
    if config.condition != 'none' and others:
        yield f'condition {config.condition} excludes goal_choice and importance'
    if config.condition == 'horizon' and config.n_step > 1:
        yield 'condition horizon excludes n_step above 1'
    if config.condition == 'horizon' and config.drop_is_lost:
        yield 'condition horizon excludes drop_is_lost: that is the loss of all steps to come'
    if config.widest_threshold != DEFAULTS['widest_threshold'] and config.condition != 'threshold':
        yield 'widest_threshold needs condition threshold'
    if config.condition == 'threshold' and config.reward_type == 'dense':
        yield 'condition threshold needs reward_type sparse'


def _contradictions_of_importance(config: ConfigFields) -> Iterator[str]:
    """Conflicts between importance weights and other fields."""
    if config.importance == 'none':
        return
    if config.n_step > 1:
        yield f'importance {config.importance} excludes n_step above 1'
    if config.strategy == 'none' and not config.goals:
        yield f'importance {config.importance} needs goals chosen in hindsight'
    if (config.algorithm == 'ppo') != (config.importance == 'decision'):
        yield f'importance {config.importance} excludes algorithm {config.algorithm}'
    if config.importance == 'density' and config.strategy == 'random' and not config.goals:
        yield 'importance density excludes strategy random: no goal follows from the transition'
    if not config.goals:
        return
    sources = set(parse_mixture(config.goals))
    if sources == {'real'}:
        yield f'importance {config.importance} needs goals chosen in hindsight'
    if config.importance == 'density' and sources <= set(FROM_THE_EPISODE):
        yield f'importance density needs other goals beside {config.goals!r}: actual, random'
    if config.importance == 'density' and sources.isdisjoint(FROM_THE_EPISODE):
        allowed = ', '.join(FROM_THE_EPISODE)
        yield f'importance density needs goals of the episode beside {config.goals!r}: {allowed}'


def _contradictions_of_algorithm(config: ConfigFields) -> Iterator[str]:
    """Conflicts between `algorithm`, or `init_from`, and other fields."""
    on_policy = config.algorithm == 'ppo'
    if config.goals and OUTCOME in parse_mixture(config.goals) and not on_policy:
        yield 'goals outcome needs algorithm ppo'
    for name in ('first_value', 'first_action_gain'):
        if getattr(config, name) != DEFAULTS[name] and not on_policy:
            yield f'{name} needs algorithm ppo'
    if on_policy and config.noise_std == 0.0:
        yield 'algorithm ppo needs noise_std above 0'
    needed = {name: value for name, value in _ON_POLICY.items() if getattr(config, name) != value}
    if on_policy and needed:
        others = (f'{name}={str(value).lower()}' for name, value in needed.items())
        yield f'algorithm ppo needs {", ".join(others)}'
    if config.init_from and (unusual := unusual_networks(config)):
        yield f'init_from excludes {", ".join(unusual)}'


def _contradictions_of_task(config: ConfigFields, spec: TaskSpec) -> Iterator[str]:
    """Conflicts between the task and what only some tasks have."""
    if config.gamble:
        require_idle_gripper(config.task)
    if config.ticks_after_drop >= 0 and spec.goal is not GoalKind.POSE:
        yield f'ticks_after_drop: {config.task} has no palm to drop an object from'
    if config.drop_is_lost and (config.ticks_after_drop < 0 or config.reward_type != 'sparse'):
        yield 'drop_is_lost needs ticks_after_drop of 0 or more and sparse rewards'
    for name in ('reward_rotation', 'first_rotation'):
        if spec.rotation_threshold is None and getattr(config, name) != 1.0:
            yield f'{name}: goals of {config.task} have no rotation'
    for name in ('reward_distance', 'first_distance'):
        if not spec.position_counts and getattr(config, name) != 1.0:
            yield f'{name}: the position of goals of {config.task} does not count'
    poses = spec.position_counts and spec.rotation_threshold is not None
    if config.reward_apart > 0 and not (config.reward_grades and poses):
        yield 'reward_apart needs reward_grades, and goals of position and rotation'
