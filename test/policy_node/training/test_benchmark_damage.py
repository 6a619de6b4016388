"""Studies whose folders are damaged, or whose reports have nowhere to go: one line each."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from policy_node.policies.files import write_files
from policy_node.training.studies import reporting
from policy_node.training.studies.actors_table import actors_table
from policy_node.training.studies.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.stored_runs import StoredRuns, read_rows
from support.full_disk import files_at_most

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
    write_files(stored.files(STUDIES['values']))
    return folder


@pytest.fixture
def study(finished: Path, tmp_path: Path) -> Path:
    """A finished study of one run, to be damaged."""
    return shutil.copytree(finished, tmp_path / 'study')


def again(study: Path, report: str = 'told') -> int:
    return main([*STUDY, '--output', str(study / 'runs'), '--report', str(study / report)])


@pytest.mark.parametrize(
    'content',
    [
        '{',
        '[]',
        *(f'{{"success": {value}, "episodes": 2}}' for value in ('"abc"', 'null', 'NaN', 2)),
    ],
)
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


@pytest.mark.parametrize(('lost', 'steps'), [(1, 0), (2, 400)])
def test_a_run_whose_log_lost_a_row_is_not_told_of(
    study: Path, lost: int, steps: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """An evaluation less is another area."""
    log = study / 'runs' / 'FetchReach' / 'none' / 'seed0' / 'progress.csv'
    lines = log.read_text().splitlines()
    lines[lost] = lines[lost][:20]
    log.write_text('\n'.join(lines))
    before = (study / 'told' / 'runs.csv').read_bytes()
    assert again(study) == 1
    assert f'progress.csv lacks rows from {steps} steps on; without ' in capsys.readouterr().err
    assert (study / 'told' / 'runs.csv').read_bytes() == before


@pytest.mark.parametrize(
    ('steps', 'lost'),
    [([400, 800], None), ([350, 750, 1150], None), ([350, 1150], 350), ([400], 400)],
)
def test_a_cycle_that_lost_an_episode_is_no_lost_row(
    tmp_path: Path, steps: list[int], lost: int | None
) -> None:
    """Episodes that MuJoCo gave up do not count."""
    (job,) = jobs_from_arguments(parse_arguments([*STUDY, '--output', str(tmp_path)]))
    job.folder.mkdir(parents=True)
    (job.folder / 'progress.csv').write_text('\n'.join(map(str, ['env_steps', *steps, ''])))
    assert reporting._lost_rows(job) == lost


@pytest.mark.parametrize(
    ('name', 'what'), [('runs.csv', 'FetchReach/none/1'), ('curves.csv', 'FetchReach/none/1/400')]
)
def test_what_a_table_has_twice_is_no_further_seed(
    study: Path, name: str, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study / 'told' / name
    head, first, *others = file.read_text().splitlines()
    file.write_text('\n'.join([head, first, *others, first]))
    assert again(study) == 2
    assert f': {what} is there twice' in capsys.readouterr().err


def test_evaluations_of_runs_that_are_not_there_are_left_out(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study / 'told' / 'runs.csv'
    head, _ = file.read_text().splitlines()
    # As a spreadsheet saves it.
    file.write_text(f'{head}\n', encoding='utf-8-sig')
    assert again(study) == 0
    assert 'runs.csv has no FetchReach/none/seed1; their eval' in capsys.readouterr().err
    for name in ('runs.csv', 'curves.csv'):
        assert {row['seed'] for row in read_rows(study / 'told' / name)} == {0}


def test_a_damaged_state_says_what_to_do(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = study / 'runs' / 'FetchReach' / 'none' / 'seed0'
    (folder / 'training_state.safetensors').write_bytes(b'cut')
    assert again(study) == 2
    assert f'without {folder} it is run again' in capsys.readouterr().err


def test_a_report_with_no_place_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'file').write_text('')
    assert main(['--output', str(tmp_path / 'runs'), '--report', str(tmp_path / 'file')]) == 2
    error = capsys.readouterr().err
    assert error == f'benchmark: {tmp_path / "file"} cannot hold a report: File exists\n'
    assert not list((tmp_path / 'runs').iterdir())


def test_a_full_disk_leaves_the_report_as_it_was(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = study / 'told' / 'README.md'
    page.write_text(f'{page.read_text()}{"words " * 20_000}')
    before = {path.name: path.read_bytes() for path in (study / 'told').iterdir()}
    with files_at_most(100_000):
        assert again(study) == 1
    error = capsys.readouterr().err
    assert f'no report in {study / "told"}: ' in error and str(page) in error
    assert {path.name: path.read_bytes() for path in (study / 'told').iterdir()} == before
    assert again(study) == 0
    assert page.read_text().endswith('words ')


@pytest.mark.parametrize(
    ('name', 'column', 'cell', 'message'),
    [
        ('runs.csv', 'area', 'abc', "runs.csv, line 2: area 'abc' is no number"),
        ('runs.csv', 'final_success', '', "runs.csv, line 2: final_success '' is no number"),
        ('runs.csv', 'seed', 'x', "runs.csv, line 2: seed 'x' is no number"),
        ('runs.csv', 'seed', '1.5', 'runs.csv, line 2: seed 1.5 is no whole number'),
        ('runs.csv', 'seed', '1,1', 'runs.csv, line 2, has more cells than there are columns'),
        ('curves.csv', 'success', 'nan', 'curves.csv, line 2: success nan is no number'),
    ],
)
def test_a_damaged_table_is_named_before_anything_runs(
    study: Path,
    name: str,
    column: str,
    cell: str,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = study / 'told' / name
    head, first, *others = file.read_text().splitlines()
    # The last columns, where a machine has a comma in its name, are not looked at.
    cells = first.split(',')
    cells[head.split(',').index(column)] = cell
    file.write_text('\n'.join([head, ','.join(cells), *others]))
    assert again(study) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


@pytest.mark.parametrize(
    ('name', 'before', 'message'),
    [
        ('runs.csv', 'final_episodes', "runs.csv has no column 'final_episodes'"),
        ('study.json', '"gamma"', 'study.json, FetchReach/none: unknown configuration fields'),
    ],
)
def test_a_damaged_name_is_named_before_anything_runs(
    study: Path, name: str, before: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study / 'told' / name
    file.write_text(file.read_text().replace(before, f'{before[:-1]}x{before[-1]}'))
    assert again(study) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


def test_a_run_whose_actor_is_damaged_before_it_is_measured_fails_alone(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = study / 'runs' / 'FetchReach' / 'none' / 'seed0'
    (folder / 'final.json').unlink()
    (folder / 'latest.safetensors').write_bytes(b'cut')
    assert again(study) == 1
    error = capsys.readouterr().err
    assert 'benchmark: FetchReach/none/seed0: ' in error and error.count('\n') == 1


def test_a_damaged_evaluation_among_actors_is_named(tmp_path: Path) -> None:
    (tmp_path / 'FetchPush.json').write_text(json.dumps({'success_gymnasium': 'good'}))
    with pytest.raises(ValueError, match=r'FetchPush\.json is no evaluation of an actor'):
        actors_table(tmp_path)
