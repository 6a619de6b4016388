"""Policies of the user's own code, by `module:function`."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from fetch_hand_sim.films.playing import film_episode
from msgs_spec.tasks import task_spec
from policy_node import load_policy
from policy_node.training.evaluate_policy import main as evaluate
from support.fresh_actor import observations
from support.runs import one_line

_MODULE = """
import numpy as np


class Model:
    control_hz = 50.0

    def __init__(self, task):
        self.task = task

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((*observation['observation'].shape[:-1], 4), 0.25), None


def model(task):
    return Model(task)


def function(task):
    def act(observation):
        assert observation['observation'].shape == (10,)
        return [*(observation['desired_goal'] - observation['achieved_goal']), 0.0]

    return act


def fails(task):
    raise RuntimeError(f'no weights\\nfor {task}')


def wrong(task):
    return lambda observation: [0.0]


def leaves(task):
    raise SystemExit(f'usage: for {task}')


class Bare(Model):
    def predict(self, observation, deterministic=True):
        return super().predict(observation)[0]


class Odd(Model):
    control_hz = 'often'


def late(answer):
    class Late(Model):
        calls = 0

        def predict(self, observation, **rest):
            self.calls += 1
            good, _ = super().predict(observation)
            return good if self.calls < 30 else answer(good), None

    return Late


outside = late(lambda good: good * 6)
nothing = late(lambda good: None)
deeper = late(lambda good: good[None])
words = late(lambda good: ['left'])
stops = late(lambda good: good / (1 // 0))
number = lambda task: 7
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module in the working directory, with a name of its own for each test."""
    name = f'policies_of_{tmp_path.name}'.replace('-', '_')
    (tmp_path / f'{name}.py').write_text(_MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'path', list(sys.path))
    return name


def test_an_object_acts_with_its_predict(module: str) -> None:
    found = load_policy(f'{module}:model', 'FetchReach', trust=True)
    about = found.task, found.description, found.control_hz
    assert about == ('FetchReach', f'{module}:model', 50.0)
    action, _ = found.policy.predict(observations(task_spec('FetchReach'), 3))
    assert action.tolist() == np.full((3, 4), 0.25).tolist()
    bare = load_policy(f'{module}:Bare', 'FetchReach', trust=True)
    answer = bare.predict(observations(task_spec('FetchReach'), 3))
    assert answer[0].tolist() == action.tolist() and answer[1] is None, 'the action alone'
    assert sys.path.count(str(Path.cwd())) == 1
    with pytest.raises(ValueError, match='50 Hz; the robot runs at 25 Hz'):
        found.require_rate(25.0)


def test_a_function_answers_one_observation_and_batches_row_by_row(module: str) -> None:
    policy = load_policy(f'{module}:function', 'FetchReach', trust=True).policy
    batch = observations(task_spec('FetchReach'), 2, 3)
    actions, _ = policy.predict(batch)
    wanted = batch['desired_goal'] - batch['achieved_goal']
    np.testing.assert_array_equal(actions[..., :3], wanted)
    one, _ = policy.predict({name: values[1, 2] for name, values in batch.items()})
    np.testing.assert_array_equal(one, actions[1, 2])


@pytest.mark.parametrize(
    ('function', 'line'),
    [
        ('fails', 'RuntimeError: no weights for FetchReach'),
        ('leaves', 'SystemExit: usage: for FetchReach'),
        ('Odd', "ValueError: .*'often'"),
        ('number', 'returned int'),
        ('wrong', r'returned \[0.\] .*\(4,\)'),
    ],
)
def test_a_function_without_a_policy_is_one_line(module: str, function: str, line: str) -> None:
    with pytest.raises(ValueError, match=f'{module}:{function} .*{line}') as caught:
        load_policy(f'{module}:{function}', 'FetchReach', trust=True)
    assert '\n' not in str(caught.value)


def test_no_code_is_run_without_trust_and_no_module_is_an_error(module: str) -> None:
    with pytest.raises(ValueError, match='trust:=true'):
        load_policy(f'{module}:fails', 'FetchReach')
    assert module not in sys.modules
    with pytest.raises(ValueError, match='nowhere_at_all'):
        load_policy('nowhere_at_all:make', 'FetchReach', trust=True)
    with pytest.raises(ValueError, match='needs a task; allowed: '):
        load_policy(f'{module}:model', trust=True)
    with pytest.raises(ValueError, match=r'C:/model.onnx'):
        load_policy('C:/model.onnx', 'FetchReach', trust=True)


@pytest.mark.parametrize(
    ('function', 'line'),
    [
        ('outside', '1.5'),
        ('stops', 'ZeroDivisionError'),
        ('nothing', 'returned None'),
        ('deeper', 'of shape (1, '),
        ('words', "returned ['left']"),
    ],
)
def test_a_policy_that_fails_later_is_one_line(
    module: str, function: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ['--policy', f'{module}:{function}', '--task', 'FetchReach', '--trust']
    assert evaluate([*words, '--episodes', '2', '--threads', '1']) == 1
    error = one_line(capsys)
    assert error.startswith(f'fetch_hand_sim evaluate: {module}:{function} ') and line in error


def test_a_film_passes_the_state_on() -> None:
    states = []

    class Counting:
        def predict(self, observation, state=0, *, deterministic=True):
            states.append(state)
            return np.zeros(4), state + 1

    class Blank(gymnasium.Wrapper):
        def render(self):
            return np.zeros((16, 16, 3), np.uint8)

    env = gymnasium.make('fetch_hand_sim/FetchReach-v0', render_mode='rgb_array')
    film_episode(gymnasium.wrappers.TimeLimit(Blank(env.unwrapped), 3), Counting(), seed=0)
    assert states == [0, 1, 2]
