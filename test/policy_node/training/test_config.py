"""The configuration: the paper's values, parsing, and refusals."""

from __future__ import annotations

import json
import os
import re

import numpy as np
import pytest

from msgs_spec.tasks import TASKS
from node_runtime.command_line import CommandParser
from policy_node.training.configuration.config import FIELDS, idle_note
from policy_node.training.configuration.flat import (
    RESEARCH,
    add_field_options,
    changed,
    config_from_dict,
    given_fields,
    parse_assignment,
    to_flat,
    typed_fields,
)
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.machine import split_threads
from policy_node.training.studies.research import STUDIES
from policy_node.training.train_her import config_from_arguments, parse_arguments
from support import ROOT
from support.runs import one_line

PEN = {'task': 'HandManipulatePenRotate', 'ticks_after_drop': 3}
PPO = {'algorithm': 'ppo', 'overlap': False}


def test_the_paper_recipe_is_appendix_b():
    push = to_flat(recipe_config('FetchPush', 'paper'))
    block = to_flat(recipe_config('HandManipulateBlockFull', 'paper'))
    assert push['hidden_sizes'] == (256, 256, 256) and not push['layer_norm']
    assert push['learning_rate'] == 1e-3
    assert (push['strategy'], push['hindsight_k'], push['reward_type']) == ('future', 4, 'sparse')
    assert (push['num_envs'], push['batch_size'], push['updates_per_cycle']) == (38, 4864, 40)
    assert (push['polyak'], push['target_update_interval']) == (0.95, 40)
    assert (push['action_l2'], push['random_epsilon'], push['noise_std']) == (1.0, 0.3, 0.2)
    assert push['gamma'] == pytest.approx(0.98) and block['gamma'] == pytest.approx(0.99)
    assert (push['total_steps'], block['total_steps']) == (4_750_000, 38_000_000)
    assert push['evaluation_episodes'] == 380
    assert (push['overlap'], push['precision']) == (False, 'float32')


@pytest.mark.parametrize('task', TASKS)
@pytest.mark.parametrize('recipe', ['paper', 'best'])
def test_recipes_exist_for_every_task_and_survive_json(task, recipe):
    config = recipe_config(task, recipe, seed=3)
    assert (config.task, config.recipe, config.seed) == (task, recipe, 3)
    stored = json.loads(json.dumps(to_flat(config)))
    assert config_from_dict(stored) == config


def switches():
    """Rows of the tables of switches in the reference, by field."""
    page = (ROOT / 'docs' / 'reference' / 'training_fields.md').read_text()
    rows = re.findall(r'^\| (`.*) \|$', page.partition('## Switches')[2].split('\n## ')[0], re.M)
    return {field: row for row in rows for field in re.findall(r'(\w+)=', row.split(' | ')[0])}


def test_switches_on_the_page_are_fields_with_values_they_take():
    for row in switches().values():
        for words in re.findall('`(.*?)`', row.split(' | ')[0]):
            assert all(parse_assignment(word) for word in words.split()), words


def test_what_a_study_switches_is_on_the_page_with_a_request():
    rows = switches()
    # Settings of any run, which some arms have as well.
    ordinary = {'strategy', 'goals', 'target_update_interval', 'moved_share', 'updates_per_cycle'}
    ordinary |= {'reward_grades'}
    arms = [arm for study in STUDIES.values() if study.request for arm in study.arms]
    for field in {name for arm in arms for name in arm.own} - ordinary:
        request = rows[field].split(' | ')[-1]
        assert re.match('[1-9]', request), field


def test_a_configuration_contains_the_disturbances_of_a_file_and_not_its_path(tmp_path):
    file = tmp_path / 'late.yaml'
    file.write_text('action: {latency: 1}')
    config = recipe_config('FetchReach', 'best', disturbances=str(file))
    assert config.disturbances == '{"action": {"latency": [1, 1]}}'
    assert recipe_config('FetchReach', 'best', disturbances='none').disturbances == ''


