"""The studies, as data: the paper's comparison, nine requests for research, one about the recipe.

Settings are those of the `best` recipe, or of another named one, except for the values here.
"""

from __future__ import annotations

from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.studies.study import Arm, Study

# FetchReach in cycles of 16 episodes, to resolve its first thousands of steps.
_REACH = {
    'num_envs': 16,
    'updates_per_cycle': 40,
    'batch_size': 256,
    'total_steps': 16_000,
    'evaluate_every': 1_600,
    'evaluation_episodes': 32,
}
_EVALUATED = {'evaluate_every': 19_200, 'evaluation_episodes': 64}
_PUSH = {'total_steps': 600_000, **_EVALUATED}
# Long runs learn most of their time. Products in bfloat16 halve it on processors that have them,
# and stay repeatable.
_LONG = {**_EVALUATED, 'precision': 'bfloat16'}
# Without imagined subgoals, which `best` has since one of these studies.
_PICK = {**_LONG, 'total_steps': 800_000, 'subgoal_prior': 0.0}
# From the shipped actor, which can push and has never gambled. An untrained actor would gamble by
# accident before it learns to push. Random actions are rarer than in the recipe; otherwise half of
# the episodes would gamble.
_SKILLED_PUSH = {
    **_LONG,
    'total_steps': 320_000,
    'init_from': 'FetchPush',
    'learning_starts': 20_000,
    'random_epsilon': 0.1,
}
_SLIDE = {**_LONG, 'total_steps': 2_000_000, 'evaluate_every': 64_000}
HAND: dict[str, Any] = {**_LONG, 'total_steps': 1_000_000, 'evaluate_every': 64_000}
_SCREENED = {'evaluate_every': 64_000, 'evaluation_episodes': 128}
# Sparse rewards; the recipe of the task has dense ones.
_SPARSE_HAND_REACH = {
    **_LONG,
    'total_steps': 640_000,
    'evaluate_every': 32_000,
    'reward_type': 'sparse',
    'action_l2': 0.1,
    'gamma': 0.95,
}
# Learn from the episodes of a cycle about ten times; the policy has its own noise.
_ON_POLICY = {
    'algorithm': 'ppo',
    'random_epsilon': 0.0,
    'noise_std': 0.3,
    'action_l2': 0.0,
    'moved_share': 0.0,
    'final_exploration': 1.0,
    'learning_rate': 3e-4,
    'trace': 0.95,
    'num_envs': 64,
    'batch_size': 1024,
    'updates_per_cycle': 40,
}
# Pushes are rare. So there are four times the episodes and goals, more noise and smaller steps.
# The remaining distance is an input. New states have low values; the first actions are small.
_ON_POLICY_PUSH = {
    **_ON_POLICY,
    'num_envs': 256,
    'updates_per_cycle': 200,
    'hindsight_k': 16,
    'noise_std': 0.5,
    'learning_rate': 2e-4,
    'action_l2': 0.003,
    'goal_features': 'relative',
    'first_value': -50.0,
    'first_action_gain': 0.01,
    'actor_average': 0.65,
}


def _arms(field: str, **labels: str) -> tuple[Arm, ...]:
    """Return a variant for each value of one field."""
    return tuple(Arm(name, label, {field: name}) for name, label in labels.items())


def _targets() -> tuple[Arm, ...]:
    """Return targets at four intervals, and no targets with three normalisations."""
    slow = [
        Arm(
            f'polyak{interval}',
            f'target moves every {interval} updates',
            {'target': 'polyak', 'target_update_interval': interval},
        )
        for interval in (10, 1, 4, 40)
    ]
    none = [
        Arm(f'none_{norm}', f'no target network, norm {norm}', {'target': 'none', 'norm': norm})
        for norm in ('none', 'layer', 'batch')
    ]
    layer = Arm(
        'polyak10_layer',
        'target moves every 10 updates, norm layer',
        {'target': 'polyak', 'target_update_interval': 10, 'norm': 'layer'},
    )
    return (*slow, layer, *none)


