"""Studies of the requests for research: their jobs, what is measured, and the pages."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from policy_node.training.benchmark.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.benchmark.measures import are_apart, area_under, sum_up
from policy_node.training.benchmark.research import STEP_COUNTS, STUDIES, Study
from policy_node.training.benchmark.research_report import BEGIN, END
from policy_node.training.benchmark.results import Curve
from policy_node.training.learning.config import TrainConfig
from support import ROOT

torch.set_num_threads(1)

SMALL = ['--study', 'unbiased', '--seeds', '0', '--steps', '800', '--episodes', '4']
SMALL += ['--set', 'num_envs=4', '--set', 'updates_per_cycle=2', '--set', 'evaluation_episodes=4']


@pytest.mark.parametrize('study', STUDIES.values(), ids=list(STUDIES))
def test_arms_of_a_study_share_all_but_what_is_theirs(study: Study, tmp_path: Path) -> None:
    for task in study.tasks:
        options = ['--study', study.name, '--tasks', task, '--output', str(tmp_path)]
        jobs = jobs_from_arguments(parse_arguments(options))
        assert len(jobs) == study.seeds * len(study.arms)
        own = {name for arm in study.arms for name in arm.changes} | {'seed'}
        if 'control_hz' in own:
            own |= set(STEP_COUNTS)
            seconds = {job.config.total_steps / job.config.control_hz for job in jobs}
            assert len(seconds) == 1, 'budgets are the same in simulated time'
        shared = [name for name in TrainConfig.__slots__ if name not in own]
        first = jobs[0].config
        assert all(
            getattr(job.config, name) == getattr(first, name) for job in jobs for name in shared
        )
        assert len({job.config for job in jobs}) == len({job.folder for job in jobs}) == len(jobs)
        assert first.simulation_threads == first.torch_threads == 1 and not first.overlap


def test_every_study_has_its_page_and_every_request_its_line() -> None:
    index = (ROOT / 'docs' / 'research' / 'README.md').read_text()
    for study in STUDIES.values():
        assert f'({study.name}/README.md)' in index
        assert study.request is None or f'| {study.request} [' in index
        page = (ROOT / 'docs' / 'research' / study.name / 'README.md').read_text()
        assert f'benchmark --study {study.name}' in page and BEGIN in page and END in page
    assert {study.request for study in STUDIES.values()} == {None, *range(1, 10)}


def test_the_area_is_the_mean_success_over_the_budget() -> None:
    curve = Curve(np.array([100.0, 200.0, 400.0]), np.array([0.0, 1.0, 1.0]), 10)
    assert area_under(curve, 400) == pytest.approx((0 + 50 + 200) / 400)
    assert area_under(curve, 200) == pytest.approx(50 / 200)


def run(area: float, steps: int | str, final: float) -> dict[str, object]:
    times = {'processor_seconds': 1.0, 'samples_per_processor_second': 2.0}
    found = {'area': area, 'steps_to_0.9': steps, 'final_success': final}
    return {'task': 'FetchReach', 'arm': 'one', **found, **times}


def test_a_censored_run_is_slower_than_any_other() -> None:
    row = sum_up([run(0.1, '', 0.5), run(0.2, 300, 0.9), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached'], row['area_median']) == (300, 2, 0.2)
    row = sum_up([run(0.1, '', 0.5), run(0.2, '', 0.9), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached']) == ('', 1)


def test_arms_are_apart_where_quartiles_do_not_touch() -> None:
    low = sum_up([run(area, '', 0.0) for area in (0.1, 0.2, 0.3)])
    high = sum_up([run(area, '', 0.0) for area in (0.4, 0.5, 0.6)])
    near = sum_up([run(area, '', 0.0) for area in (0.2, 0.3, 0.4)])
    assert are_apart(low, high, 'area') and are_apart(high, low, 'area')
    assert not are_apart(low, near, 'area') and not are_apart(low, high, 'final_success')


@pytest.mark.release
def test_a_study_runs_measures_and_gives_the_same_bits_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / 'report'
    report.mkdir()
    (report / 'README.md').write_text(f'# Before\n{BEGIN}\nold\n{END}\nafter\n')
    arguments = [*SMALL, '--arms', 'future', 'weighted', '--report', str(report)]
    assert main([*arguments, '--output', str(tmp_path / 'first')]) == 0
    assert 'FetchReach/weighted/seed0 is finished; 0 to go' in capsys.readouterr().out
    runs = list(csv.DictReader((report / 'runs.csv').open()))
    assert [row['arm'] for row in runs] == ['future', 'weighted']
    assert {row['env_steps'] for row in runs} == {'800'} and {row['parts'] for row in runs} == {'1'}
    assert all(float(row['processor_seconds']) > 0 for row in runs)
    page = (report / 'README.md').read_text()
    assert page.startswith('# Before') and page.endswith('after\n') and 'old' not in page
    assert (
        '\n| FetchReach | `weighted`: half future, half actual, importance weights | 1 | ' in page
    )
    assert (report / 'figure.png').read_bytes()[:4] == b'\x89PNG'
    about = json.loads((report / 'study.json').read_text())
    assert about['request'] == 2 and len(about['source_revisions']) == 1
    again = tmp_path / 'again'
    assert main([*SMALL, '--arms', 'future', '--report', str(again), '--output', str(again)]) == 0
    actor = Path('FetchReach') / 'future' / 'seed0' / 'latest.safetensors'
    same = [folder.joinpath(actor).read_bytes()[-40_000:] for folder in (tmp_path / 'first', again)]
    assert same[0] == same[1]


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--arms', 'ddpg'], "--arms 'ddpg'; allowed in unbiased: future, "),
        (
            ['--tasks', 'FetchSlide'],
            '--tasks FetchSlide; allowed in unbiased: FetchReach, FetchPush',
        ),
        (['--set', 'goals=near=1'], '--set goals is not possible: jobs differ in it'),
        (['--recipe', 'best'], '--recipe belongs to --study paper'),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(['--study', 'unbiased', *arguments, '--output', str(tmp_path / 'runs')]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1