def test_scalars_of_numpy_are_values_of_python():
    given = {
        'gamma': np.float64(0.9),
        'total_steps': np.int64(400),
        'overlap': np.bool_(False),
        'hidden_sizes': [16, np.int64(16)],
    }
    found = typed_fields(given)
    assert found == {'gamma': 0.9, 'total_steps': 400, 'overlap': False, 'hidden_sizes': (16, 16)}
    parts = [*found.values(), *found['hidden_sizes']]
    assert not [part for part in parts if isinstance(part, np.generic)]
    with pytest.raises(ValueError, match=r'total_steps 400\.0 is not of type int'):
        typed_fields({'total_steps': np.float64(400)})


@pytest.mark.parametrize(
    ('text', 'match'),
    [
        ('gamma', "'gamma' is not name=value: give gamma="),
        ('zzz=1', "'zzz' is no field of TrainConfig; allowed: task, "),
        ('steps=1', "'steps' is no field of TrainConfig; did you mean 'total_steps'?"),
        ('threads=1', "'threads' is no field of TrainConfig; did you mean 'simulation_threads'?"),
        ('her=false', "'her' is no field of TrainConfig; did you mean 'strategy'?"),
        ('layer_norm=maybe', "layer_norm 'maybe' is not of type bool"),
        ('num_envs=1.5', "num_envs '1.5' is not of type int"),
        ('hidden_sizes=wide', "hidden_sizes 'wide' is not numbers with commas"),
    ],
)
def test_bad_assignments_are_refused(text, match):
    with pytest.raises(ValueError, match=re.escape(match) if '.' in match else match):
        parse_assignment(text)


