"""Definitions of the studies: the paper's comparison, nine requests for research, one recipe study.

The settings are changes to the recipe `best`, or to the recipe that a study names.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.studies.study import Arm, Study

# FetchReach in cycles of 16 episodes, to resolve its first thousands of steps. Actions cost as much
# as in `best` at the time of these studies.
_REACH = {
    'num_envs': 16,
    'action_l2': 0.1,
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
# Without what `best` has since these studies.
_SLIDE = {
    **_LONG,
    'total_steps': 2_000_000,
    'evaluate_every': 64_000,
    'goal_features': 'plain',
    'reward_grades': '',
    'policy_delay': 1,
    'actor_average': 0.9,
    'final_exploration': 1.0,
}
# Without the rarer updates of the actor and the smaller batches that `best` has for some tasks
# since these studies.
_HAND_RUN = {'evaluate_every': 64_000, 'policy_delay': 1, 'batch_size': 1024}
HAND: dict[str, Any] = {**_LONG, **_HAND_RUN, 'total_steps': 1_000_000}
_SCREENED = {**_HAND_RUN, 'total_steps': 400_000, 'evaluation_episodes': 128}
# Imagined subgoals, learnt every fourth time.
_RARE_PRIOR: dict[str, Any] = {'subgoal_prior': 0.3, 'imagination_interval': 4}
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


def _arm(name: str, label: str, **changes: Any) -> Arm:
    return Arm(name, label, changes)


# Hand tasks of the paper's study whose stored runs computed in bfloat16.
_IN_BFLOAT16 = 'HandReach', 'HandManipulateBlockRotateZ', 'HandManipulateEggRotate'


def _paper_settings(task: str) -> dict[str, Any]:
    """Return the settings of a task in the study `paper`, for runs of 15 minutes on one core.

    Fetch tasks have 1.2 % (FetchReach) or 32 % of the paper's steps and smaller batches. One
    collection of 76 episodes replaces two of 38, with twice the updates. Targets move every 10
    updates instead of 40, because a run has few updates. Hand tasks use the recipe `best`, which
    learns in a million steps what the paper's recipe learns in many millions. Three hand
    tasks and all Fetch tasks but FetchReach compute in bfloat16. The other hand tasks compute in
    float32, as their stored runs did.
    """
    if not task.startswith('Fetch'):
        return HAND if task in _IN_BFLOAT16 else {**HAND, 'precision': 'float32'}
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


def _returns() -> Iterator[Arm]:
    """Yield variants with returns of 1 step, and of 3, 5 or 10 steps for each `correction`."""
    yield _arm('one', 'one step', n_step=1)
    for steps, correction in product((3, 5, 10), ('none', 'lambda', 'cut')):
        label = f'{steps} steps, correction {correction}'
        yield _arm(f'{correction}{steps}', label, n_step=steps, correction=correction)


def _targets() -> Iterator[Arm]:
    """Yield variants with target networks, and without them for each critic normalisation."""
    slow: dict[str, Any] = {'target': 'polyak', 'target_update_interval': 10}
    for updates in (10, 1, 4, 40):
        label = f'target moves every {updates} updates'
        yield _arm(f'polyak{updates}', label, **slow | {'target_update_interval': updates})
    yield _arm('polyak10_layer', 'target moves every 10 updates, norm layer', **slow, norm='layer')
    for norm in ('none', 'layer', 'batch'):
        yield _arm(f'none_{norm}', f'no target network, norm {norm}', target='none', norm=norm)


def _ensembles() -> Iterator[Arm]:
    """Yield variants with one critic, several critics, critics of quantiles, and more updates."""
    yield _arm('one', 'one critic', critics=1)
    for number, pooling in ((2, 'mean'), (2, 'min'), (5, 'mean'), (5, 'min'), (5, 'truncated')):
        label = f'{number} critics, {pooling}'
        yield _arm(f'{pooling}{number}', label, critics=number, aggregate=pooling)
    yield _arm('quantiles', 'one critic of 25 quantiles', quantiles=25)
    tqc = {'critics': 2, 'quantiles': 25, 'aggregate': 'truncated'}
    yield _arm('tqc2', '2 critics of 25 quantiles, truncated (TQC)', **tqc)
    for times in (2, 4):
        more = {'updates_per_cycle': times}
        yield Arm(f'updates{times}', f'{times} times the updates', factors=more)
    # With more updates, targets also move faster.
    more = {'updates_per_cycle': 4, 'target_update_interval': 4}
    yield Arm('updates4_slow', '4 times the updates, targets as slow as before', factors=more)


def _rates() -> Iterator[Arm]:
    """Yield the recipe at 250, 125 and 25 Hz, and variants that may help at 250 Hz."""
    for rate in (250, 125, 25):
        label = f'{rate} Hz, as it is'
        yield _arm(f'plain{rate}', label, control_hz=float(rate), discount='tick')
    discount: dict[str, Any] = {'discount': 'time'}
    noise: dict[str, Any] = {'noise_seconds': 0.04}
    steps: dict[str, Any] = {'n_step': 10}
    skip: dict[str, Any] = {'longest_hold': 20}
    remedies: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ('discount', 'discount per 40 ms', discount),
        ('noise', 'noise held for 40 ms', noise),
        ('both', 'both', discount | noise),
        ('steps', 'returns of 10 steps', steps),
        ('discount_steps', 'discount per 40 ms, returns of 10 steps', discount | steps),
        ('noise_steps', 'noise held for 40 ms, returns of 10 steps', noise | steps),
        ('three', 'all three', discount | noise | steps),
        ('parameters', 'noise on weights', {'parameter_noise': True}),
        ('skip', 'learned frame skip, up to 80 ms', skip),
        ('skip_discount', 'learned frame skip, discount per 40 ms', skip | discount),
        (
            'advantage',
            'advantages (DAU), discount per 40 ms, noise held',
            {'advantage': True} | discount | noise,
        ),
    )
    for name, label, changes in remedies:
        yield _arm(name, f'250 Hz, {label}', control_hz=250.0, **changes)


_NO_HINDSIGHT = {'strategy': 'none', 'goals': ''}
_HALF = 'future=.4,actual=.4'

_ALL = (
    # The paper's comparison, the four curves in each panel of its figures.
    Study(
        'paper',
        None,
        'What do hindsight and dense rewards do to DDPG, on every task of the paper?',
        {task: _paper_settings(task) for task in TASKS},
        (
            _arm('her_sparse', 'DDPG+HER, sparse', reward_type='sparse'),
            _arm('her_dense', 'DDPG+HER, dense', reward_type='dense'),
            _arm('ddpg_sparse', 'DDPG, sparse', reward_type='sparse', **_NO_HINDSIGHT),
            _arm('ddpg_dense', 'DDPG, dense', reward_type='dense', **_NO_HINDSIGHT),
        ),
    ),
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
            _arm('uniform', 'any future goal', goal_choice='uniform', critics=2),
            _arm('bellman', 'greatest error of 8', goal_choice='bellman', critics=2),
            _arm('uncertain', 'widest gap of 8', goal_choice='uncertain', critics=2),
        ),
    ),
    Study(
        'unbiased',
        2,
        'Does hindsight take a gamble for a sure thing, and what cures it?',
        {'FetchReach': {**_REACH, 'gamble': True}, 'FetchPush': {**_SKILLED_PUSH, 'gamble': True}},
        (
            _arm('future', 'future goals', strategy='future'),
            _arm(
                'weighted',
                'half future, half actual, importance weights',
                goals=_HALF,
                importance='density',
            ),
            _arm('actual', 'desired goals of any episode', goals='actual=.8'),
            _arm('random', 'achieved goals of any episode', goals='random=.8'),
            _arm('mixed', 'half future, half actual', goals=_HALF),
            _arm('displaced', 'half actual, half displaced', goals='actual=.4,displaced=.4'),
            _arm('none', 'no hindsight', strategy='none'),
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
            _arm('flat', 'no subgoals', subgoal_every=0),
            _arm('every10', 'a subgoal every 10 ticks', subgoal_every=10),
            _arm('prior', 'imagined subgoals, weight .3', subgoal_prior=0.3),
            _arm('prior4', 'the same, imagination learnt every 4th time', **_RARE_PRIOR),
        ),
    ),
    Study(
        'values',
        4,
        'Do values of more than a goal help: of how close, or of how soon?',
        {'HandReach': _SPARSE_HAND_REACH, 'FetchReach': _REACH},
        (
            _arm('none', 'the goal alone', condition='none'),
            _arm('threshold', 'and the success threshold', condition='threshold'),
            _arm('horizon', 'and the steps left', condition='horizon'),
            _arm(
                'threshold32',
                'and the success threshold, four times as wide',
                condition='threshold',
                widest_threshold=32.0,
            ),
            # The thresholds without the input.
            _arm('graded', 'the goal alone, graded rewards', reward_grades='.5,1,2,4,8,16,32'),
        ),
    ),
    Study(
        'targets',
        5,
        'Can targets move faster, or be left out?',
        {'FetchReach': _REACH, 'FetchPush': _PUSH, 'FetchPickAndPlace': _PICK},
        tuple(_targets()),
    ),
    Study(
        'returns',
        6,
        'Do returns of several steps help data that is far from the policy?',
        {'FetchReach': _REACH, 'FetchPush': _PUSH, 'FetchSlide': _SLIDE},
        tuple(_returns()),
    ),
    Study(
        'onpolicy',
        7,
        'Can an on-policy method use goals in hindsight?',
        {
            'FetchReach': {**_REACH, **_ON_POLICY, 'total_steps': 96_000, 'evaluate_every': 9_600},
            'FetchPush': {**_LONG, **_ON_POLICY_PUSH, 'total_steps': 1_000_000},
        },
        (
            _arm('none', 'no hindsight', strategy='none'),
            _arm('taken', 'goals in hindsight, as if acted for', strategy='future'),
            _arm(
                'weighed',
                'goals in hindsight, weighed per decision',
                strategy='future',
                importance='decision',
            ),
            _arm(
                'moved',
                'as if acted for, 4 of 5 from episodes that moved something',
                strategy='future',
                moved_share=0.8,
            ),
            _arm('outcome', 'what other episodes brought about', goals='outcome=.9'),
        ),
    ),
    Study(
        'ensembles',
        8,
        'Do several critics help, for the time that they cost?',
        {'FetchReach': _REACH, 'FetchPickAndPlace': _PICK, 'HandManipulateBlockRotateZ': HAND},
        tuple(_ensembles()),
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
        tuple(_rates()),
    ),
    Study(
        'ingredients',
        None,
        'What does each part of the recipe for the hand buy?',
        {'HandManipulateEggRotate': _SCREENED, 'HandManipulateBlockRotateXYZ': _SCREENED},
        (
            _arm('best', 'the recipe'),
            _arm('plain', 'plain features', goal_features='plain'),
            _arm('few', '13 samples per step, not 51', batch_size=256),
            _arm('future', 'future goals alone', strategy='future'),
            _arm('graded', 'graded rewards', reward_grades='.5,1,2'),
            _arm(
                'displaced',
                'half as many future goals, displaced ones instead',
                goals='future=.2,actual=.2,displaced=.4',
            ),
            _arm('unbiased', 'displaced goals, no future ones', goals='actual=.4,displaced=.4'),
            _arm('discount', 'discount 0.95, not 0.98', gamma=0.95),
            _arm('prior4', 'imagined subgoals', **_RARE_PRIOR),
            _arm('returns', 'returns of five steps', n_step=5),
        ),
        seeds=2,
    ),
)
STUDIES = {study.name: study for study in _ALL}
