"""Checkpoints: exact round trips, and one clear line for whatever does not fit."""

from __future__ import annotations

import hashlib
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor, NetworkShape
from policy_node.policies.checkpoint import ActorInfo


def make_info(task: str = 'FetchPush', **changes: Any) -> ActorInfo:
    spec = task_spec(task)
    info = ActorInfo(
        task=task,
        observation_layout=checkpoint.observation_layout(spec),
        goal_size=spec.goal.size,
        action_size=spec.robot.action_size,
        hidden_sizes=(8, 8),
        layer_norm=True,
        control_hz=25.0,
        seed=7,
        command="train_her --task FetchPush --set 'hidden_sizes=8,8'",
        source_revision='abc',
        env_steps=1000,
        config={'gamma': 0.98},
        success={'last_step': 0.5},
    )
    return replace(info, **changes)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    info = make_info()
    path = tmp_path / 'actor.safetensors'
    checkpoint.save(path, Actor(info.shape), info)
    return path


def rewrite(path: Path, tensors: dict[str, Any] | None = None, **metadata: str) -> None:
    """Replaces tensors (None removes one) and metadata of a checkpoint."""
    old_tensors, old_metadata = checkpoint.read_tensors(path)
    merged = {k: v for k, v in {**old_tensors, **(tensors or {})}.items() if v is not None}
    save_file(merged, path, {**old_metadata, **metadata})


def test_round_trip_keeps_every_bit(tmp_path: Path) -> None:
    info = make_info()
    actor = Actor(info.shape)
    actor.observation_normalizer.mean.uniform_()
    checkpoint.save(tmp_path / 'a.safetensors', actor, info)
    loaded, loaded_info = checkpoint.load(tmp_path / 'a.safetensors', task='FetchPush')
    assert loaded_info == info == checkpoint.read_info(tmp_path / 'a.safetensors')
    assert loaded.state_dict().keys() == actor.state_dict().keys()
    for name, value in actor.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    assert [path.name for path in tmp_path.iterdir()] == ['a.safetensors']


def test_metadata_can_be_read_without_this_package(saved: Path) -> None:
    with safe_open(saved, framework='np') as file:
        metadata = file.metadata()
    assert json.loads(metadata['task']) == 'FetchPush'
    assert json.loads(metadata['observation_layout'])[0] == ['end_effector_position', 3]


def test_hash_is_sha256_of_the_file(saved: Path) -> None:
    assert checkpoint.checkpoint_hash(saved) == hashlib.sha256(saved.read_bytes()).hexdigest()


def test_saving_refuses_metadata_of_another_shape(tmp_path: Path) -> None:
    actor = Actor(NetworkShape(25, 3, 4, (8, 8), layer_norm=False))
    with pytest.raises(ValueError, match='its metadata say'):
        checkpoint.save(tmp_path / 'a.safetensors', actor, make_info())
    assert not list(tmp_path.iterdir())


def assert_refused(path: Path, match: str, task: str | None = None) -> None:
    with pytest.raises(ValueError, match=match) as caught:
        checkpoint.load(path, task)
    assert '\n' not in str(caught.value)
    assert str(path) in str(caught.value)


def test_another_task_is_refused(saved: Path) -> None:
    assert_refused(saved, 'was trained on FetchPush, not on FetchSlide', task='FetchSlide')


def test_what_is_no_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / 'actor.safetensors'
    path.write_bytes(pickle.dumps({'weights': [1, 2, 3]}))
    assert_refused(path, 'not a readable safetensors file')
    path.write_bytes(b'')
    assert_refused(path, 'not a readable safetensors file')
    assert_refused(tmp_path / 'missing', 'not a readable safetensors file')


def test_a_truncated_file_is_refused(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes()[:-10])
    assert_refused(saved, 'not a readable safetensors file')


def test_other_formats_and_versions_are_refused(saved: Path) -> None:
    rewrite(saved, format_version='2')
    assert_refused(saved, 'format version 2; supported: 1')
    rewrite(saved, format='something')
    assert_refused(saved, "no actor checkpoint .*'something'")


def test_missing_or_broken_metadata_are_refused(saved: Path) -> None:
    rewrite(saved, hidden_sizes='"wide"')
    assert_refused(saved, 'unreadable metadata')
    tensors, metadata = checkpoint.read_tensors(saved)
    del metadata['seed']
    save_file(tensors, saved, metadata)
    assert_refused(saved, 'lacks metadata: seed')


@pytest.mark.parametrize(
    ('field', 'value', 'match'),
    [
        ('goal_size', '7', 'has goal 7; FetchPush has 3'),
        ('action_size', '20', 'has action 20; FetchPush has 4'),
        ('observation_layout', '[["joints", 25]]', 'has observation .*joints.*; FetchPush has'),
        ('task', '"FetchFly"', "was trained on unknown task 'FetchFly'"),
    ],
)
def test_sizes_of_another_task_are_refused(saved: Path, field: str, value: str, match: str) -> None:
    rewrite(saved, **{field: value})
    assert_refused(saved, match)


def test_tensors_that_do_not_fit_the_metadata_are_refused(saved: Path) -> None:
    rewrite(saved, {'goal_normalizer.mean': torch.zeros(5)})
    assert_refused(saved, r'tensor goal_normalizer.mean \(5,\); its metadata ask for \(3,\)')
    rewrite(saved, {'goal_normalizer.mean': None})
    assert_refused(saved, r'tensor goal_normalizer.mean none')
    rewrite(saved, {'goal_normalizer.mean': torch.zeros(3), 'extra': torch.zeros(1)})
    assert_refused(saved, r'tensor extra \(1,\); its metadata ask for none')
