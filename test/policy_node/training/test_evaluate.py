"""Evaluation: intervals, outcomes, and the command line, on the real simulation."""

from __future__ import annotations

import csv
import json
import subprocess
import sys

import numpy as np
import pytest

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import RandomPolicy, RestingPolicy
from policy_node.training.evaluate_policy import main
from policy_node.training.evaluation import (
    EpisodeOutcomes,
    compare,
    diagnose,
    evaluate,
    run_episodes,
    summarize,
    wilson_interval,
)
from support.fresh_actor import fresh_actor
from support.runs import one_line, outcomes_of


class TowardsGoal:
    """Moves the gripper straight to the goal of FetchReach: always succeeds."""

    def predict(self, observation, state=None, *, deterministic=True):
        offset = observation['desired_goal'] - observation['achieved_goal']
        action = np.zeros((len(offset), 4))
        action[:, :3] = np.clip(10.0 * offset, -1, 1)
        return action, None


def simulation(num_envs, task='FetchReach'):
    return Simulation(task, num_envs=num_envs, num_threads=1)


@pytest.mark.parametrize(
    ('successes', 'episodes', 'interval'),
    # Newcombe 1998, table I, method 3 (Wilson without continuity correction).
    [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611))],
)
def test_wilson_interval(successes, episodes, interval):
    assert wilson_interval(successes, episodes) == pytest.approx(interval, abs=5e-5)


def test_the_interval_contains_the_rate():
    for episodes in range(1, 200):
        assert wilson_interval(0, episodes)[0] == 0.0
        assert wilson_interval(episodes, episodes)[1] == 1.0


def test_an_episode_depends_on_its_seed_alone_and_a_good_policy_succeeds():
    one = evaluate(simulation(1), TowardsGoal(), 6, first_seed=40)
    many = evaluate(simulation(4), TowardsGoal(), 6, first_seed=40)
    assert len(one) == len(many) == 6
    for name in EpisodeOutcomes.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))
    assert one.seed.tolist() == list(range(40, 46))
    assert one.success_gymnasium.all() and one.success_paper.all() and one.touched.all()
    assert (one.episode_return > -15).all() and (one.episode_return < 0).any()
    other = evaluate(simulation(4), TowardsGoal(), 6, first_seed=50)
    assert (other.episode_return != one.episode_return).any()


def test_hopeless_evaluations_end_early():
    asked = []

    def hopeless(outcomes):
        asked.append(len(outcomes))
        return len(outcomes) >= 8

    outcomes = evaluate(simulation(4), RestingPolicy(4), 100, 0, hopeless)
    assert asked == [4, 8] and len(outcomes) == 8


def test_both_rules_are_applied():
    """3 mm in every coordinate: 11.6 mm over all fifteen, but 5.2 mm per fingertip."""

    class GoalNearby(RestingPolicy):
        def predict(self, observation, state=None, **options):
            hand.set_goal(observation['achieved_goal'] + 0.003)
            return super().predict(observation, state, **options)

    for rule in ('gymnasium', 'paper'):
        hand = Simulation('HandReach', num_envs=3, num_threads=1, success_rule=rule)
        outcomes = run_episodes(hand, GoalNearby(20), [1, 2, 3])
        assert outcomes.success_paper.all() and not outcomes.success_gymnasium.any()


def test_summary():
    flags = np.array([True, False, True, False])
    outcomes = outcomes_of(
        flags,
        seed=np.arange(4) + 7,
        success_paper=~flags,
        touched=flags | True,
        episode_return=np.arange(4) * -1.0,
        diverged=~flags,
        ticks_reached=np.array([10, 0, 30, 0]),
        ticks_kept=np.array([9, 0, 21, 0]),
        long_way=np.array([True, True, False, True]),
        dropped=np.array([False, True, False, False]),
        final_distance=np.full(4, np.nan),
        final_rotation=np.array([0.05, 2.0, 0.03, 0.15]),
    )
    summary = summarize(outcomes)
    assert (summary['episodes'], summary['first_seed'], summary['diverged']) == (4, 7, 2)
    assert (summary['success_gymnasium'], summary['touched']) == (0.5, 1.0)
    assert summary['success_gymnasium_interval_95'] == list(wilson_interval(2, 4))
    assert summary['mean_return'] == -1.5
    assert (summary['stay'], summary['dropped']) == (0.75, 0.25)
    assert (summary['long_way'], summary['long_way_share']) == (pytest.approx(1 / 3), 0.75)
    assert summary['rotation'] == pytest.approx(0.1) and 'distance' not in summary


