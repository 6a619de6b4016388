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
from policy_node.policies.files import read_tensors
from policy_node.policies.loading import TaskMissing, load_actor, load_policy, shipped_actors
from support.fresh_actor import fresh_actor, observations

onnx = pytest.importorskip('onnx')
TensorProto, helper, numpy_helper = onnx.TensorProto, onnx.helper, onnx.numpy_helper
REACH = task_spec('FetchReach')
SAC = json.dumps({'policy_class': {'__module__': 'stable_baselines3.sac.policies'}})


def assert_refused(path, match, task='FetchReach', *, trust=True):
    """The policy is rejected in one line that is safe to print."""
    with pytest.raises(ValueError, match=match) as error:
        load_policy(path, task, trust=trust)
    assert str(error.value).isprintable()


def test_an_exported_actor_answers_as_its_checkpoint(tmp_path, monkeypatch):
    """One export for all checks, because torch's exporter takes seconds to load."""
    path = tmp_path / 'new' / 'reach.onnx'
    assert export_actor(['FetchReach', str(path)]) == 0
    # A module beside it is not imported.
    (tmp_path / 'numpy.py').write_text('raise RuntimeError("not asked for")')
    monkeypatch.chdir(tmp_path)
    found, actor = load_policy(path), load_actor('FetchReach')
    for leading in ((), (20,), (2, 3)):
        observation = observations(REACH, *leading)
        action, _ = found.policy.predict(observation)
        np.testing.assert_allclose(action, actor.predict(observation)[0], atol=1e-5)
    about = found.task, found.control_hz, found.description, found.sha256
    assert about == ('FetchReach', 25.0, 'actor reach.onnx', checkpoint.checkpoint_hash(path))
    code = f'import sys; from policy_node import load_policy; load_policy({str(path)!r})\n'
    code += 'assert "torch" not in sys.modules'
    subprocess.run([sys.executable, '-P', '-c', code], check=True)
    assert_refused(path, 'FetchReach, not on HandReach', 'HandReach')
    cut = tmp_path / 'cut.onnx'
    cut.write_bytes(path.read_bytes()[:1000])
    assert_refused(cut, r'cut\.onnx')
    # Weights in the working directory, which the SHA-256 would not cover.
    apart = tmp_path / 'apart.onnx'
    outside = {'save_as_external_data': True, 'location': 'w', 'size_threshold': 0}
    onnx.save(onnx.load(path), apart, **outside)
    data, key, value = apart.read_bytes(), b'\n\x08location', b'\x12\x01w'
    assert key + value in data
    for written in (key + value, value + key):
        apart.write_bytes(data.replace(key + value, written))
        assert_refused(apart, 'keeps weights in other files')


def crafted_onnx(path, nodes, numbers):
    """An ONNX file with the inputs, the output and the metadata of an actor of FetchReach."""
    fresh_actor(path.with_suffix('.safetensors'), 'FetchReach')
    _, metadata = read_tensors(path.with_suffix('.safetensors'))
    inputs, output = (
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, ['batch', s]) for n, s in places]
        for places in ([('observation', 10), ('desired_goal', 3)], [('action', 4)])
    )
    constants = [numpy_helper.from_array(np.array(v), name) for name, v in numbers.items()]
    head = helper.make_node('Slice', ['observation', 'zero', 'four', 'one'], ['head'])
    graph = helper.make_graph([head, *nodes], 'crafted', inputs, output, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)], ir_version=8)
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


COLUMNS = {'zero': [0], 'four': [4], 'one': [1]}


def test_small_onnx_files_that_need_gigabytes_are_refused(tmp_path):
    nodes = [
        helper.make_node('ConstantOfShape', ['shape'], ['zeros']),
        helper.make_node('ReduceSum', ['zeros'], ['sum'], keepdims=0),
        helper.make_node('Add', ['head', 'sum'], ['action']),
    ]
    path = crafted_onnx(tmp_path / 'bomb.onnx', nodes, {**COLUMNS, 'shape': [2**31]})
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    began = time.perf_counter()
    assert_refused(path, r'bomb\.onnx')
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 4.0
    assert time.perf_counter() - began < 20.0


