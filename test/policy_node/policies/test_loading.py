"""One name for every policy: what is loaded, what it does without, what is refused."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from msgs_spec.tasks import TASKS, task_spec
from policy_node import load_actor, load_policy
from policy_node.policies import checkpoint, loading
from policy_node.policies.loading import TaskMissing, shipped_actors
from policy_node.policies.numpy_actor import NumpyActor
from policy_node.policies.policy import Policy, RandomPolicy
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


@pytest.mark.parametrize('name', ['FetchReach', 'random', 'resting'])
def test_policies_are_asked_as_stable_baselines3_asks(name: str) -> None:
    policy: Any = load_policy(name, 'FetchReach').policy
    observation = observations(task_spec('FetchReach'), 2)
    # As its `fetch_hand_sim evaluate` does.
    starts = np.ones(2, dtype=bool)
    action, state = policy.predict(
        observation, state=None, episode_start=starts, deterministic=True
    )
    assert action.shape == (2, 4) and state is None


@pytest.mark.parametrize('task', ['FetchSlide', 'HandReach', 'HandManipulateBlockFull'])
@pytest.mark.parametrize('features', ['plain', 'relative', 'symmetric'])
@pytest.mark.parametrize('layer_norm', [False, True])
def test_every_kind_of_actor_answers_as_torch_does(
    task: str, features: str, layer_norm: bool, tmp_path: Path
) -> None:
    if features == 'symmetric' and not task.startswith('HandManipulate'):
        pytest.skip('without an object pose as its goal')
    path = tmp_path / 'a.safetensors'
    actor = fresh_actor(path, task, goal_features=features, layer_norm=layer_norm)
    observation = observations(task_spec(task), 50)
    action, _ = load_policy(path).policy.predict(observation)
    np.testing.assert_allclose(action, actor.predict(observation)[0], atol=1e-5)


def test_a_batch_is_answered_as_its_rows() -> None:
    policy, observation = load_policy('FetchPush').policy, observations(task_spec('FetchPush'), 64)
    batch, _ = policy.predict(observation)
    rows = [policy.predict({k: v[i] for k, v in observation.items()})[0] for i in range(64)]
    # In float64 first: all but the rare last bit.
    np.testing.assert_allclose(batch, rows, rtol=2e-7, atol=1e-9)


@pytest.mark.parametrize('load', [load_actor, lambda task: load_policy(task).policy])
def test_one_goal_may_be_that_of_a_whole_batch(load: Callable[[str], Policy]) -> None:
    policy, batch = load('FetchPush'), observations(task_spec('FetchPush'), 5)
    one = {**batch, 'desired_goal': batch['desired_goal'][2]}
    each = {**batch, 'desired_goal': np.tile(one['desired_goal'], (5, 1))}
    np.testing.assert_array_equal(policy.predict(one)[0], policy.predict(each)[0])
    with pytest.raises(ValueError, match=r'\(5, 25\), desired_goal \(4, 3\)'):
        policy.predict({**batch, 'desired_goal': batch['desired_goal'][:4]})


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
        action, _ = found.policy.predict(observations(spec, *leading))
        assert action.shape == (*leading, spec.robot.action_size)
        assert (np.abs(action) <= 1.0).all() and bool(action.any()) == (name == 'random')


def test_random_actions_are_alike_for_equal_seeds_and_fill_the_range() -> None:
    observation = observations(task_spec('FetchReach'), 1000)
    first, again, other = (RandomPolicy(4, seed).predict(observation)[0] for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).any()
    assert -1 <= first.min() < -0.99 and 0.99 < first.max() <= 1


def test_no_name_is_the_shipped_actor_of_the_task(monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize('name', ['random', 'resting', ''])
def test_a_missing_task_has_its_own_error(name: str) -> None:
    with pytest.raises(TaskMissing, match='FetchReach, '):
        load_policy(name)


def test_unknown_and_unfitting_names_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'zzz'.*FetchReach.*'random', 'resting' or 'robust'$"):
        load_policy('zzz', 'FetchReach')
    for mistyped, meant in {'rnd': 'random', 'fetchreach': 'FetchReach'}.items():
        with pytest.raises(ValueError, match=rf"'robust'; did you mean '{meant}'\?$"):
            load_policy(mistyped, 'FetchReach')
    with pytest.raises(ValueError, match='trained on FetchReach, not on FetchPush'):
        load_policy('FetchReach', 'FetchPush')
    with pytest.raises(ValueError, match='no actor'):
        load_policy(tmp_path)
    with pytest.raises(ValueError, match='File name too long'):
        load_policy('x' * 300, 'FetchReach')
    with pytest.raises(ValueError, match=r'gone.onnx'):
        load_policy(tmp_path / 'gone.onnx')
    (tmp_path / 'best.safetensors').touch()
    with pytest.raises(ValueError, match=r'/best\.safetensors$'):
        load_policy(tmp_path)


def test_finite_weights_give_finite_actions_however_large(tmp_path: Path) -> None:
    path = tmp_path / 'a.safetensors'
    fresh_actor(path, 'FetchReach', layer_norm=True)
    found = checkpoint.read(path)
    huge = {name: np.full_like(value, 3e38) for name, value in found.tensors.items()}
    actor = NumpyActor(found.info.shape, huge)
    assert np.isfinite(actor.predict(observations(task_spec('FetchReach')))[0]).all()


def _modules_after(code: str) -> set[str]:
    code += "\nimport sys; print(*sorted(name.partition('.')[0] for name in sys.modules))"
    result = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


@pytest.mark.parametrize('name', ['FetchReach', 'random', 'resting'])
def test_acting_needs_no_torch(name: str) -> None:
    code = (
        'import numpy as np; from policy_node import load_policy\n'
        "ones = {'observation': np.ones(10), 'desired_goal': np.ones(3)}\n"
        f"load_policy({name!r}, 'FetchReach').policy.predict(ones)"
    )
    assert 'torch' not in _modules_after(code)


@pytest.mark.parametrize('name', ['FetchReach', 'random'])
def test_a_flattened_observation_is_rejected(name: str) -> None:
    policy = load_policy(name, 'FetchReach').policy
    with pytest.raises(TypeError, match='ndarray'):
        policy.predict(np.zeros(16))  # type: ignore[arg-type]


def test_random_episodes_are_alike_for_equal_seeds_wherever_they_run() -> None:
    observation = {'observation': np.zeros((3, 10))}
    first, second = RandomPolicy(4), RandomPolicy(4)
    first.start([5, 6, 7])
    second.start([7, 8, 9])
    ours, theirs = (policy.predict(observation)[0] for policy in (first, second))
    assert (ours[2] == theirs[0]).all()
    assert len(np.unique(ours[:, 0])) == 3
    assert (np.abs(ours) <= 1.0).all()
