"""One name for every policy: what is loaded, what it does without, what is refused."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

from msgs_spec.tasks import TASKS, task_spec
from policy_node import load_actor, load_policy
from policy_node.policies import checkpoint, loading
from policy_node.policies.actor import Normalizer
from policy_node.policies.goal_features import goal_features
from policy_node.policies.loading import TaskMissing, shipped_actors
from policy_node.policies.numpy_actor import NumpyActor
from policy_node.policies.policy import Policy, RandomPolicy, past_after, past_before
from support.fresh_actor import fresh_actor, observations


@pytest.mark.parametrize('name', shipped_actors())
def test_shipped_actors_answer_as_torch_does(name: str) -> None:
    task = name.removesuffix('_robust')
    actor, found = checkpoint.load(shipped_actors()[name])[0], load_policy(name)
    assert (found.task, found.control_hz) == (task, 25.0)
    assert found.sha256 == checkpoint.checkpoint_hash(shipped_actors()[name])
    for leading in ((), (40,), (2, 3)):
        observation = observations(task_spec(task), *leading)
        action, _ = found.policy.predict(observation)
        wanted, _ = actor.predict(observation)
        assert action.shape == wanted.shape and action.dtype == np.float32
        np.testing.assert_allclose(action, wanted, atol=5e-4)


@pytest.mark.parametrize('task', ['FetchSlide', 'HandReach', 'HandManipulateBlockFull'])
@pytest.mark.parametrize('features', ['plain', 'relative', 'symmetric'])
@pytest.mark.parametrize(
    ('layer_norm', 'kind'),
    [(False, 'native'), (True, 'native'), pytest.param(True, 'onnx', marks=pytest.mark.release)],
)
def test_every_kind_of_actor_answers_as_torch_does(
    task: str, features: str, layer_norm: bool, kind: str, tmp_path: Path
) -> None:
    if features == 'symmetric' and not task.startswith('HandManipulate'):
        with pytest.raises(ValueError, match='no object pose'):
            goal_features(features, task_spec(task))
        return
    path = tmp_path / 'a.safetensors'
    actor = fresh_actor(path, task, goal_features=features, layer_norm=layer_norm)
    if kind == 'onnx':
        source, path = path, tmp_path / 'a.onnx'
        pytest.importorskip('policy_node.policies.export_actor').export(source, path)
    observation = observations(task_spec(task), 50)
    action, _ = load_policy(path).policy.predict(observation)
    np.testing.assert_allclose(action, actor.predict(observation)[0], atol=1e-5)


@pytest.mark.parametrize('load', [load_actor, lambda task: load_policy(task).policy])
def test_parts_of_an_observation_fit_each_other_and_the_task(load: Callable[[str], Policy]) -> None:
    """One goal may be that of a whole batch."""
    policy, batch = load('FetchPush'), observations(task_spec('FetchPush'), 5)
    one = {**batch, 'desired_goal': batch['desired_goal'][2]}
    each = {**batch, 'desired_goal': np.tile(one['desired_goal'], (5, 1))}
    np.testing.assert_array_equal(policy.predict(one)[0], policy.predict(each)[0])
    with pytest.raises(ValueError, match=r'\(5, 25\), desired_goal \(4, 3\)'):
        policy.predict({**batch, 'desired_goal': batch['desired_goal'][:4]})
    with pytest.raises(ValueError, match=r'\(5, 24\)'):
        policy.predict({**batch, 'observation': batch['observation'][:, :24]})
    with pytest.raises(ValueError, match="'desired_goal'"):
        policy.predict({'observation': batch['observation']})


def test_inputs_are_clipped_then_scaled_then_clipped() -> None:
    normalizer = Normalizer(4)
    normalizer.mean.copy_(torch.tensor([0.0, 1.0, 150.0, 0.0]))
    normalizer.std.copy_(torch.tensor([1.0, 2.0, 25.0, 0.01]))
    values = normalizer(torch.tensor([-3.0, 2.0, 1e9, 1.0]))
    assert values.tolist() == [-3.0, 0.5, 2.0, 5.0]


def test_past_actions_begin_as_zeros_and_the_newest_comes_first() -> None:
    past = past_before(None, None, (1,), 4)
    for number in (1.0, 2.0, 3.0):
        past = past_after(past, np.full((1, 2), number, np.float32))
    assert past.tolist() == [[3.0, 3.0, 2.0, 2.0]]
    assert past_after(past[:, :0], np.ones((1, 2), np.float32)).shape == (1, 0)
    state = np.ones((2, 4), np.float32)
    assert past_before(state, [True, False], (2,), 4).tolist() == [[0.0] * 4, [1.0] * 4]
    with pytest.raises(ValueError, match=r'\(2, 4\).*\(3, 4\)'):
        past_before(state, None, (3,), 4)


@pytest.mark.filterwarnings('error')
def test_torch_does_not_warn_of_observations_that_cannot_be_written() -> None:
    batch = observations(task_spec('FetchPush'), 5)
    fixed = {name: np.asarray(values, np.float32) for name, values in batch.items()}
    for values in fixed.values():
        values.setflags(write=False)
    assert load_actor('FetchPush').predict(fixed)[0].shape == (5, 4)


def test_acting_takes_one_thread_and_leaves_the_rest_as_it_was() -> None:
    seen = []

    class Watched(NumpyActor):
        def _forward(self, layer: np.ndarray) -> np.ndarray:
            seen.extend(library['num_threads'] for library in threadpool_info())
            return super()._forward(layer)

    found = checkpoint.read(shipped_actors()['FetchPush'])
    before = threadpool_info()
    Watched(found.info.shape, found.tensors).predict(observations(task_spec('FetchPush'), 64))
    blas = [library for library in before if library['user_api'] == 'blas']
    assert blas and len(seen) == len(before)
    assert seen.count(1) >= len(blas)
    assert threadpool_info() == before


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach'])
@pytest.mark.parametrize('name', ['random', 'resting'])
def test_policies_without_training(task: str, name: str) -> None:
    spec = task_spec(task)
    found = load_policy(name, task)
    assert (found.task, found.control_hz, found.sha256) == (task, None, '')
    for leading in ((), (5,)):
        # With all arguments of Stable-Baselines3.
        action, state = found.policy.predict(observations(spec, *leading), None, None, True)
        assert action.shape == (*leading, spec.robot.action_size) and state is None
        assert (np.abs(action) <= 1.0).all() and bool(action.any()) == (name == 'random')


def test_random_actions_are_alike_for_equal_seeds_and_fill_the_range() -> None:
    observation = observations(task_spec('FetchReach'), 1000)
    first, again, other = (RandomPolicy(4, seed).predict(observation)[0] for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).any()
    assert -1 <= first.min() < -0.99 and 0.99 < first.max() <= 1
    # The actions of an episode depend on its seed only, wherever it runs.
    policies = RandomPolicy(4), RandomPolicy(4)
    for policy, seeds in zip(policies, ([5, 6, 7], [7, 8, 9]), strict=True):
        policy.start(seeds)
    ours, theirs = (policy.predict({'observation': np.zeros((3, 10))})[0] for policy in policies)
    assert (ours[2] == theirs[0]).all() and len(np.unique(ours[:, 0])) == 3
    assert (np.abs(ours) <= 1.0).all()


def test_a_name_without_a_task_needs_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_policy('', 'FetchPush').description == 'actor FetchPush.safetensors'
    assert shipped_actors().keys() >= TASKS.keys()
    # A task of another package has none.
    others = {task: path for task, path in shipped_actors().items() if task != 'HandReach'}
    monkeypatch.setattr(loading, 'shipped_actors', lambda: others)
    assert load_policy('robust', 'FetchReach').description == 'actor FetchReach_robust.safetensors'
    with pytest.raises(ValueError, match=r'HandReach .*FetchReach'):
        load_policy('', 'HandReach')
    with pytest.raises(ValueError, match=r'robust .*HandManipulateEggFull .*FetchReach'):
        load_policy('robust', 'HandManipulateEggFull')
    for name in ('random', 'resting', ''):
        with pytest.raises(TaskMissing, match='FetchReach, '):
            load_policy(name)


def test_unknown_and_unfitting_names_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / 'run').mkdir()
    (tmp_path / 'run' / 'best.safetensors').touch()
    for name, task, line in (
        ('zzz', 'FetchReach', r"'zzz'.*FetchReach.*'random', 'resting' or 'robust'$"),
        ('fetchreach', 'FetchReach', r"'robust'; did you mean 'FetchReach'\?$"),
        ('FetchReach', 'FetchPush', 'trained on FetchReach, not on FetchPush'),
        (tmp_path, None, 'no actor'),
        ('x' * 300, 'FetchReach', 'File name too long'),
        (tmp_path / 'run', None, r'/best\.safetensors$'),
    ):
        with pytest.raises(ValueError, match=line):
            load_policy(name, task)


def test_finite_weights_give_finite_actions_however_large(tmp_path: Path) -> None:
    path = tmp_path / 'a.safetensors'
    fresh_actor(path, 'FetchReach', layer_norm=True)
    found = checkpoint.read(path)
    huge = {name: np.full_like(value, 3e38) for name, value in found.tensors.items()}
    actor = NumpyActor(found.info.shape, huge)
    assert np.isfinite(actor.predict(observations(task_spec('FetchReach')))[0]).all()


def test_acting_needs_no_torch() -> None:
    code = """
import sys
from policy_node import load_policy
for name in ('FetchReach', 'random', 'resting'):
    load_policy(name, 'FetchReach')
assert 'torch' not in sys.modules
"""
    subprocess.run([sys.executable, '-c', code], check=True, timeout=120)


@pytest.mark.parametrize('name', ['FetchReach', 'random'])
def test_a_flattened_observation_is_rejected(name: str) -> None:
    policy = load_policy(name, 'FetchReach').policy
    with pytest.raises(TypeError, match='ndarray'):
        policy.predict(np.zeros(16))  # type: ignore[arg-type]