def test_staying_is_counted_tick_by_tick():
    """The goal is where the gripper is for `held` ticks of every four, else far away."""

    class Fleeting(RestingPolicy):
        tick = 0

        def predict(self, observation, state=None, **options):
            far = 0.0 if self.tick % 4 < held else 1.0
            robot.set_goal(observation['achieved_goal'] + far)
            self.tick += 1
            return super().predict(observation, state, **options)

    robot = simulation(2)
    for held, stay in ((1, 0.0), (2, 13 / 25), (3, 25 / 37)):
        outcomes = run_episodes(robot, Fleeting(4), [1, 2])
        # 50 ticks are twelve times four, and two more. No tick follows the last one.
        reached = 12 * held + min(held, 2) - (held >= 2)
        assert outcomes.ticks_reached.tolist() == [reached] * 2
        assert diagnose(outcomes).get('stay', 0.0) == pytest.approx(stay)
        assert outcomes.final_distance == pytest.approx(0.0 if held >= 2 else 3**0.5, abs=0.01)
        assert not {'dropped', 'rotation', 'long_way'} & diagnose(outcomes).keys()


def test_fallen_objects_and_goals_the_long_way_round_are_counted():
    seeds = list(range(8))
    pen = simulation(8, 'HandManipulatePenRotate')
    dropped = run_episodes(pen, RandomPolicy(20), seeds)
    heights = pen.observe()['achieved_goal'][:, 2]
    assert dropped.dropped.tolist() == (heights < 0.04).tolist()
    assert 4 <= dropped.dropped.sum(), 'nine of ten random episodes drop it'
    start = pen.reset(seed=seeds)
    product = start['achieved_goal'][:, 3:] * start['desired_goal'][:, 3:]
    assert dropped.long_way.tolist() == (product.sum(axis=1) < 0).tolist()
    assert np.isnan(dropped.final_distance).all() and (dropped.final_rotation >= 0).all()


@pytest.mark.parametrize(('episodes', 'good', 'bad'), [(50, 0.95, 0.8), (400, 0.3, 0.28)])
def test_the_interval_of_a_difference_holds_it_in_95_of_100_cases(episodes, good, bad):
    """Half of the episodes are equally difficult for both policies, so successes correlate."""
    random = np.random.default_rng(1)
    found = []
    for _ in range(1000):
        difficulty = random.random((2, episodes))
        difficulty[1, ::2] = difficulty[0, ::2]
        one, two = difficulty[0] < good, difficulty[1] < bad
        low, high = compare(outcomes_of(one), outcomes_of(two))['difference_interval_95']
        found.append(low <= good - bad <= high)
    assert 0.93 <= np.mean(found) <= 0.99


def test_the_command_writes_table_json_and_csv_and_compares_two_policies(tmp_path, capsys):
    json_file, csv_file = tmp_path / 'a' / 'e.json', tmp_path / 'e.csv'
    arguments = ['--policy', 'FetchReach', '--against', 'resting', '--episodes', '16']
    arguments += ['--threads', '1', '--json', str(json_file), '--csv', str(csv_file)]
    assert main(arguments) == 0
    report, rows = json.loads(json_file.read_text()), list(csv.DictReader(csv_file.open()))
    about = report['task'], report['episodes'], report['success_gymnasium'], len(report['sha256'])
    assert about == ('FetchReach', 16, 1.0, 64)
    assert len(rows) == 16 and {row['success_gymnasium'] for row in rows} == {'1'}
    returns = [float(row['episode_return']) for row in rows]
    assert report['mean_return'] == pytest.approx(np.mean(returns))
    other = report['against']
    resting = evaluate(simulation(16), RestingPolicy(4), 16, report['first_seed'])
    assert other['success_gymnasium'] == resting.success_gymnasium.mean() < 0.3
    assert resting.episode_return.mean() < -35
    assert other['only_first'] == 16 - resting.success_gymnasium.sum()
    assert (other['policy'], other['episodes'], other['only_second']) == ('resting', 16, 0)
    low, high = other['difference_interval_95']
    assert 0.5 < low < other['difference'] == other['only_first'] / 16 <= high <= 1.0
    output = capsys.readouterr().out
    assert 'gymnasium rule' in output and 'success minus that of resting' in output


