"""Policy files that are damaged, crafted or written by two processes at the same time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from policy_node.policies.checkpoint import parse_metadata
from policy_node.policies.files import parse_tensors, tensor_bytes, write_files
from policy_node.policies.loading import load_policy
from support import peak_memory, reset_peak_memory
from support.fresh_actor import fresh_actor

# Invalid values for metadata.
VALUES = [
    *('null', 'true', '-1', '0', '1e999', 'NaN', '""', '[]', '{}', '[[]]', '[-1]', '[null]'),
    *('[1e999]', '[40000, 40000]', '"FetchPush"', '"\\u001b[31m"', '[' * 50_000, '9' * 5_000),
    *('9' * 4_000, '[' + '9' * 4_000 + ']'),
    *('{"a": ' * 20_000, '"' + 'x' * 100_000 + '"', '[1.5]', '[true]', '12.5', '[["a", -1]]', ''),
]


@pytest.fixture(scope='module')
def actor(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp('actor') / 'a.safetensors'
    fresh_actor(path, 'FetchReach')
    return path.read_bytes()


def damaged(data: bytes, generator: np.random.Generator) -> bytes:
    """Change bytes, most in the header; lose or double a piece."""
    changed = bytearray(data)
    for _ in range(generator.integers(1, 8)):
        within = len(data) if generator.random() < 0.3 else min(len(data), 3000)
        changed[generator.integers(within)] = generator.integers(256)
    cut = int(generator.integers(len(data)))
    kind = generator.random()
    if kind < 0.1:
        return bytes(changed[:cut])
    return bytes(changed + changed[cut:]) if kind < 0.2 else bytes(changed)


def crafted(data: bytes, generator: np.random.Generator) -> bytes:
    tensors, metadata = parse_tensors(data, 'a.safetensors')
    names = [name for name in metadata if name not in ('format', 'format_version')]
    for _ in range(generator.integers(1, 3)):
        metadata[str(generator.choice(names))] = VALUES[generator.integers(len(VALUES))]
    return tensor_bytes(tensors, metadata)


def is_refused(path: Path) -> bool:
    """Return whether the file is rejected; then the error is one line that is safe to print."""
    began = time.process_time()
    try:
        load_policy(path)
    except ValueError as error:
        line = str(error)
        assert line.isprintable() and len(line) < 1000, line[:2000]
        return True
    finally:
        assert time.process_time() - began < 5.0
    return False


@pytest.mark.parametrize('change', [damaged, crafted])
def test_damaged_and_crafted_checkpoints(change, actor, tmp_path, hostile_count) -> None:
    generator = np.random.default_rng(6)
    path = tmp_path / 'a.safetensors'
    count = hostile_count // 10
    reset_peak_memory()
    before = peak_memory()
    refused = 0
    for _ in range(count):
        path.write_bytes(change(actor, generator))
        refused += is_refused(path)
    assert refused > count / 3
    grown = peak_memory() - before
    assert grown < 100_000_000, f'{grown} bytes more'


@pytest.mark.release
def test_damaged_and_crafted_onnx_files(actor, tmp_path, hostile_count) -> None:
    generator = np.random.default_rng(7)
    onnx = pytest.importorskip('onnx')
    export = pytest.importorskip('policy_node.policies.export_actor').export
    source, path = tmp_path / 'a.safetensors', tmp_path / 'a.onnx'
    source.write_bytes(actor)
    export(source, path)
    data = path.read_bytes()
    refused = 0
    for index in range(hostile_count // 500):
        if index % 2:
            path.write_bytes(damaged(data, generator))
        else:
            model = onnx.load_from_string(data)
            pair = model.metadata_props[generator.integers(len(model.metadata_props))]
            pair.value = VALUES[generator.integers(len(VALUES))]
            path.write_bytes(model.SerializeToString())
        refused += is_refused(path)
    assert refused


def test_actor_files_of_every_format_have_little_metadata(actor) -> None:
    _, metadata = parse_tensors(actor, 'a.safetensors')
    parse_metadata(metadata, 'a.onnx')
    large = '{"a": [' + '{},' * 400_000 + '{}]}'
    with pytest.raises(ValueError, match='1048576 characters'):
        parse_metadata({**metadata, 'config': large}, 'a.onnx')


_WRITER = """
import sys
from pathlib import Path
from policy_node.policies.files import write_files
file, letter = Path(sys.argv[1]), sys.argv[2].encode()
for _ in range(25):
    write_files({file: letter * 100_000})
"""


def test_a_file_that_two_processes_write_at_once_is_always_whole(tmp_path: Path) -> None:
    file = tmp_path / 'benchmark.csv'
    write_files({file: b'a' * 100_000})
    writers = [
        subprocess.Popen([sys.executable, '-c', _WRITER, str(file), letter]) for letter in 'ab'
    ]
    while any(writer.poll() is None for writer in writers):
        data = file.read_bytes()
        assert data in (b'a' * 100_000, b'b' * 100_000), 'a reader sees one or the other'
    assert [writer.returncode for writer in writers] == [0, 0]
    assert os.listdir(tmp_path) == [file.name]