def _returns() -> tuple[Arm, ...]:
    """Return one step, and longer returns with each correction."""
    longer = [
        Arm(
            f'{correction}{steps}',
            f'{steps} steps, correction {correction}',
            {'n_step': steps, 'correction': correction},
        )
        for steps in (3, 5, 10)
        for correction in ('none', 'lambda', 'cut')
    ]
    return (Arm('one', 'one step', {'n_step': 1}), *longer)


def _rates() -> tuple[Arm, ...]:
    """Return the recipe at 250, 125 and 25 Hz, and remedies at 250 Hz."""
    helps: dict[str, tuple[str, dict[str, Any]]] = {
        'discount': ('discount per 40 ms', {'discount': 'time'}),
        'noise': ('noise held for 40 ms', {'noise_seconds': 0.04}),
        'both': ('both', {'discount': 'time', 'noise_seconds': 0.04}),
        'steps': ('returns of 10 steps', {'n_step': 10}),
        'discount_steps': (
            'discount per 40 ms, returns of 10 steps',
            {'discount': 'time', 'n_step': 10},
        ),
        'noise_steps': (
            'noise held for 40 ms, returns of 10 steps',
            {'noise_seconds': 0.04, 'n_step': 10},
        ),
        'three': (
            'all three',
            {'discount': 'time', 'noise_seconds': 0.04, 'n_step': 10},
        ),
        'parameters': ('noise on weights', {'parameter_noise': True}),
        'skip': ('learned frame skip, up to 80 ms', {'longest_hold': 20}),
        'skip_discount': (
            'learned frame skip, discount per 40 ms',
            {'longest_hold': 20, 'discount': 'time'},
        ),
        'advantage': (
            'advantages (DAU), discount per 40 ms, noise held',
            {'advantage': True, 'discount': 'time', 'noise_seconds': 0.04},
        ),
    }
    plain = [
        Arm(
            f'plain{rate}',
            f'{rate} Hz, as it is',
            {'control_hz': float(rate), 'discount': 'tick'},
        )
        for rate in (250, 125, 25)
    ]
    arms = [
        Arm(name, f'250 Hz, {label}', {'control_hz': 250.0, **changes})
        for name, (label, changes) in helps.items()
    ]
    return (*plain, *arms)


def _ensembles() -> tuple[Arm, ...]:
    """Return one critic, several with each aggregation, quantiles, and more updates per step."""
    several = [
        Arm(
            f'{aggregate}{critics}',
            f'{critics} critics, {aggregate}',
            {'critics': critics, 'aggregate': aggregate},
        )
        for critics, aggregate in (
            (2, 'mean'),
            (2, 'min'),
            (5, 'mean'),
            (5, 'min'),
            (5, 'truncated'),
        )
    ]
    quantiles = [
        Arm('quantiles', 'one critic of 25 quantiles', {'quantiles': 25}),
        Arm(
            'tqc2',
            '2 critics of 25 quantiles, truncated (TQC)',
            {'critics': 2, 'quantiles': 25, 'aggregate': 'truncated'},
        ),
    ]
    more = [
        Arm(f'updates{times}', f'{times} times the updates', factors={'updates_per_cycle': times})
        for times in (2, 4)
    ]
    # With more updates, targets also move faster.
    slow = Arm(
        'updates4_slow',
        '4 times the updates, targets as slow as before',
        factors={'updates_per_cycle': 4, 'target_update_interval': 4},
    )
    return (Arm('one', 'one critic', {'critics': 1}), *several, *quantiles, *more, slow)


_NO_HINDSIGHT = {'strategy': 'none', 'goals': ''}


