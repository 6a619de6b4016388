"""The robustness command: its points, what they amount to, and going on after an interruption."""

from __future__ import annotations

import json

import pytest

from msgs_spec.tasks import TASKS, task_spec
from policy_node.training.robustness.command import main
from policy_node.training.robustness.sweeps import SWEEPS, kept_up_to, points, sentence

REACH = task_spec('FetchReach')
FEW = ['--policy', 'resting', '--task', 'FetchReach', '--episodes', '2', '--threads', '1']


@pytest.mark.parametrize('task', TASKS)
def test_every_task_has_its_points(task):
    found = list(points(task_spec(task)))
    assert found[0].disturbances.is_off
    assert not any(each.disturbances.is_off for each in found[1:])
    assert len({each.key for each in found}) == len(found)
    assert any('object' in each.name for each in found) == task_spec(task).has_object


def test_success_is_kept_up_to_the_level_before_the_first_loss():
    (latency,) = (each for each in SWEEPS if each.name == 'action latency')
    success = {f'action latency {level}': value for level, value in enumerate([1, 0.9, 0.7, 1], 1)}
    assert kept_up_to(latency, success, 1.0) == 2
    assert kept_up_to(latency, success, 0.5) == 4
    assert kept_up_to(latency, dict.fromkeys(success, 0.1), 1.0) is None


def test_the_sentence_names_what_is_kept_and_what_is_lost():
    success = {each.key: 1.0 for each in points(REACH)}
    success |= {'action latency 3': 0.5, 'joint noise 0.005': 0.0}
    text = sentence(REACH, 25.0, success)
    assert 'up to 80 ms action latency, ' in text and 'not with 0.005 rad joint noise.' in text


def test_an_output_without_a_name_is_refused(capsys):
    assert main([*FEW, '--output', '.']) == 2
    assert '--output .; allowed: the path of a file' in capsys.readouterr().err


@pytest.mark.release
def test_an_interrupted_command_goes_on_with_the_missing_points(tmp_path, capsys):
    words, file = [*FEW, '--output', str(tmp_path / 'a.b')], tmp_path / 'a.b.json'
    assert main(words) == 0
    whole = json.loads(file.read_text())
    kept = dict(list(whole['points'].items())[:-4])
    kept['none 0'] = {**kept['none 0'], 'success': 0.25}
    file.write_text(json.dumps({**whole, 'points': kept}))
    # Two processes give the same as one.
    assert main([*words, '--jobs', '2']) == 0
    again = json.loads(file.read_text())
    assert again['points'] == whole['points'] | {'none 0': kept['none 0']}
    assert len((tmp_path / 'a.b.csv').read_text().splitlines()) == len(whole['points']) + 1
    assert (tmp_path / 'a.b.png').read_bytes()[:4] == b'\x89PNG'
    capsys.readouterr()
    for other in (['--first-seed', '1'], ['--episodes', '3'], ['--policy', 'random']):
        arguments = [*words, *other]
        assert main(arguments) == 2
        assert 'other settings' in capsys.readouterr().err
    file.write_text('[1]')
    assert main(words) == 2 and 'no result of this command' in capsys.readouterr().err
