"""Datasets made of logged episodes, read back by the libraries they are for."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from fetch_hand_sim.commands import export_episodes
from fetch_hand_sim.episode_log import load_episodes
from policy_node.training import generate_episodes

TASK = 'FetchPush'


@pytest.fixture(scope='module')
def episodes(tmp_path_factory):
    directory = tmp_path_factory.mktemp('episodes')
    arguments = ['--policy', 'random', '--task', TASK, '--episodes', '2', '--threads', '1']
    assert generate_episodes.main([*arguments, '--output', str(directory)]) == 0
    return directory


def test_parquet_holds_every_value(episodes, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    arguments = [str(episodes), '--to', 'parquet', '--output', str(tmp_path)]
    assert export_episodes.main(arguments) == 0
    assert '2 episodes of FetchPush' in capsys.readouterr().out
    rows = parquet.read_table(tmp_path / f'{TASK}.parquet').to_pylist()
    about = parquet.read_table(tmp_path / f'{TASK}_episodes.parquet').to_pylist()
    loaded = load_episodes(episodes)
    assert len(rows) == 2 * 51
    for index, arrays in enumerate(loaded):
        mine = rows[51 * index : 51 * (index + 1)]
        assert [(row['episode_index'], row['step']) for row in mine] == [
            (index, step) for step in range(51)
        ]
        for key, values in arrays.observations.items():
            np.testing.assert_array_equal([row[key] for row in mine], values)
        steps = {'action': arrays.actions, 'command': arrays.commands, 'reward': arrays.rewards}
        steps |= {'terminated': arrays.terminated, 'truncated': arrays.truncated}
        steps |= {'next_success': arrays.success[1:]}
        for key, values in steps.items():
            np.testing.assert_array_equal([row[key] for row in mine[:-1]], values)
            assert mine[-1][key] is None
        assert mine[1]['timestamp'] == 0.04
        assert (about[index]['seed'], about[index]['steps']) == (index, 50)
        assert json.loads(about[index]['metadata']) == arrays.metadata
    assert export_episodes.main(arguments) == 1
    assert 'nothing is overwritten' in capsys.readouterr().err


def test_minari_holds_every_value_and_recovers_the_environment(episodes, tmp_path, monkeypatch):
    minari = pytest.importorskip('minari')
    pytest.importorskip('pyarrow')
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
    arguments = [str(episodes), '--to', 'minari', '--output', str(tmp_path)]
    assert export_episodes.main(arguments) == 0
    dataset = minari.load_dataset(f'{TASK}/logged-v0')
    assert (dataset.total_episodes, dataset.total_steps) == (2, 100)
    for episode, arrays in zip(dataset.iterate_episodes(), load_episodes(episodes), strict=True):
        for key, values in arrays.observations.items():
            assert episode.observations[key].tobytes() == values.tobytes()
        assert episode.actions.tobytes() == arrays.actions.tobytes()
        np.testing.assert_array_equal(episode.rewards, arrays.rewards)
        np.testing.assert_array_equal(episode.terminations, arrays.terminated)
        np.testing.assert_array_equal(episode.truncations, arrays.truncated)
        np.testing.assert_array_equal(episode.infos['is_success'][:, 0], arrays.success)
    environment = dataset.recover_environment()
    observation, _ = environment.reset(seed=0)
    first = load_episodes(episodes)[0].observations
    for key, values in observation.items():
        np.testing.assert_array_equal(values, first[key][0])
    environment.close()


@pytest.mark.parametrize(('format_', 'module'), [('parquet', 'pyarrow'), ('minari', 'minari')])
def test_a_missing_extra_is_one_line(episodes, tmp_path, format_, module):
    code = (
        'import sys\n'
        f'sys.modules[{module!r}] = None\n'
        'from fetch_hand_sim.commands.export_episodes import main\n'
        'sys.exit(main(sys.argv[1:]))'
    )
    arguments = [episodes, '--to', format_, '--output', tmp_path / 'x']
    run = subprocess.run([sys.executable, '-c', code, *arguments], capture_output=True, text=True)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith(f'export_episodes: {module} missing: pip install')


def test_usage_errors(tmp_path, capsys):
    arguments = ['--to', 'parquet', '--output', str(tmp_path / 'x')]
    assert export_episodes.main([str(tmp_path / 'missing'), *arguments]) == 2
    assert export_episodes.main([str(tmp_path), *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
    with pytest.raises(SystemExit) as caught:
        export_episodes.main([str(tmp_path), '--to', 'paper', '--output', 'x'])
    assert caught.value.code == 2
