"""Episodes in the tools people use: Foxglove's own code, pymcap-cli, and what viewers need."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fetch_hand_sim.episode_log import read_episode, recover_episode
from msgs_spec.codecs import decode
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topic, topics
from policy_node.training import generate_episodes
from support import SUPPORT

NPM_PACKAGES = (
    '@mcap/core@2.2.2',
    '@mcap/nodejs@1.0.2',
    '@mcap/support@1.1.0',
    '@foxglove/rosmsg@5.0.5',
    '@foxglove/rosmsg2-serialization@3.1.0',
)
SCRIPT = SUPPORT / 'foxglove_reader.mjs'
PYMCAP_CLI = Path(sys.executable).with_name('pymcap-cli')
# Types that viewers draw in space.
SPATIAL = ('PointStamped', 'PoseStamped', 'PoseArray', 'TwistStamped')


def generated(directory, task):
    arguments = ['--policy', 'random', '--task', task, '--episodes', '1', '--threads', '1']
    assert generate_episodes.main([*arguments, '--output', str(directory)]) == 0
    return min(directory.iterdir())


@pytest.fixture(
    scope='module',
    params=[
        'HandManipulateEggFull',
        pytest.param('FetchPickAndPlace', marks=pytest.mark.release),
        pytest.param('HandReach', marks=pytest.mark.release),
    ],
)
def episode(request, tmp_path_factory):
    """A complete episode of each family."""
    return generated(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope='module')
def recovered(episode, tmp_path_factory):
    """Half of it, recovered."""
    leftover = tmp_path_factory.mktemp('cut') / f'.{episode.name}.active'
    leftover.mkdir()
    name = f'{episode.name}_0.mcap'
    data = (episode / name).read_bytes()
    (leftover / name).write_bytes(data[: len(data) * 3 // 5])
    return recover_episode(leftover)


@pytest.fixture(scope='module')
def npm_packages():
    """Foxglove's packages, installed once into the user's cache."""
    if not shutil.which('node') or not shutil.which('npm'):
        pytest.skip('node and npm are not installed')
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    folder = cache / 'fetch_hand_sim' / 'foxglove_reader'
    wanted = '\n'.join(NPM_PACKAGES)
    stamp = folder / 'installed.txt'
    if not stamp.exists() or stamp.read_text() != wanted:
        folder.mkdir(parents=True, exist_ok=True)
        command = ['npm', 'install', '--no-audit', '--no-fund', '--prefix', folder, *NPM_PACKAGES]
        try:
            install = subprocess.run(command, capture_output=True, text=True, timeout=120)
        except subprocess.TimeoutExpired:
            pytest.skip('npm install took longer than 120 s')
        if install.returncode:
            pytest.skip(f'npm install failed: {install.stderr.strip().splitlines()[-1:]}')
        stamp.write_text(wanted)
    return folder


@pytest.fixture(params=['whole', 'recovered'])
def either(request, episode, recovered):
    """The complete episode, and the recovered one."""
    return episode if request.param == 'whole' else recovered


@pytest.mark.release
def test_foxglove_reads_every_message(either, npm_packages):
    logged = read_episode(either)
    result = subprocess.run(
        ['node', SCRIPT, npm_packages, logged.path], capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found['counts'] == {name: len(t.messages) for name, t in logged.topics.items()}
    assert found['trailing'] == 0
    assert found['metadata']['episode'] == logged.metadata
    assert found['metadata']['episode_result'] == logged.result
    assert found['attachments'] == len(logged.attachments)
    spec = topic(TASKS[logged.metadata['task']], 'joint_states')
    expected = [
        decode(spec, deserialize(spec.type_name, message.data))[: len(spec.names)].tolist()
        for message in logged.topics['/joint_states'].messages
    ]
    assert found['positions'] == expected


def test_the_doctor_finds_no_error(either):
    """`pymcap-cli` is under the GPL: it runs as a program and is never imported."""
    if not PYMCAP_CLI.exists():
        pytest.skip('pymcap-cli is not installed')
    file = read_episode(either).path
    command = [PYMCAP_CLI, 'doctor', '--format', 'jsonl', '--strict-message-order', file]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout + result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines() if line.startswith('{')]
    (summary,) = [line for line in lines if line['type'] == 'summary']
    assert summary['errors'] == 0 and summary['complete']
    # Of two `rosbag2` records the last counts; rosbag2 itself writes two as well. That chunks are
    # small, which is worth an information to the doctor, is what a kill loses little for.
    codes = {line['code'] for line in lines if line.get('severity') not in (None, 'info')}
    assert codes <= {'METADATA_NAME_DUPLICATE'}, result.stdout


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_viewers_need_no_transforms(task):
    """All that has a place is in one frame, which RViz and Foxglove then show without `/tf`."""
    spatial = [s for s in topics(task) if s.type_name.rpartition('/')[2] in SPATIAL]
    assert len(spatial) >= 3
    assert {spec.frame for spec in spatial} == {'world'}