def _paper_settings(task: str) -> dict[str, Any]:
    """Return the settings of a task: about a quarter of an hour of one core per run.

    Fetch tasks have 1.2 % (FetchReach) or 32 % of the paper's steps and smaller batches. One
    collection of 76 episodes replaces two of 38, with twice the updates. Targets move every 10
    updates instead of 40, because there are so few. Hand tasks use the recipe `best`, which learns
    in a million steps what the paper's recipe learns in many. Long runs compute in bfloat16.
    """
    if not task.startswith('Fetch'):
        return HAND
    scaled = {
        'recipe': 'paper',
        'num_envs': 76,
        'updates_per_cycle': 80,
        'target_update_interval': 10,
        'replay_transitions': 1_000_000,
        # As many as simulations, so that no evaluation ends early.
        'evaluation_episodes': 76,
    }
    if task == 'FetchReach':
        return {**scaled, 'total_steps': 57_000, 'batch_size': 256, 'evaluate_every': 3_800}
    steps = {'total_steps': 1_500_000, 'evaluate_every': 38_000}
    return {**scaled, **steps, 'batch_size': 1024, 'precision': 'bfloat16'}


PAPER = Study(
    'paper',
    None,
    'What do hindsight and dense rewards do to DDPG, on every task of the paper?',
    {task: _paper_settings(task) for task in TASKS},
    (
        Arm('her_sparse', 'DDPG+HER, sparse', {'reward_type': 'sparse'}),
        Arm('her_dense', 'DDPG+HER, dense', {'reward_type': 'dense'}),
        Arm('ddpg_sparse', 'DDPG, sparse', {'reward_type': 'sparse', **_NO_HINDSIGHT}),
        Arm('ddpg_dense', 'DDPG, dense', {'reward_type': 'dense', **_NO_HINDSIGHT}),
    ),
)
"""The paper's comparison, the four curves in each panel of its figures."""

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        PAPER,
        Study(
            'goals',
            1,
            'Are goals worth more that the critic errs on, or that critics differ in?',
            {
                'FetchReach': _REACH,
                'FetchPush': {**_LONG, 'total_steps': 600_000},
                'FetchPickAndPlace': _PICK,
            },
            (
                Arm('uniform', 'any future goal', {'goal_choice': 'uniform', 'critics': 2}),
                Arm('bellman', 'greatest error of 8', {'goal_choice': 'bellman', 'critics': 2}),
                Arm('uncertain', 'widest gap of 8', {'goal_choice': 'uncertain', 'critics': 2}),
            ),
        ),
        Study(
            'unbiased',
            2,
            'Does hindsight take a gamble for a sure thing, and what cures it?',
            {
                'FetchReach': {**_REACH, 'gamble': True},
                'FetchPush': {**_SKILLED_PUSH, 'gamble': True},
            },
            (
                Arm('future', 'future goals', {'strategy': 'future'}),
                Arm(
                    'weighted',
                    'half future, half actual, importance weights',
                    {'goals': 'future=.4,actual=.4', 'importance': 'density'},
                ),
                Arm('actual', 'desired goals of any episode', {'goals': 'actual=.8'}),
                Arm('random', 'achieved goals of any episode', {'goals': 'random=.8'}),
                Arm('mixed', 'half future, half actual', {'goals': 'future=.4,actual=.4'}),
                Arm(
                    'displaced',
                    'half actual, half displaced',
                    {'goals': 'actual=.4,displaced=.4'},
                ),
                Arm('none', 'no hindsight', {'strategy': 'none'}),
            ),
        ),
        Study(
            'hierarchy',
            3,
            'Do subgoals get the actor to its goals in fewer steps?',
            {
                'FetchPickAndPlace': _PICK,
                'HandManipulateBlockRotateXYZ': HAND,
                'FetchReach': _REACH,
                'FetchPush': _PUSH,
                'FetchSlide': _SLIDE,
            },
            (
                Arm('flat', 'no subgoals', {'subgoal_every': 0}),
                Arm('every10', 'a subgoal every 10 ticks', {'subgoal_every': 10}),
                Arm('prior', 'imagined subgoals, weight .3', {'subgoal_prior': 0.3}),
                Arm(
                    'prior4',
                    'the same, imagination learnt every 4th time',
                    {'subgoal_prior': 0.3, 'imagination_interval': 4},
                ),
            ),
        ),
        Study(
            'values',
            4,
            'Do values of more than a goal help: of how close, or of how soon?',
            {'HandReach': _SPARSE_HAND_REACH, 'FetchReach': _REACH},
            (
                *_arms(
                    'condition',
                    none='the goal alone',
                    threshold='and the success threshold',
                    horizon='and the steps left',
                ),
                Arm(
                    'threshold32',
                    'and the success threshold, four times as wide',
                    {'condition': 'threshold', 'widest_threshold': 32.0},
                ),
                # The thresholds without the input.
                Arm(
                    'graded',
                    'the goal alone, graded rewards',
                    {'reward_grades': '.5,1,2,4,8,16,32'},
                ),
            ),
        ),
        Study(
            'targets',
            5,
            'Can targets move faster, or be left out?',
            {'FetchReach': _REACH, 'FetchPush': _PUSH, 'FetchPickAndPlace': _PICK},
            _targets(),
        ),
        Study(
            'returns',
            6,
            'Do returns of several steps help data that is far from the policy?',
            {'FetchReach': _REACH, 'FetchPush': _PUSH, 'FetchSlide': _SLIDE},
            _returns(),
        ),
        Study(
            'onpolicy',
            7,
            'Can an on-policy method use goals in hindsight?',
            {
                'FetchReach': {
                    **_REACH,
                    **_ON_POLICY,
                    'total_steps': 96_000,
                    'evaluate_every': 9_600,
                },
                'FetchPush': {**_LONG, **_ON_POLICY_PUSH, 'total_steps': 1_000_000},
            },
            (
                Arm('none', 'no hindsight', {'strategy': 'none'}),
                Arm('taken', 'goals in hindsight, as if acted for', {'strategy': 'future'}),
                Arm(
                    'weighed',
                    'goals in hindsight, weighed per decision',
                    {'strategy': 'future', 'importance': 'decision'},
                ),
                Arm(
                    'moved',
                    'as if acted for, 4 of 5 from episodes that moved something',
                    {'strategy': 'future', 'moved_share': 0.8},
                ),
                Arm('outcome', 'what other episodes brought about', {'goals': 'outcome=.9'}),
            ),
        ),
        Study(
            'ensembles',
            8,
            'Do several critics help, for the time that they cost?',
            {
                'FetchReach': _REACH,
                'FetchPickAndPlace': _PICK,
                'HandManipulateBlockRotateZ': HAND,
            },
            _ensembles(),
        ),
        Study(
            'rates',
            9,
            'What keeps learning alive where actions are very frequent?',
            {
                'FetchReach': {**_REACH, 'evaluation_episodes': 16},
                # A replay for all ticks of a run at 250 Hz.
                'FetchPush': {**_LONG, 'total_steps': 600_000, 'replay_transitions': 6_000_000},
            },
            _rates(),
        ),
        Study(
            'ingredients',
            None,
            'What does each part of the recipe for the hand buy?',
            {
                'HandManipulateEggRotate': {**_SCREENED, 'total_steps': 400_000},
                'HandManipulateBlockRotateXYZ': {**_SCREENED, 'total_steps': 400_000},
            },
            (
                Arm('best', 'the recipe'),
                Arm('plain', 'plain features', {'goal_features': 'plain'}),
                Arm('few', '13 samples per step, not 51', {'batch_size': 256}),
                Arm('future', 'future goals alone', {'strategy': 'future'}),
                Arm('graded', 'graded rewards', {'reward_grades': '.5,1,2'}),
                Arm(
                    'displaced',
                    'half as many future goals, displaced ones instead',
                    {'goals': 'future=.2,actual=.2,displaced=.4'},
                ),
                Arm(
                    'unbiased',
                    'displaced goals, no future ones',
                    {'goals': 'actual=.4,displaced=.4'},
                ),
                Arm('discount', 'discount 0.95, not 0.98', {'gamma': 0.95}),
                Arm(
                    'prior4',
                    'imagined subgoals',
                    {'subgoal_prior': 0.3, 'imagination_interval': 4},
                ),
                Arm('returns', 'returns of five steps', {'n_step': 5}),
            ),
            seeds=2,
        ),
    )
}
