"""Policies in other formats act as their originals: ONNX files and Stable-Baselines3 models."""

from __future__ import annotations

import json
import pickle
import resource
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import fetch_hand_sim  # noqa: F401  registers the environments
from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.export_actor import main as export_actor
from policy_node.policies.loading import TaskMissing, load_actor, load_policy, shipped_actors
from support.fresh_actor import fresh_actor, observations

onnx = pytest.importorskip('onnx')
TensorProto, helper, numpy_helper = onnx.TensorProto, onnx.helper, onnx.numpy_helper
REACH = task_spec('FetchReach')


@pytest.fixture(scope='module')
def onnx_file(tmp_path_factory):
    path = tmp_path_factory.mktemp('onnx') / 'new' / 'reach.onnx'
    assert export_actor(['FetchReach', str(path)]) == 0
    return path


def test_onnx_actor_answers_as_its_checkpoint(onnx_file):
    found, actor = load_policy(onnx_file), load_actor('FetchReach')
    for leading in ((), (20,), (2, 3)):
        observation = observations(REACH, *leading)
        action, _ = found.policy.predict(observation)
        np.testing.assert_allclose(action, actor.predict(observation)[0], atol=1e-5)
    assert (found.task, found.control_hz) == ('FetchReach', 25.0)
    assert found.description == 'actor reach.onnx'
    assert found.sha256 == checkpoint.checkpoint_hash(onnx_file)


@pytest.mark.release
@pytest.mark.parametrize(
    ('task', 'features'),
    [('HandManipulateBlockFull', 'symmetric'), ('HandManipulatePenFull', 'relative')],
)
def test_actors_that_see_how_far_the_goal_is_are_exported(task, features, tmp_path):
    source, target = tmp_path / 'a.safetensors', tmp_path / 'a.onnx'
    fresh_actor(source, task, goal_features=features, layer_norm=True)
    assert export_actor([str(source), str(target)]) == 0
    observation = observations(task_spec(task), 10)
    action, _ = load_policy(target, task).policy.predict(observation)
    wanted, _ = load_policy(source, task).policy.predict(observation)
    np.testing.assert_allclose(action, wanted, atol=1e-5)


def test_onnx_runs_without_torch(onnx_file):
    code = (
        'import sys; from policy_node import load_policy\n'
        f'load_policy({str(onnx_file)!r})\n'
        'assert "torch" not in sys.modules'
    )
    subprocess.run([sys.executable, '-c', code], check=True)


def test_files_beside_an_onnx_actor_are_not_run(onnx_file, tmp_path, monkeypatch):
    (tmp_path / 'numpy.py').write_text('raise RuntimeError("not asked for")')
    monkeypatch.chdir(tmp_path)
    assert load_policy(onnx_file).task == 'FetchReach'


def test_onnx_of_another_task_or_damaged_is_refused_in_one_line(onnx_file, tmp_path):
    with pytest.raises(ValueError, match='FetchReach, not on HandReach'):
        load_policy(onnx_file, 'HandReach')
    cut = tmp_path / 'cut.onnx'
    cut.write_bytes(onnx_file.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r'cut.onnx') as error:
        load_policy(cut)
    assert str(error.value).isprintable()


def crafted_onnx(path, nodes, metadata, initializers=()):
    """An ONNX file with the inputs and the output of an actor of FetchReach."""

    def place(name, size):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ['batch', size])

    inputs = [place('observation', 10), place('desired_goal', 3)]
    graph = helper.make_graph(nodes, 'crafted', inputs, [place('action', 4)], list(initializers))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)], ir_version=8)
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


def test_a_few_bytes_of_onnx_that_ask_for_gigabytes_are_refused(onnx_file, tmp_path):
    metadata = {p.key: p.value for p in onnx.load(onnx_file).metadata_props}
    shape = numpy_helper.from_array(np.array([2**31], np.int64), 'shape')
    head = [
        helper.make_node('Slice', ['observation', 'zero', 'four', 'one'], ['head']),
        helper.make_node('ConstantOfShape', ['shape'], ['zeros']),
        helper.make_node('ReduceSum', ['zeros'], ['sum'], keepdims=0),
        helper.make_node('Add', ['head', 'sum'], ['action']),
    ]
    values = {'zero': 0, 'four': 4, 'one': 1}
    numbers = [numpy_helper.from_array(np.array([v], np.int64), n) for n, v in values.items()]
    path = crafted_onnx(tmp_path / 'bomb.onnx', head, metadata, [shape, *numbers])
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    began = time.perf_counter()
    with pytest.raises(ValueError, match=r'bomb\.onnx') as error:
        load_policy(path)
    assert str(error.value).isprintable()
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 4.0
    assert time.perf_counter() - began < 20.0