def test_the_first_policy_is_reported_although_the_second_fails(tmp_path, monkeypatch, capsys):
    (tmp_path / 'broken.py').write_text(
        'from itertools import count\n'
        'def make(task):\n'
        '    calls = count()\n'
        '    return lambda observation: [0.0 if next(calls) < 30 else float("nan")] * 4\n'
    )
    monkeypatch.chdir(tmp_path)
    arguments = ['--policy', 'resting', '--task', 'FetchReach', '--against', 'broken:make']
    assert main([*arguments, '--trust', '--episodes', '2', '--json', 'e.json']) == 1
    report = json.loads((tmp_path / 'e.json').read_text())
    assert report['episodes'] == 2 and 'against' not in report
    assert 'broken:make' in capsys.readouterr().err


def test_an_actor_is_evaluated_at_the_rate_it_was_trained_at(tmp_path):
    fresh_actor(tmp_path / 'fast.safetensors', 'FetchReach', control_hz=250.0)
    policy, json_file = str(tmp_path / 'fast.safetensors'), tmp_path / 'report.json'
    arguments = ['--policy', policy, '--episodes', '1', '--threads', '1', '--json', str(json_file)]
    assert main(arguments) == 0
    # It was never trained: 0 at the goal and -1 elsewhere, 500 times instead of 50.
    assert -500.0 <= json.loads(json_file.read_text())['mean_return'] < -50.0


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--policy', 'Nobody'], "'Nobody'"),
        (['--policy', 'random'], 'random needs a task'),
        ([], '--policy and --task are missing'),
        (['--policy', 'FetchReach', '--task', 'FetchPush'], 'FetchReach, not on FetchPush'),
        # Before the episodes.
        (['--policy', 'FetchReach', '--json', '/dev/null/a.json'], 'a.json cannot be written'),
        (['--policy', 'FetchReach', '--csv', '/dev'], '/dev cannot be written'),
        (['--policy', 'FetchReach', '--csv', 'a', '--json', 'a'], '--json and --csv both name a;'),
        (['--policy', 'FetchReach', '--csv', 'a' * 300], 'cannot be written: File name too long'),
        (['--policy', f'{"a" * 300}:make', '--task', 'FetchReach'], 'add --trust'),
        (['--policy', 'FetchReach', '--against', 'FetchPush'], '--against: '),
        (
            ['--task', 'FetchReach', '--first-seed', str(2**32 - 2)],
            'the last seed would be 4294968',
        ),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in one_line(capsys)


def test_ctrl_c_reports_the_episodes_that_are_finished(capsys, monkeypatch):
    batches = iter([False, True])

    def interrupted(*arguments):
        if next(batches):
            raise KeyboardInterrupt
        return run_episodes(*arguments)

    monkeypatch.setattr('policy_node.training.evaluation.run_episodes', interrupted)
    arguments = ['--policy', 'resting', '--task', 'FetchReach', '--episodes', '9', '--json']
    assert main([*arguments, '--num-envs', '3', '--threads', '1']) == 130
    assert json.loads(capsys.readouterr().out)['episodes'] == 3


def test_an_invalid_report_or_seed_is_rejected_before_the_evaluation(tmp_path):
    (tmp_path / 'list.json').write_text('[1]')
    (tmp_path / 'folder.json').mkdir()
    code = f"""
from policy_node.training.evaluate_reference import main
for name in ('list', 'folder'):
    print(main(['--policy', 'FetchReach', '--json', f'{tmp_path}/{{name}}.json']))
print(main(['--policy', 'FetchReach', '--first-seed', '4294967295', '--episodes', '2']))
"""
    command = [sys.executable, '-O', '-c', code]
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert found.stdout == '2\n2\n2\n'
    listed, folder, seed = found.stderr.splitlines()
    assert 'the last seed would be 4294967296; allowed: 0 ... 4294967295' in seed
    assert 'contains no JSON object' in listed and 'cannot be written: ' in folder
