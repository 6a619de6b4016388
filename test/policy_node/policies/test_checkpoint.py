"""Checkpoints: exact round trips, and one-line errors for invalid files."""

from __future__ import annotations

import json
import os
import pickle
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import save_file

from policy_node.policies import checkpoint
from policy_node.policies.files import read_tensors
from support.fresh_actor import fresh_actor


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / 'actor.safetensors'
    fresh_actor(path, 'FetchPush', hidden_sizes=(8, 8), layer_norm=True)
    return path


def rewrite(path: Path, tensors: dict[str, Any] | None = None, **metadata: str) -> None:
    """Replaces tensors (None removes one) and metadata of a checkpoint."""
    old_tensors, old_metadata = read_tensors(path)
    merged = {k: v for k, v in {**old_tensors, **(tensors or {})}.items() if v is not None}
    save_file(merged, path, {**old_metadata, **metadata})


def test_round_trip_keeps_every_bit(tmp_path: Path) -> None:
    path = tmp_path / 'a.safetensors'
    fields: dict[str, Any] = {
        'seed': 7,
        'hidden_sizes': (8, 8),
        'command': "fetch_hand_sim train --task FetchPush --set 'hidden_sizes=8,8'",
        'source_revision': 'abc',
        'env_steps': 1000,
        'config': {'gamma': 0.98},
        'success': {'last_step': 0.5},
    }
    actor = fresh_actor(path, 'FetchPush', **fields)
    loaded, info = checkpoint.load(path, task='FetchPush')
    assert info == replace(checkpoint.read_info(path), **fields)
    assert loaded.state_dict().keys() == actor.state_dict().keys()
    for name, value in actor.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    assert list(tmp_path.iterdir()) == [path]
    # Readable without this package.
    with safe_open(path, framework='np') as file:
        metadata = file.metadata()
    assert json.loads(metadata['task']) == 'FetchPush'
    assert json.loads(metadata['observation_layout'])[0] == ['end_effector_position', 3]


def with_length(header: bytes) -> bytes:
    return len(header).to_bytes(8, 'little') + header


def assert_refused(path: Path, match: str, task: str | None = None) -> None:
    with pytest.raises(ValueError, match=match) as caught:
        checkpoint.load(path, task)
    assert str(caught.value).isprintable() and str(path) in str(caught.value)


@pytest.mark.parametrize(
    ('content', 'match'),
    [
        (pickle.dumps({'weights': [1, 2, 3]}), 'safetensors'),
        (b'', 'safetensors'),
        (with_length(b'{"a": 1}'), 'safetensors'),
        (with_length(b'{"__metadata__": []}'), 'safetensors|format None'),
        (with_length(b'[' + b'[],' * 700_000 + b'[]]'), r'header of \d+ bytes'),
    ],
)
def test_invalid_safetensors_files_are_rejected(tmp_path: Path, content: bytes, match: str) -> None:
    path = tmp_path / 'actor.safetensors'
    path.write_bytes(content)
    assert_refused(path, match)
    # Larger than the memory: refused unread.
    os.truncate(path, 10**12)
    assert_refused(path, '67108864')
    assert_refused(tmp_path / 'missing', 'is no file')


def test_missing_metadata_are_rejected(saved: Path) -> None:
    tensors, metadata = read_tensors(saved)
    del metadata['seed']
    save_file(tensors, saved, metadata)
    assert_refused(saved, 'lacks metadata: seed')


@pytest.mark.parametrize(
    ('name', 'values', 'match'),
    [
        ('goal_normalizer.mean', np.zeros(5, np.float32), r'goal_normalizer.mean \(5,\)'),
        ('goal_normalizer.mean', np.zeros(3), 'float64'),
        ('goal_normalizer.std', np.zeros(3, np.float32), 'goal_normalizer.std'),
        # Escape characters never reach the terminal.
        ('\x1b[31mred', np.zeros(1, np.float32), r'red \(1,\).* none'),
        ('network.output.bias', np.float32([0, 0, np.nan, 0]), 'network.output.bias'),
    ],
)
def test_invalid_tensors_are_rejected(
    saved: Path, name: str, values: np.ndarray | None, match: str
) -> None:
    rewrite(saved, {name: values})
    assert_refused(saved, match)


# Crafted files: each answers at once, in one line


@pytest.mark.parametrize(
    ('field', 'text', 'match'),
    [
        ('format_version', '2', 'version 2'),
        ('format', 'something', 'something'),
        ('hidden_sizes', '[40000, 40000]', r'hidden.0.bias \(8,\)'),
        ('hidden_sizes', '[-1]', r'hidden_sizes: \[-1\]'),
        ('hidden_sizes', '[true]', 'True'),
        ('hidden_sizes', '[' * 100_000 + ']' * 100_000, 'hidden_sizes'),
        ('config', '[]', r'config: \[\]'),
        ('observation_layout', '[[["a"], 3]]', 'observation_layout'),
        ('goal_size', '7', 'has goal 7'),
        ('action_size', '20', 'has action 20'),
        ('observation_layout', '[["joints", 25]]', 'has observation .*joints'),
        ('task', '"FetchFly"', "'FetchFly'"),
        ('layer_norm', '1', 'layer_norm: 1'),
        ('control_hz', 'NaN', 'control_hz'),
        ('control_hz', '[25]', r'\[25\]'),
        ('seed', '9' * 5000, 'seed'),
        ('goal_features', '"\\u001b[31m"', 'goal_features'),
    ],
)
def test_invalid_metadata_are_rejected_at_once(
    saved: Path, field: str, text: str, match: str
) -> None:
    rewrite(saved, **{field: text})
    began = time.process_time()
    assert_refused(saved, match)
    assert time.process_time() - began < 1.0