# It computes for up to 30 s.
@pytest.mark.release
def test_onnx_that_computes_for_ever_is_refused(onnx_file, tmp_path):
    metadata = {p.key: p.value for p in onnx.load(onnx_file).metadata_props}
    scalars = {'count': np.array(2**60), 'go': np.array(True), 'four': np.array([4])}
    scalars |= {'zero': np.array([0]), 'one': np.array([1])}
    numbers = [numpy_helper.from_array(value, name) for name, value in scalars.items()]
    flag = helper.make_tensor_value_info
    body = helper.make_graph(
        [
            helper.make_node('Identity', ['go_in'], ['go_out']),
            helper.make_node('Tanh', ['state'], ['next']),
        ],
        'body',
        [
            flag('index', TensorProto.INT64, []),
            flag('go_in', TensorProto.BOOL, []),
            flag('state', TensorProto.FLOAT, None),
        ],
        [flag('go_out', TensorProto.BOOL, []), flag('next', TensorProto.FLOAT, None)],
    )
    nodes = [
        helper.make_node('Slice', ['observation', 'zero', 'four', 'one'], ['head']),
        helper.make_node('Loop', ['count', 'go', 'head'], ['action'], body=body),
    ]
    path = crafted_onnx(tmp_path / 'loop.onnx', nodes, metadata, numbers)
    with pytest.raises(ValueError, match=r'loop\.onnx .*400 MiB') as error:
        load_policy(path)
    assert str(error.value).endswith(('(exit code -9)', '(exit code -24)'))


@pytest.mark.parametrize(
    ('library', 'suffix', 'line'),
    [
        ('onnxruntime', '.onnx', 'reach.onnx needs onnxruntime: pip install onnxruntime'),
        ('stable_baselines3', '.zip', 'sac.zip needs stable-baselines3: pip install stable-'),
    ],
)
def test_a_missing_library_is_named(library, suffix, line, onnx_file, tmp_path, monkeypatch):
    path = onnx_file
    if suffix == '.zip':
        path = tmp_path / 'sac.zip'
        with zipfile.ZipFile(path, 'w') as file:
            module = '{"policy_class": {"__module__": "stable_baselines3.sac.policies"}}'
            file.writestr('data', module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=line):
        load_policy(path, 'FetchReach', trust=True)


def test_export_names_missing_libraries_and_actors(tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, 'onnxscript', None)
        assert export_actor(['FetchReach', str(tmp_path / 'x.onnx')]) == 2
    assert 'onnxscript missing: pip install' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert export_actor([str(tmp_path / 'none'), str(tmp_path / 'x.onnx')]) == 2
    assert ', '.join(shipped_actors()) in capsys.readouterr().err


@pytest.mark.parametrize('algorithm', ['SAC', 'TD3', 'DDPG'])
def test_stable_baselines3_model_answers_as_it_does_there(algorithm, tmp_path):
    library = pytest.importorskip('stable_baselines3')
    env = gymnasium.make('fetch_hand_sim/FetchReach-v0')
    model = getattr(library, algorithm)(
        'MultiInputPolicy',
        env,
        replay_buffer_class=library.HerReplayBuffer,
        policy_kwargs={'net_arch': [32, 32]},
        buffer_size=1000,
        seed=1,
    )
    path = tmp_path / 'model.zip'
    model.save(path)
    found = load_policy(path, 'FetchReach', trust=True)
    for seed in range(5):
        observation = observations(REACH, seed=seed)
        wanted, _ = model.predict(observation, deterministic=True)
        assert found.predict(observation)[0].tolist() == wanted.tolist()
    batch = observations(REACH, 7)
    assert (found.policy.predict(batch)[0] == model.predict(batch, deterministic=True)[0]).all()
    with pytest.raises(ValueError, match=r'\(10,\).*HandReach.*\(63,\)'):
        load_policy(path, 'HandReach', trust=True)
    with pytest.raises(TaskMissing, match=r'model.zip'):
        load_policy(path, trust=True)


