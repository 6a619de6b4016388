"""Studies of the requests for research: their jobs, what is measured, and the pages."""

from __future__ import annotations

import dataclasses
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies.files import write_files
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.runs.run_folder import STATE_FILE
from policy_node.training.runs.training_state import Counters, TrainingState, write_state
from policy_node.training.studies.command import jobs_from_arguments, main, parse_arguments
from policy_node.training.studies.final import FINAL_FILE
from policy_node.training.studies.jobs import Job
from policy_node.training.studies.measures import (
    are_apart,
    area_in_time,
    area_under,
    compared,
    rank_sum_chance,
    sum_up,
)
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.research_report import BEGIN, END, format_table, sum_up_arms
from policy_node.training.studies.results import Curve
from policy_node.training.studies.shared_runs import (
    take_from_other_reports,
    take_from_other_studies,
)
from policy_node.training.studies.stored_runs import StoredRuns, own_fields, read_rows
from policy_node.training.studies.studies import PAPER
from policy_node.training.studies.study import Study, research_jobs
from policy_node.training.studies.workers import Outcome, attempt
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
        own = own_fields(study) | {'seed'}
        if 'control_hz' in own:
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


@pytest.mark.parametrize('study', [*STUDIES.values(), PAPER], ids=lambda study: study.name)
def test_a_page_says_what_its_data_say(study: Study) -> None:
    folder = ROOT / 'docs' / 'research' / study.name
    runs, arms = read_rows(folder / 'runs.csv'), read_rows(folder / 'arms.csv')
    curves = read_rows(folder / 'curves.csv')
    assert sum_up_arms(study, runs, curves) == arms
    assert sum(arm['seeds'] for arm in arms) == len(runs)
    assert format_table(study, arms) in (folder / 'README.md').read_text()
    tasks = list(dict.fromkeys(run['task'] for run in runs))
    about = json.loads((folder / 'study.json').read_text())
    assert set(tasks) == set(about['tasks']) <= set(study.tasks)
    evaluated = {(row['task'], row['arm'], row['seed']) for row in curves}
    assert evaluated == {(run['task'], run['arm'], run['seed']) for run in runs}
    assert len(evaluated) == len(runs) and all(run['machine'] and run['revision'] for run in runs)


@pytest.mark.parametrize('study', [*STUDIES.values(), PAPER], ids=lambda study: study.name)
def test_runs_of_today_may_stand_beside_those_of_a_page(study: Study) -> None:
    """Arms are still configured as their runs were: another seed can be added."""
    stored = StoredRuns.read(ROOT / 'docs' / 'research' / study.name)
    for task, told in stored.tasks.items():
        arms = [study.arm(name) for name in told['arms']]
        jobs = research_jobs(study, [task], arms, range(9), {}, Path('runs'))
        stored.require_alike(study, jobs)


def test_the_area_is_the_mean_success_over_the_budget() -> None:
    curve = Curve(np.array([100.0, 200.0, 400.0]), np.array([0.0, 1.0, 1.0]), 10)
    assert area_under(curve, 400) == pytest.approx((0 + 50 + 200) / 400)
    assert area_under(curve, 200) == pytest.approx(50 / 200)


@pytest.mark.parametrize(
    ('seconds', 'area'), [(20.0, 250 / 400), (10.0, 50 / 200), (5.0, 0.0), (40.0, 650 / 800)]
)
def test_the_area_in_time_is_that_of_the_share_of_a_run(seconds: float, area: float) -> None:
    """The run took 20 s: 10 s are its first half, and after 40 s it is still where it ended."""
    curve = Curve(np.array([100.0, 200.0, 400.0]), np.array([0.0, 1.0, 1.0]), 10)
    run = {'processor_seconds': 20.0, 'simulated_seconds': 400 / 25}
    assert area_in_time(curve, run, seconds) == pytest.approx(area)


