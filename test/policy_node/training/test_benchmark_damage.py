"""Studies whose folders are damaged, or whose reports have nowhere to go: one line each."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from policy_node.training.benchmark.command import main
from policy_node.training.benchmark.research import STUDIES
from policy_node.training.benchmark.stored_runs import StoredRuns, read_rows

torch.set_num_threads(1)

STUDY = ['--study', 'values', '--tasks', 'FetchReach', '--arms', 'none', '--seeds', '0']
STUDY += ['--steps', '800', '--episodes', '2', '--set', 'num_envs=8', '--set', 'batch_size=64']
STUDY += ['--set', 'updates_per_cycle=4', '--set', 'evaluation_episodes=4']
STUDY += ['--set', 'evaluate_every=400']


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('study')
    assert main([*STUDY, '--output', str(folder / 'runs'), '--report', str(folder / 'told')]) == 0
    shutil.copytree(folder / 'told', folder / 'held')
    # The report of another seed, so that this one is still to be told of.
    stored = StoredRuns.read(folder / 'told')
    for row in (*stored.runs, *stored.curves):
        row['seed'] = 1
    stored.write(STUDIES['values'])
    return folder


@pytest.fixture
def study(finished: Path, tmp_path: Path) -> Path:
    """A finished study of one run, to be damaged."""
    return shutil.copytree(finished, tmp_path / 'study')


def again(study: Path, report: str = 'told') -> int:
    return main([*STUDY, '--output', str(study / 'runs'), '--report', str(study / report)])


@pytest.mark.parametrize('content', ['{', '[]', '{"episodes": 2}'])
def test_a_damaged_measure_is_taken_again(study: Path, content: str) -> None:
    final = study / 'runs' / 'FetchReach' / 'none' / 'seed0' / 'final.json'
    before = final.read_text()
    final.write_text(content)
    assert again(study) == 0
    assert final.read_text() == before
    assert len(read_rows(study / 'told' / 'runs.csv')) == 2


def test_a_damaged_run_that_the_report_holds_is_left_alone(study: Path) -> None:
    final = study / 'runs' / 'FetchReach' / 'none' / 'seed0' / 'final.json'
    final.write_text('{')
    before = (study / 'held' / 'runs.csv').read_bytes()
    assert again(study, 'held') == 0
    assert final.read_text() == '{' and (study / 'held' / 'runs.csv').read_bytes() == before


@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('progress.csv', b'\xff' * 100, 'progress.csv holds no evaluation; without '),
        ('progress.csv', b'env_steps,eval_success,eval_episodes\n400,1,4\n', "lack 'updates'"),
        ('latest.safetensors', b'', 'latest.safetensors is not a readable safetensors file'),
    ],
)
def test_a_run_that_cannot_be_told_of_is_named_and_its_report_kept(
    study: Path, name: str, content: bytes, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = study / 'runs' / 'FetchReach' / 'none' / 'seed0'
    (folder / name).write_bytes(content)
    before = (study / 'told' / 'runs.csv').read_bytes()
    assert again(study) == 1
    error = capsys.readouterr().err
    assert message in error and 'FetchReach/none/seed0: ' in error and error.count('\n') == 1
    assert f'without {folder} it is run again' in error
    assert (study / 'told' / 'runs.csv').read_bytes() == before


def test_a_report_with_no_place_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'file').write_text('')
    assert main(['--output', str(tmp_path / 'runs'), '--report', str(tmp_path / 'file')]) == 2
    error = capsys.readouterr().err
    assert error == f'benchmark: {tmp_path / "file"} cannot hold a report: File exists\n'
    assert not list((tmp_path / 'runs').iterdir())
