"""A study in a module of the user, as the page of the studies shows it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from policy_node.training.studies.command import main, parse_arguments
from policy_node.training.studies.store import read_runs

PAGE = Path(__file__).parents[3] / 'docs' / 'research' / 'studies.md'
SMALL = ['--seeds', '0', '--steps', '800', '--episodes', '2', '--set', 'num_envs=8']
SMALL += ['--set', 'evaluation_episodes=4', '--set', 'evaluate_every=400']


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Its name; the working directory has it."""
    (example,) = re.findall(r'```python\n(.*?)```', PAGE.read_text(), re.DOTALL)
    name = f'studies_of_{tmp_path.name}'.replace('-', '_')
    (tmp_path / f'{name}.py').write_text(
        f'{example}\nFAILS = 3\n'
        + example.replace('WIDTHS', 'TAKEN').replace("'widths'", "'values'")
    )
    monkeypatch.chdir(tmp_path)
    return name


@pytest.mark.release
def test_the_study_of_the_page_runs(module: str, tmp_path: Path) -> None:
    assert main(['--study', f'{module}:WIDTHS', *SMALL]) == 0
    report = tmp_path / 'docs' / 'research' / 'widths'
    assert [run['arm'] for run in read_runs(report).values()] == ['w256', 'w64']
    assert (report / 'figure.png').is_file()
    assert (tmp_path / 'runs' / 'research' / 'widths' / 'FetchReach' / 'w64' / 'seed0').is_dir()


def test_columns_of_the_tables_are_explained() -> None:
    text, folder = PAGE.read_text(), PAGE.parent / 'values'
    for name in next(iter(read_runs(folder).values())):
        assert f'`{name}`' in text


@pytest.mark.parametrize(
    ('name', 'line'),
    [
        ('{}:FAILS', ':FAILS is a int; allowed: a Study'),
        ('{}:TAKEN', "is called 'values'; allowed: a word that no other study is"),
        ('{}:OTHER', ":OTHER: AttributeError: module '"),
        ('nowhere_at_all:STUDY', "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ('gaols', "module:NAME; did you mean 'goals'?"),
    ],
)
def test_what_is_no_study_is_refused(
    module: str, name: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parse_arguments(['--study', name.format(module)])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and line in error and error.count('\n') == 1