def test_a_run_in_its_own_time_has_the_area_of_its_budget() -> None:
    """Also one that was evaluated for the last time before its end."""
    curve = Curve(np.array([100.0, 200.0, 300.0]), np.array([0.0, 1.0, 0.5]), 10)
    run = {'processor_seconds': 20.0, 'simulated_seconds': 400 / 25}
    assert area_in_time(curve, run, 20.0) == pytest.approx(area_under(curve, 400))


def run(area: float, steps: int | str, final: float) -> dict[str, object]:
    times = {'processor_seconds': 1.0, 'samples_per_processor_second': 2.0}
    found = {'area': area, 'area_in_time': area, 'steps_to_0.9': steps, 'final_success': final}
    return {'task': 'FetchReach', 'arm': 'one', 'machine': 'A', **found, **times}


def test_a_censored_run_is_slower_than_any_other() -> None:
    row = sum_up([run(0.1, '', 0.5), run(0.2, 300, 0.9), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached'], row['area_median']) == (300, 2, 0.2)
    row = sum_up([run(0.1, '', 0.5), run(0.2, '', 0.9), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached']) == ('', 1)
    row = sum_up([run(0.1, 300, 0.9), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached']) == (200, 2)
    row = sum_up([run(0.1, '', 0.5), run(0.3, 100, 1.0)])
    assert (row['steps_to_0.9_median'], row['reached']) == ('', 1)


def test_arms_are_apart_where_quartiles_do_not_touch_and_chance_would_not_do_it() -> None:
    low, high, near, overlapping = (
        [run(area, '', 0.0) for area in areas]
        for areas in (
            (0.1, 0.2, 0.3, 0.4, 0.5),
            (0.6, 0.7, 0.8, 0.9, 1.0),
            (0.3, 0.4, 0.5, 0.6, 0.7),
            # Quartiles of .6 and more, and one run below all others: 6 of 252 orders on this side.
            (0.05, 0.6, 0.7, 0.8, 0.9),
        )
    )

    def apart(first: list[dict], second: list[dict], name: str = 'area') -> bool:
        return are_apart(sum_up(first) | compared(first, second), sum_up(second), name)

    assert apart(low, high) and apart(high, low) and not apart(low, near)
    assert not apart(low, high, 'final_success')
    row = sum_up(overlapping)
    assert row['area_lower'] > sum_up(low)['area_upper'] and not apart(overlapping, low)
    assert set(compared(low, []).values()) == {''}


def test_the_chance_of_a_rank_sum_is_counted() -> None:
    low, high = [1.0, 2.0, 3.0, 4.0, 5.0], [6.0, 7.0, 8.0, 9.0, 10.0]
    assert rank_sum_chance(low, high) == rank_sum_chance(high, low) == pytest.approx(2 / 252)
    # One exchange less: both orders nearer than complete separation, on both sides.
    assert rank_sum_chance([1.0, 2.0, 3.0, 4.0, 6.0], [5.0, 7.0, 8.0, 9.0, 10.0]) == pytest.approx(
        4 / 252
    )
    assert rank_sum_chance([1.0] * 5, [1.0] * 5) == 1.0
    # Of three and three, with a tie across: 2 of 20 are as far.
    assert rank_sum_chance([1.0, 2.0, 3.0], [3.0, 4.0, 5.0]) == pytest.approx(4 / 20)
    # Of ten and ten, of which nine are above all others: 2 * (1 + 1) of 184,756.
    ten = [*range(1, 11)]
    above = [*range(12, 21), 9.5]
    assert rank_sum_chance(ten, above) == pytest.approx(4 / 184_756)


@pytest.mark.release
def test_a_study_runs_measures_and_gives_the_same_bits_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside what the folder holds of another task."""
    report = tmp_path / 'report'
    report.mkdir()
    stored = StoredRuns.read(ROOT / 'docs' / 'research' / 'unbiased')
    for rows in (stored.runs, stored.curves):
        rows[:] = [row for row in rows if row['task'] == 'FetchPush']
    del stored.tasks['FetchReach']
    kept = list(stored.runs)
    write_files(dataclasses.replace(stored, folder=report).files(STUDIES['unbiased']))
    (report / 'README.md').write_text(f'# Before\n{BEGIN}\nold\n{END}\nafter\n')
    arguments = [*SMALL, '--arms', 'future', 'weighted', '--report', str(report)]
    assert main([*arguments, '--output', str(tmp_path / 'first')]) == 0
    assert 'FetchReach/weighted/seed0 is finished; 0 to go' in capsys.readouterr().out
    runs = read_rows(report / 'runs.csv')
    others = [row for row in runs if row['task'] == 'FetchPush']
    assert others == kept
    runs = [row for row in runs if row['task'] == 'FetchReach']
    assert [row['arm'] for row in runs] == ['future', 'weighted']
    assert {row['env_steps'] for row in runs} == {800} and {row['parts'] for row in runs} == {1}
    assert all(row['processor_seconds'] > 0 for row in runs)
    page = (report / 'README.md').read_text()
    assert page.startswith('# Before') and page.endswith('after\n') and 'old' not in page
    assert (
        '\n| FetchReach | `weighted`: half future, half actual, importance weights | 1 | ' in page
    )
    assert (report / 'figure.png').read_bytes()[:4] == b'\x89PNG'
    about = json.loads((report / 'study.json').read_text())
    assert about['request'] == 2 and set(about['tasks']) == {'FetchReach', 'FetchPush'}
    assert len(about['tasks']['FetchReach']['commands']) == 1
    assert '\n| FetchPush | `future`' in page
    again = tmp_path / 'again'
    assert main([*SMALL, '--arms', 'future', '--report', str(again), '--output', str(again)]) == 0
    actor = Path('FetchReach') / 'future' / 'seed0' / 'latest.safetensors'
    same = [folder.joinpath(actor).read_bytes()[-40_000:] for folder in (tmp_path / 'first', again)]
    assert same[0] == same[1]


def test_a_run_that_was_measured_on_other_episodes_is_measured_again(tmp_path: Path) -> None:
    arguments = ['--study', 'unbiased', '--arms', 'actual', '--seeds', '1', '--episodes', '50']
    (job,) = jobs_from_arguments(parse_arguments([*arguments, '--output', str(tmp_path)]))
    job.folder.mkdir(parents=True)
    counters = Counters(env_steps=job.config.total_steps)
    write_state(job.folder / STATE_FILE, TrainingState({}, counters, {'config': {}}))
    assert job.is_trained and not job.is_finished
    for episodes in (4, 50):
        (job.folder / FINAL_FILE).write_text(json.dumps({'success': 0.5, 'episodes': episodes}))
        assert job.is_finished is (episodes == 50)
    # There is no actor here that could be measured once more.
    assert attempt(job, '') is Outcome.FINISHED


def test_a_run_that_another_study_has_is_taken_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def jobs_of(study: str, arm: str) -> list[Job]:
        arguments = ['--study', study, '--tasks', 'FetchPush', '--arms', arm, '--seeds', '0', '1']
        return jobs_from_arguments(parse_arguments(arguments))

    done, half = jobs_of('targets', 'polyak4')
    for job in (done, half):
        job.folder.mkdir(parents=True)
        counters = Counters(env_steps=job.config.total_steps if job is done else 100)
        config = dataclasses.asdict(job.config)
        write_state(job.folder / STATE_FILE, TrainingState({}, counters, {'config': config}))
        (job.folder / FINAL_FILE).write_text(json.dumps({'success': 0.5, 'episodes': 500}))
    same, other = jobs_of('returns', 'one'), jobs_of('returns', 'none3')
    take_from_other_studies([*same, *other], Path('runs/research'))
    assert [job.is_finished for job in (*same, *other)] == [True, False, False, False]
    assert capsys.readouterr().out.count('\n') == 1
    assert [path.name for path in Path('runs/research/returns/FetchPush/one').iterdir()] == [
        'seed0'
    ]
    # Nor one that began with other networks.
    state = TrainingState({}, Counters(env_steps=done.config.total_steps), {'config': config})
    state.extra['config'] = dataclasses.asdict(done.config) | {'init_from': 'FetchPush'}
    write_state(done.folder / STATE_FILE, state)
    (elsewhere, _) = jobs_of('hierarchy', 'flat')
    take_from_other_studies([elsewhere], Path('runs/research'))
    assert elsewhere.is_finished
    (same[0].folder / STATE_FILE).unlink()
    shutil.rmtree(elsewhere.folder)
    take_from_other_studies([elsewhere], Path('runs/research'))
    assert not elsewhere.folder.exists()
    # What has begun goes on.
    before = (half.folder / STATE_FILE).read_bytes()
    (same[0].folder / FINAL_FILE).unlink()
    take_from_other_studies([half, *same], Path('runs/research'))
    assert (half.folder / STATE_FILE).read_bytes() == before and not same[0].is_finished


def test_a_seed_of_another_day_stands_beside_those_that_are_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What a report holds is not run again, be the run itself gone with its machine."""
    report = tmp_path / 'report'
    arguments = [*SMALL, '--arms', 'actual', '--report', str(report), '--output']
    assert main([*arguments, str(tmp_path / 'gone')]) == 0
    first = read_rows(report / 'runs.csv')
    assert [run['seed'] for run in first] == [0] and first[0]['machine'].endswith(' cores')
    today = tmp_path / 'today'
    capsys.readouterr()
    assert main([*arguments, str(today), '--seeds', '0', '1']) == 0
    assert f'1 of 2 runs are in {report}; with other --report' in capsys.readouterr().out
    assert not list(today.glob('*/*/seed0')) and list(today.glob('*/*/seed1'))
    runs = read_rows(report / 'runs.csv')
    assert runs[0] == first[0] and [run['seed'] for run in runs] == [0, 1]
    assert '| 2 | ' in (report / 'README.md').read_text()
    kept = {path.name: path.read_bytes() for path in report.iterdir()}
    for other in (['--arms', 'actual'], ['--arms', 'random']):
        refused = [*arguments, str(tmp_path / 'other'), *other, '--set', 'batch_size=32']
        assert main(refused) == 2
        error = capsys.readouterr().err
        assert f'{report} holds runs of FetchReach/actual with batch_size 256, now 32: ' in error
        assert error.count('\n') == 1 and not (tmp_path / 'other').exists()
    assert {path.name: path.read_bytes() for path in report.iterdir()} == kept


def stored_runs(folder: Path, jobs: list[Job], machine: str = 'A', seconds: float = 10.0) -> None:
    """Puts a run of each job into a report, as long as its seed makes it."""
    stored = StoredRuns.read(folder)
    for job in jobs:
        run = {
            'env_steps': 400,
            'simulated_seconds': 16.0,
            'area': 0.5,
            'steps_to_0.9': '',
            'final_success': 0.5,
            'final_episodes': job.final_episodes,
            'processor_seconds': seconds + job.config.seed,
            'samples_per_processor_second': 7.0,
            'machine': machine,
            'revision': 'abc',
        }
        curve = [{'env_steps': 200, 'success': '0.5'}, {'env_steps': 400, 'success': '0.5'}]
        stored.put(job, run, [dict(point) for point in curve], 'a command')
    write_files(stored.files(STUDIES['returns']))


def jobs_of(study: str, *more: str, task: str = 'FetchPush') -> list[Job]:
    return jobs_from_arguments(parse_arguments(['--study', study, '--tasks', task, *more]))


def test_time_is_compared_where_the_baseline_ran_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report, study = tmp_path / 'report', STUDIES['returns']
    stored_runs(report, jobs_of('returns', '--arms', 'one'))
    stored_runs(report, jobs_of('returns', '--arms', 'none5', '--seeds', '0', '1'))
    stored_runs(report, jobs_of('returns', '--arms', 'none5', '--seeds', '2', '3', '4'), 'B', 1.0)
    stored_runs(report, jobs_of('returns', '--arms', 'none3', '--seeds', '0'), 'B', 1.0)
    stored = StoredRuns.read(report)
    assert [run['seed'] for run in stored.runs] == [0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    one, none3, none5 = sum_up_arms(study, stored.runs, stored.curves)
    assert (one['timed'], one['processor_seconds_median']) == (5, 12.0)
    assert (none5['seeds'], none5['timed'], none5['processor_seconds_median']) == (5, 2, 10.5)
    assert (none3['timed'], none3['area_in_time_median']) == (0, '')
    lines = format_table(study, [one, none3, none5]).splitlines()
    assert lines[3].endswith('| 0.500 (0.500 ... 0.500) | - | - | - | fewer than five seeds |')
    assert lines[4].count(', of 2 | ') == 3 and lines[4].endswith('| not apart |')


def test_a_run_that_another_report_tells_of_is_taken_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    there, here = Path('docs/targets'), Path('docs/returns')
    stored_runs(there, jobs_of('targets', '--arms', 'polyak4', 'polyak1', '--seeds', '0', '1'))
    jobs = jobs_of('returns', '--arms', 'one', 'none3', '--seeds', '1', '2')
    for _ in range(2):
        take_from_other_reports(STUDIES['returns'], jobs, here)
    assert capsys.readouterr().out == (
        'FetchPush/one/seed1 is FetchPush/polyak4/seed1 of docs/targets\n'
    )
    stored = StoredRuns.read(here)
    assert [stored.holds(job) for job in jobs] == [True, False, False, False]
    (run,) = stored.runs
    assert (run['arm'], run['processor_seconds'], run['revision']) == ('one', 11.0, 'abc')
    assert [row['arm'] for row in stored.curves] == ['one', 'one']
    assert stored.configuration('FetchPush', 'one')['n_step'] == 1
    # Where nothing is taken nothing is written.
    elsewhere = Path('other/returns')
    take_from_other_reports(STUDIES['returns'], jobs, elsewhere)
    assert not list(elsewhere.iterdir())
    # Measured on other episodes it is another run.
    (other,) = jobs_of('returns', '--arms', 'one', '--seeds', '0', '--episodes', '20')
    take_from_other_reports(STUDIES['returns'], [other], here)
    assert not StoredRuns.read(here).holds(other)


def test_a_damaged_report_of_another_study_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    stored_runs(Path('docs/research/targets'), jobs_of('targets', '--arms', 'polyak4'))
    Path('docs/research/targets/study.json').write_text('{')
    assert main(['--study', 'returns', '--tasks', 'FetchPush', '--arms', 'one']) == 2
    error = capsys.readouterr().err
    assert 'docs/research/targets/study.json is no record of a study: ' in error
    assert error.count('\n') == 1


def test_reports_that_renew_a_page_at_once_lose_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report, jobs = tmp_path / 'report', jobs_of('returns', '--arms', 'one')

    def renew(job: Job) -> None:
        with alone_in(report):
            stored_runs(report, [job])

    with ThreadPoolExecutor(len(jobs)) as pool:
        list(pool.map(renew, jobs))
    assert [run['seed'] for run in StoredRuns.read(report).runs] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
        ('curves.csv', None, 'curves.csv has no evaluation of FetchPush/one/seed0'),
        ('study.json', '{"tasks": {}}', 'study.json has no settings of FetchPush/one/seed0'),
        ('study.json', '[]', 'study.json is no record of a study: '),
        ('runs.csv', 'task,arm\nFetchPush,one\n', "runs.csv has no column 'seed'"),
    ],
)
def test_a_damaged_report_is_refused_before_anything_is_trained(
    name: str, text: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report, runs = tmp_path / 'report', tmp_path / 'runs'
    stored_runs(report, jobs_of('returns', '--arms', 'one', '--output', str(runs)))
    (report / name).unlink() if text is None else (report / name).write_text(text)
    arguments = ['--study', 'returns', '--report', str(report), '--output', str(runs)]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1 and not runs.exists()


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