@pytest.mark.parametrize(
    ('changes', 'match'),
    [
        ({'task': 'FetchFly'}, "unknown task 'FetchFly'"),
        ({'strategy': 'past'}, "strategy 'past'; allowed: final, future"),
        ({'gamma': 1.0}, 'gamma 1.0; allowed: 0 ... 0.999999'),
        ({'noise_std': float('inf')}, 'noise_std inf is no finite number'),
        ({'hidden_sizes': (0,)}, 'allowed: 1 to 64 widths'),
        ({'goals': 'past=.4'}, "'past'; allowed: "),
        ({'goals': 'future=.4,future=.4'}, 'is not name=share with commas'),
        ({'goals': 'future=.8,actual=.3'}, 'add up to at most 1'),
        ({'goals': 'future=.5', 'strategy': 'none'}, 'excludes strategy none'),
        ({'ticks_after_drop': 3}, 'FetchPush has no palm to drop an object from'),
        ({'first_rotation': 2.0}, 'goals of FetchPush have no rotation'),
        ({'task': 'HandManipulatePenRotate', 'first_distance': 8.0}, 'does not count'),
        ({'reward_grades': '2,1'}, 'rising numbers above 0 and below 1000'),
        ({'reward_grades': '1,2', 'condition': 'threshold'}, 'reward_grades .* without condition'),
        ({**PEN, 'ticks_after_drop': -1, 'drop_is_lost': True}, 'it needs ticks_after_drop'),
        ({**PEN, 'drop_is_lost': True, 'condition': 'horizon'}, 'without condition horizon'),
        ({'task': 'FetchSlide', 'gamble': True}, 'FetchSlide uses its gripper; allowed: FetchR'),
        ({'task': 'FetchReach', 'recipe': 'finetune'}, 'for FetchReach; allowed: FetchSlide and'),
        ({'algorithm': 'imitation'}, 'algorithm imitation needs init_from'),
        ({'recipe': 'robust', 'past_actions': 99}, 'past_actions 99; allowed: 0'),
        ({'recipe': 'robust', 'disturbance_scales': (1, -1)}, 'one or more factors 0 ... 10'),
        ({'trace': 0.5}, 'trace 0.5 has no effect'),
        ({'importance': 'density', 'goals': 'future=1'}, 'goals of the episode .* beside others'),
        ({'correction': 'cut'}, "correction 'cut' has no effect: it needs n_step other than 1"),
        ({'quantiles': 5, 'norm': 'batch', 'target': 'none'}, 'exclude .* norm batch'),
        ({'quantiles': 5, 'init_from': 'FetchReach'}, 'init_from excludes quantiles 5'),
        ({'norm': 'batch'}, 'norm batch needs target none'),
        ({'goal_choice': 'bellman', 'goals': 'actual=.8'}, 'bellman needs future goals'),
        ({'goal_choice': 'uncertain'}, 'goal_choice uncertain needs critics above 1'),
        ({'condition': 'horizon', 'n_step': 3}, 'n_step 3 excludes condition horizon'),
        ({'condition': 'threshold', 'reward_type': 'dense'}, 'needs reward_type sparse'),
        ({'widest_threshold': 32.0}, 'has no effect: it needs condition threshold'),
        (
            {'algorithm': 'imitation', 'critic_first': 9},
            'critic_first 9 has no effect: it needs algorithm ddpg',
        ),
        ({'start_share': 0.3}, 'has no effect: it needs init_from and algorithm ddpg'),
        ({'importance': 'density', 'strategy': 'random'}, 'density needs goals of the episode'),
        ({'noise_seconds': 0.01}, 'noise_seconds 0.01 is less than a tick of 0.04 s'),
        ({'longest_hold': 5, 'noise_seconds': 0.04}, 'longest_hold .* excludes noise_seconds'),
        ({'past_actions': 3, 'longest_hold': 5}, 'past_actions needs longest_hold=1'),
        ({'past_actions': 3, 'subgoal_every': 9}, 'past_actions needs .* subgoal_every=0'),
        ({'advantage': True, 'discount': 'time', 'critics': 2}, 'advantage True .* one critic'),
        ({'subgoal_every': 51}, 'subgoal_every 51 is longer than an episode'),
        ({'subgoal_every': 9, 'n_step': 3}, 'n_step 3 has no effect: it needs .* no subgoal_every'),
        ({'subgoal_every': 9, 'importance': 'density'}, 'density. has no effect: it needs algo'),
        ({'subgoal_prior': 0.1, 'longest_hold': 5}, 'subgoal_prior 0.1 .* longest_hold'),
        ({'imagination_interval': 4}, 'has no effect: it needs subgoal_prior other than 0.0'),
        ({**PPO, 'overlap': True}, 'algorithm ppo needs overlap=false'),
        ({**PPO, 'random_epsilon': 0.2}, 'random_epsilon 0.2 has no effect'),
        ({**PPO, 'init_from': 'FetchReach'}, 'init_from excludes algorithm ppo'),
        ({**PPO, 'first_distance': 2.0}, 'first_distance 2.0 has no effect'),
        ({**PPO, 'noise_std': 0.0}, 'noise_std 0.0; allowed: 1e-06 or more'),
        ({'importance': 'decision'}, 'has no effect: it needs algorithm ppo'),
        ({'goals': 'outcome=.8'}, 'goals outcome needs algorithm ppo'),
        ({'first_value': -50.0}, 'has no effect: it needs algorithm ppo'),
        ({'total_steps': 10**400}, 'total_steps is too large; allowed: up to 9007'),
        ({'gamma': 10**400}, 'gamma 1.* is not of type float'),
        ({'recipe': 'good'}, "recipe 'good'; allowed: paper, best, robust, finetune"),
        ({'control_hz': 60.0}, 'control_hz'),
    ],
)
def test_bad_values_are_refused(changes, match):
    with pytest.raises(ValueError, match=match) as raised:
        recipe_config(**{'task': 'FetchPush', 'recipe': 'best', **changes})
    assert '\n' not in str(raised.value)