def test_a_model_acts_with_the_statistics_beside_it(tmp_path, caplog):
    library = pytest.importorskip('stable_baselines3')
    vec_env = pytest.importorskip('stable_baselines3.common.vec_env')
    env = vec_env.DummyVecEnv([lambda: gymnasium.make('fetch_hand_sim/FetchReach-v0')])
    env = vec_env.VecNormalize(env, norm_reward=False)
    model = library.PPO(
        'MultiInputPolicy', env, n_steps=64, policy_kwargs={'net_arch': [8]}, seed=1
    )
    model.learn(64)
    path = tmp_path / 'model_64_steps.zip'
    model.save(path)
    observation = observations(REACH)
    plain = load_policy(path, 'FetchReach', trust=True)
    assert 'model_64_steps.zip has no vecnormalize.pkl' in caplog.text
    caplog.clear()
    wanted, _ = model.predict(env.normalize_obs(observation), deterministic=True)
    assert plain.predict(observation)[0].tolist() != wanted.tolist()
    for name in (
        'vec_normalize.pkl',
        'vecnormalize.pkl',
        'model_64_steps_vecnormalize.pkl',
        'model_vecnormalize_64_steps.pkl',
    ):
        env.save(tmp_path / name)
        found = load_policy(path, 'FetchReach', trust=True)
        assert found.predict(observation)[0].tolist() == wanted.tolist()
        assert found.description.endswith(f'model_64_steps.zip with {name}')
        assert found.sha256 != plain.sha256
    assert not caplog.text
    statistics = tmp_path / name
    vec_env.VecNormalize(env.venv, norm_obs=False).save(statistics)
    found = load_policy(path, 'FetchReach', trust=True)
    assert found.predict(observation)[0].tolist() == plain.predict(observation)[0].tolist()
    statistics.write_bytes(pickle.dumps([1]))
    with pytest.raises(ValueError, match=f'{name} contains list'):
        load_policy(path, 'FetchReach', trust=True)


def test_an_onnx_file_that_keeps_weights_elsewhere_is_refused(onnx_file, tmp_path, monkeypatch):
    """They would be read from the working directory, and the SHA-256 would not cover them."""
    path = tmp_path / 'apart.onnx'
    onnx.save(
        onnx.load(onnx_file), path, save_as_external_data=True, location='w', size_threshold=0
    )
    monkeypatch.chdir(tmp_path)
    data = path.read_bytes()
    key, value = b'\n\x08location', b'\x12\x01w'
    assert key + value in data
    for written in (key + value, value + key):
        path.write_bytes(data.replace(key + value, written))
        with pytest.raises(ValueError, match='keeps weights in other files'):
            load_policy(path)


@pytest.mark.parametrize('method', [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_damaged_zip_is_one_line_with_any_compression(tmp_path, method):
    path = tmp_path / 'model.zip'
    with zipfile.ZipFile(path, 'w', method) as file:
        file.writestr('data', json.dumps({'policy_class': {'__module__': 'x' * 500}}))
    data = bytearray(path.read_bytes())
    for place in range(30, 60):
        torn = bytes(data[:place]) + bytes([data[place] ^ 0xFF]) + bytes(data[place + 1 :])
        path.write_bytes(torn)
        with pytest.raises(ValueError, match=r'model.zip'):
            load_policy(path, 'FetchReach', trust=True)


def test_a_model_whose_actions_were_rescaled_is_refused(tmp_path):
    """By how much is not in its file."""
    library = pytest.importorskip('stable_baselines3')
    env = gymnasium.make('fetch_hand_sim/FetchReach-v0')
    half = gymnasium.wrappers.RescaleAction(env, np.float32(-0.5), np.float32(0.5))
    path = tmp_path / 'half.zip'
    library.PPO('MultiInputPolicy', half, policy_kwargs={'net_arch': [8]}, seed=1).save(path)
    with pytest.raises(ValueError, match=r'Box\(-0.5, 0.5'):
        load_policy(path, 'FetchReach', trust=True)


class Intruder:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_a_zip_runs_no_code_without_trust(tmp_path):
    path, mark = tmp_path / 'model.zip', tmp_path / 'mark'
    with zipfile.ZipFile(path, 'w') as file:
        module = '{"policy_class": {"__module__": "stable_baselines3.sac.policies"}}'
        file.writestr('data', module)
        file.writestr('policy.pth', pickle.dumps(Intruder(mark)))
    with pytest.raises(ValueError, match=r'model.zip .*--trust.*trust:='):
        load_policy(path, 'FetchReach')
    assert not mark.exists()


def test_another_zip_is_refused(tmp_path):
    path = tmp_path / 'other.zip'
    with zipfile.ZipFile(path, 'w') as file:
        file.writestr('readme', 'hello')
    for contents in (path.read_bytes(), b'no zip', b''):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match=r'other.zip') as error:
            load_policy(path, 'FetchReach', trust=True)
        assert str(error.value).isprintable()