# It computes for up to 30 s.
@pytest.mark.release
def test_onnx_that_computes_for_ever_is_refused(tmp_path):
    value = helper.make_tensor_value_info
    inputs = [value('index', TensorProto.INT64, []), value('go_in', TensorProto.BOOL, [])]
    steps = [
        helper.make_node('Identity', ['go_in'], ['go_out']),
        helper.make_node('Tanh', ['state'], ['next']),
    ]
    body = helper.make_graph(
        steps,
        'body',
        [*inputs, value('state', TensorProto.FLOAT, None)],
        [value('go_out', TensorProto.BOOL, []), value('next', TensorProto.FLOAT, None)],
    )
    nodes = [helper.make_node('Loop', ['count', 'go', 'head'], ['action'], body=body)]
    path = crafted_onnx(tmp_path / 'loop.onnx', nodes, {**COLUMNS, 'count': 2**60, 'go': True})
    assert_refused(path, r'loop\.onnx .*400 MiB.*\(exit code -(9|24)\)$')


def zip_of(path, method=zipfile.ZIP_STORED, **members):
    with zipfile.ZipFile(path, 'w', method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ('library', 'name', 'line'),
    [
        ('onnxruntime', 'reach.onnx', 'reach.onnx needs onnxruntime: pip install onnxruntime'),
        ('stable_baselines3', 'sac.zip', 'sac.zip needs stable-baselines3: pip install stable-'),
    ],
)
def test_a_missing_library_is_named(library, name, line, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    assert_refused(zip_of(tmp_path / name, data=SAC), line)


def test_export_names_the_shipped_actors(tmp_path, capsys):
    assert export_actor([str(tmp_path / 'none'), str(tmp_path / 'x.onnx')]) == 2
    assert ', '.join(shipped_actors()) in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


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
    for observation in (observations(REACH), observations(REACH, 7)):
        wanted, _ = model.predict(observation, deterministic=True)
        assert found.predict(observation)[0].tolist() == wanted.tolist()
    assert_refused(path, r'\(10,\).*HandReach.*\(63,\)', 'HandReach')
    with pytest.raises(TaskMissing, match=r'model.zip'):
        load_policy(path, trust=True)


@pytest.mark.parametrize('algorithm', ['A2C', 'PPO'])
def test_a_model_acts_with_the_statistics_beside_it(algorithm, tmp_path, caplog):
    library = pytest.importorskip('stable_baselines3')
    vec_env = pytest.importorskip('stable_baselines3.common.vec_env')
    env = vec_env.DummyVecEnv([lambda: gymnasium.make('fetch_hand_sim/FetchReach-v0')])
    env = vec_env.VecNormalize(env, norm_reward=False)
    model = getattr(library, algorithm)(
        'MultiInputPolicy', env, n_steps=64, policy_kwargs={'net_arch': [8]}, seed=1
    )
    model.learn(64)
    path = tmp_path / 'model_64_steps.zip'
    model.save(path)
    observation = observations(REACH)
    plain = load_policy(path, 'FetchReach', trust=True)
    assert plain.description == f'Stable-Baselines3 {algorithm} model_64_steps.zip'
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
    assert_refused(path, f'{name} contains list')


def test_a_model_whose_actions_were_rescaled_is_refused(tmp_path):
    library = pytest.importorskip('stable_baselines3')
    env = gymnasium.make('fetch_hand_sim/FetchReach-v0')
    half = gymnasium.wrappers.RescaleAction(env, np.float32(-0.5), np.float32(0.5))
    path = tmp_path / 'half.zip'
    library.PPO('MultiInputPolicy', half, policy_kwargs={'net_arch': [8]}, seed=1).save(path)
    assert_refused(path, r'Box\(-0.5, 0.5')


class Intruder:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_a_zip_runs_no_code_without_trust(tmp_path):
    mark = tmp_path / 'mark'
    path = zip_of(tmp_path / 'model.zip', data=SAC, **{'policy.pth': pickle.dumps(Intruder(mark))})
    assert_refused(path, r'model.zip .*--trust.*trust:=', trust=False)
    assert not mark.exists()


def test_another_or_damaged_zip_is_refused_with_any_compression(tmp_path):
    path = zip_of(tmp_path / 'model.zip', readme='hello')
    contents = [path.read_bytes(), b'no zip', b'']
    long = json.dumps({'policy_class': {'__module__': 'x' * 500}})
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        data = zip_of(path, method, data=long).read_bytes()
        contents += [data[:i] + bytes([data[i] ^ 0xFF]) + data[i + 1 :] for i in range(30, 60)]
    for content in contents:
        path.write_bytes(content)
        assert_refused(path, r'model.zip')
    zip_of(path, data=json.dumps({'policy_class': {'__module__': 'other.policies'}}))
    assert_refused(path, 'other.policies; allowed: SAC, TD3, PPO, A2C, TQC')