@pytest.mark.parametrize(
    ('changes', 'note'),
    [
        ({}, ''),
        ({'learning_starts': 100_000}, 'nothing will be learnt'),
        ({**PPO, 'learning_starts': 100_000}, 'nothing will be learnt'),
        ({'critic_first': 1401, 'policy_delay': 700}, 'the actor will not learn'),
    ],
)
def test_a_run_that_ends_before_it_learns_is_noted(changes, note):
    assert idle_note(recipe_config('FetchReach', 'best', **changes)).partition(':')[0] == note


def test_an_unknown_stored_field_is_refused():
    stored = to_flat(recipe_config('FetchPush', 'best'))
    with pytest.raises(ValueError, match="'colour' is no field of TrainConfig"):
        config_from_dict({**stored, 'colour': 1})


def test_threads_share_the_cores(monkeypatch):
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: set(range(8)), raising=False)
    small = recipe_config('FetchPush', 'best', batch_size=1024)
    assert split_threads(small) == (7, 1)
    assert split_threads(changed(small, batch_size=4096)) == (4, 4)
    assert split_threads(changed(small, overlap=False)) == (8, 1)
    assert split_threads(changed(small, simulation_threads=2)) == (2, 1)
    monkeypatch.setenv('LOCAL_WORLD_SIZE', '16')
    assert split_threads(small) == (1, 1)


def options_of(*arguments):
    parser = CommandParser(prog='fetch_hand_sim train')
    add_field_options(parser, without=('task', 'recipe'))
    return given_fields(parser.parse_args(arguments))


def test_task_and_recipe_may_be_set_like_any_field():
    def config(*arguments):
        return config_from_arguments(parse_arguments(arguments))

    assert config('--set', 'task=FetchPush').task == 'FetchPush'
    paper = config('--task', 'FetchReach', '--set', 'recipe=paper', '--set', 'task=FetchReach')
    assert (paper.task, paper.recipe) == ('FetchReach', 'paper')
    with pytest.raises(ValueError, match='--task FetchReach excludes --set task=FetchPush'):
        config('--task', 'FetchReach', '--set', 'task=FetchPush')


@pytest.mark.parametrize('option', ['--help', '--help-research'])
def test_help_explains_every_field_and_keeps_studies_apart(option, capsys):
    with pytest.raises(SystemExit):
        options_of(option)
    said = ' '.join(capsys.readouterr().out.split())
    shown = [n for n in FIELDS if re.search(rf'--{n.replace("_", "-")}[ ,\]]', said)]
    wanted = [n for n in FIELDS if (n in RESEARCH) == (option == '--help-research')]
    assert {*shown} == {*wanted} - {'task', 'recipe'}
    assert len(wanted) <= 45
    # A terminal breaks lines also at hyphens.
    packed = said.replace(' ', '')
    assert [name for name in shown if FIELDS[name].meaning.replace(' ', '') not in packed] == []


def test_options_become_fields_of_their_types_and_nothing_else_is_set():
    assert options_of() == {}
    given = options_of(
        *('--learning-rate', '1e-4', '--steps', '2_000', '--no-overlap', '--layer-norm'),
        *('--hidden-sizes', '64,32', '--goals', 'future=.4,actual=.4', '--threads', '2'),
    )
    assert given == {
        'learning_rate': 1e-4,
        'total_steps': 2000,
        'overlap': False,
        'layer_norm': True,
        'hidden_sizes': (64, 32),
        'goals': {'future': 0.4, 'actual': 0.4},
        'simulation_threads': 2,
    }
    for text in ('1000000', '1_000_000', '1e6', '1.0e6'):
        assert options_of('--steps', text) == {'total_steps': 1_000_000}


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--learning-rte', '1'], "--learning-rte 1; did you mean '--learning-rate'?"),
        (['--nosuchthing'], 'unrecognized arguments: --nosuchthing'),
        (['--gamble', 'true'], 'switches take no value: --name is on, --no-name is off'),
        (['--steps', '1e29'], "total_steps '1e29' is not of type int"),
    ],
)
def test_a_typing_error_is_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as ended:
        options_of(*arguments)
    assert ended.value.code == 2 and message in one_line(capsys)
