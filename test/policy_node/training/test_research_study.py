"""Studies of the requests for research: their jobs, what is measured, and the pages."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from policy_node.policies.files import write_file
from policy_node.training.configuration.flat import to_flat
from policy_node.training.runs.run_folder import STATE_FILE
from policy_node.training.studies.command import (
    _not_stored,
    jobs_from_arguments,
    main,
    parse_arguments,
)
from policy_node.training.studies.measures import (
    Curve,
    area_in_time,
    area_under,
    compared,
    is_significant,
    rank_sum_chance,
    sum_up,
)
from policy_node.training.studies.report import (
    BEGIN,
    END,
    arms_csv,
    format_study,
    sum_up_arms,
    write_study,
)
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.store import (
    add_run,
    in_order,
    own_fields,
    read_runs,
    require_alike,
)
from policy_node.training.studies.study import Arm, Job, Start, Study, to_settings
from support import ROOT
from support.full_disk import files_at_most
from support.runs import one_line, options_of

SMALL = ['--study', 'unbiased', '--seeds', '0', '--steps', '800', '--episodes', '4']
SMALL += ['--set', 'num_envs=4', '--set', 'updates_per_cycle=2', '--set', 'evaluation_episodes=4']


@pytest.mark.parametrize('study', STUDIES.values(), ids=list(STUDIES))
def test_variants_of_a_study_share_all_other_settings(study: Study, tmp_path: Path) -> None:
    for task in study.tasks:
        options = ['--study', study.name, '--tasks', task, '--output', str(tmp_path)]
        jobs = jobs_from_arguments(parse_arguments(options))
        assert len(jobs) == study.seeds * len(study.arms)
        own = own_fields(study) | {'seed'}
        if 'control_hz' in own:
            seconds = {job.config.total_steps / job.config.control_hz for job in jobs}
            assert len(seconds) == 1, 'budgets are the same in simulated time'
        settings = [to_flat(job.config) for job in jobs]
        for name in settings[0].keys() - own:
            assert all(each[name] == settings[0][name] for each in settings), name
        assert len({str(each) for each in settings}) == len({job.folder for job in jobs})
        machine = jobs[0].config
        assert machine.simulation_threads == machine.torch_threads == 1 and not machine.overlap


def test_every_study_has_its_page_and_every_request_its_line() -> None:
    index = (ROOT / 'docs' / 'research' / 'README.md').read_text()
    for study in STUDIES.values():
        assert f'({study.name}/README.md)' in index
        assert study.request is None or f'| {study.request} [' in index
        page = (ROOT / 'docs' / 'research' / study.name / 'README.md').read_text()
        assert f'benchmark --study {study.name}' in page and BEGIN in page and END in page
    assert {study.request for study in STUDIES.values()} == {None, *range(1, 10)}


@pytest.mark.parametrize('study', STUDIES.values(), ids=list(STUDIES))
def test_tables_of_a_page_are_derived_from_its_runs(study: Study) -> None:
    folder = ROOT / 'docs' / 'research' / study.name
    runs = in_order(read_runs(folder).values(), study)
    arms = sum_up_arms(study, runs)
    assert arms_csv(arms) == (folder / 'arms.csv').read_bytes()
    assert format_study(study, arms) in (folder / 'README.md').read_text()
    assert sum(arm['seeds'] for arm in arms) == len(runs)
    assert len(runs) == (folder / 'runs.jsonl').read_text().count('\n')
    assert {run['task'] for run in runs} <= set(study.tasks)
    assert all(run['machine'] and run['revision'] and run['curve'] for run in runs)


@pytest.mark.parametrize('study', STUDIES.values(), ids=list(STUDIES))
def test_another_seed_can_be_added_to_every_page(study: Study) -> None:
    """The variants are configured today as their stored runs were."""
    folder = ROOT / 'docs' / 'research' / study.name
    names = {(run['task'], run['arm']) for run in read_runs(folder).values()}
    for task, arm in names:
        jobs = study.jobs([task], [study.arm(arm)], range(9), {}, Path('runs'))
        require_alike(study, jobs, folder)


def test_the_area_is_the_mean_success_over_the_budget() -> None:
    curve = Curve(np.array([100.0, 200.0, 400.0]), np.array([0.0, 1.0, 1.0]))
    assert area_under(curve, 400) == pytest.approx((0 + 50 + 200) / 400)
    assert area_under(curve, 200) == pytest.approx(50 / 200)


@pytest.mark.parametrize(
    ('seconds', 'area'), [(20.0, 250 / 400), (10.0, 50 / 200), (5.0, 0.0), (40.0, 650 / 800)]
)
def test_the_area_in_time_covers_the_share_of_the_run(seconds: float, area: float) -> None:
    """The run took 20 s: 10 s are its first half, and after 40 s it has its last success."""
    curve = [[100, 0.0], [200, 1.0], [400, 1.0]]
    run = {'processor_seconds': 20.0, 'simulated_seconds': 400 / 25, 'curve': curve}
    assert area_in_time(run, seconds) == pytest.approx(area)
    last = {**run, 'curve': [[100, 0.0], [200, 1.0], [300, 0.5]]}
    assert area_in_time(last, 20.0) == pytest.approx(area_under(Curve.of(last), 400))


def run(area: float, steps: int | None, final: float) -> dict[str, object]:
    times = {'processor_seconds': 1.0, 'samples_per_processor_second': 2.0}
    found = {'area': area, 'area_in_time': area, 'steps_to_0.9': steps, 'final_success': final}
    return {'task': 'FetchReach', 'arm': 'one', 'machine': 'A', **found, **times}


def test_a_censored_run_is_slower_than_any_other() -> None:
    row = sum_up([run(0.1, None, 0.5), run(0.2, 300, 0.9), run(0.3, 100, 1.0)])
    assert row['area_median'] == 0.2
    for steps, median, reached in (
        ((None, 300, 100), 300, 2),
        ((None, None, 100), '', 1),
        ((300, 100), 200, 2),
        ((None, 100), '', 1),
    ):
        row = sum_up([run(0.1, each, 0.9) for each in steps])
        assert (row['steps_to_0.9_median'], row['reached']) == (median, reached)


def test_significance_needs_disjoint_quartiles_and_a_small_p() -> None:
    low, high, near, overlapping = (
        [run(area, None, 0.0) for area in areas]
        for areas in (
            (0.1, 0.2, 0.3, 0.4, 0.5),
            (0.6, 0.7, 0.8, 0.9, 1.0),
            (0.3, 0.4, 0.5, 0.6, 0.7),
            # Quartiles of .6 and more, and one run below all others: 6 of 252 orders on this side.
            (0.05, 0.6, 0.7, 0.8, 0.9),
        )
    )

    def apart(first: list[dict], second: list[dict], name: str = 'area') -> bool:
        return is_significant(sum_up(first) | compared(first, second), sum_up(second), name)

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
    # Ten values against ten; nine of the second ten exceed all others: 2 * (1 + 1) of 184,756.
    ten = [*range(1, 11)]
    above = [*range(12, 21), 9.5]
    assert rank_sum_chance(ten, above) == pytest.approx(4 / 184_756)


@pytest.mark.release
def test_a_study_is_run_measured_extended_and_measured_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside stored runs of another task."""
    report, first, today = (tmp_path / name for name in ('report', 'first', 'today'))
    report.mkdir()
    stored = read_runs(ROOT / 'docs' / 'research' / 'unbiased')
    kept = [run for run in stored.values() if run['task'] == 'FetchPush']
    for run in kept:
        add_run(report, run)
    (report / 'README.md').write_text(f'# Before\n{BEGIN}\nold\n{END}\nafter\n')
    arguments = [*SMALL, '--arms', 'future', 'weighted', '--report', str(report), '--output']
    assert main([*arguments, str(first)]) == 0
    assert 'FetchReach/weighted/seed0 is finished; 0 to go' in capsys.readouterr().out
    runs = list(read_runs(report).values())
    assert runs[:-2] == kept
    for arm, run in zip(('future', 'weighted'), runs[-2:], strict=True):
        assert (run['arm'], run['seed'], run['env_steps'], run['parts']) == (arm, 0, 800, 1)
        assert run['curve'][-1][0] == 800 and run['machine'].endswith(' cores')
        assert 0.0 <= run['final_success'] <= 1.0 and run['final_episodes'] == 4
        assert run['processor_seconds'] > 0 and run['command'].startswith(
            'fetch_hand_sim benchmark --study unb'
        )
    page = (report / 'README.md').read_text()
    assert page.startswith('# Before') and page.endswith('after\n') and 'old' not in page
    assert '\n| FetchReach | `weighted`: half future, half actual, importance weights | 1' in page
    assert '\n| FetchPush | `future`' in page
    assert (report / 'figure.png').read_bytes()[:4] == b'\x89PNG'

    # Another seed is added, also if the run folder was on another machine.
    assert main([*arguments, str(today), '--arms', 'future', '--seeds', '0', '1']) == 0
    assert f'1 of 2 runs are in {report}; other --report' in capsys.readouterr().out
    assert not list(today.glob('*/*/seed0')) and list(today.glob('*/*/seed1'))
    *before, added = read_runs(report).values()
    assert before == runs and (added['arm'], added['seed']) == ('future', 1)
    files = {path.name: path.read_bytes() for path in report.iterdir()}
    for arm in ('future', 'random'):
        other = [*arguments, str(tmp_path / 'other'), '--arms', arm, '--set', 'batch_size=32']
        assert main(other) == 2
        assert '/future with batch_size 256, now 32' in one_line(capsys)
        assert not (tmp_path / 'other').exists()
    assert {path.name: path.read_bytes() for path in report.iterdir()} == files

    # Runs without stored measures are measured again without training, unless they are damaged.
    folder, jsonl = first / 'FetchReach' / 'future' / 'seed0', report / 'runs.jsonl'
    log = (folder / 'progress.csv').read_bytes()
    jsonl.unlink()
    assert main([*arguments, str(first)]) == 0
    assert list(read_runs(report).values()) == runs[-2:]
    assert (folder / 'progress.csv').read_bytes() == log
    jsonl.unlink()
    capsys.readouterr()
    for name, content, status, line in (
        ('latest.safetensors', b'cut', 1, 'fetch_hand_sim benchmark: FetchReach/future/seed0: '),
        ('progress.csv', b'env_steps\n400\n', 1, 'progress.csv contains no evaluation'),
        (STATE_FILE, b'cut', 2, f'Remove {folder} to train it again'),
    ):
        write_file(folder / name, content)
        assert main([*arguments, str(first), '--arms', 'future']) == status
        assert line in one_line(capsys)


def store(folder: Path, jobs: list[Job], machine: str = 'A', seconds: float = 10.0) -> None:
    """Store a run of each job; its CPU time depends on its seed."""
    for job in jobs:
        task, arm, seed = job.key
        run = {
            'task': task,
            'arm': arm,
            'seed': seed,
            'env_steps': 400,
            'simulated_seconds': 16.0,
            'area': 0.5,
            'steps_to_0.9': None,
            'final_success': 0.5,
            'final_episodes': job.final_episodes,
            'processor_seconds': seconds + seed,
            'samples_per_processor_second': 7.0,
            'machine': machine,
            'revision': 'abc',
            'curve': [[200, 0.5], [400, 0.5]],
            'command': 'a command',
            'config': to_settings(job.config),
        }
        add_run(folder, run)


def jobs_of(study: str, *more: str, task: str = 'FetchPush') -> list[Job]:
    return jobs_from_arguments(parse_arguments(['--study', study, '--tasks', task, *more]))


def test_time_is_compared_on_machines_of_the_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report, study = tmp_path / 'report', STUDIES['returns']
    # Of two lines about a run, the later one counts.
    store(report, jobs_of('returns', '--arms', 'one', '--seeds', '0'), 'B')
    store(report, jobs_of('returns', '--arms', 'one'))
    store(report, jobs_of('returns', '--arms', 'none5', '--seeds', '0', '1'))
    store(report, jobs_of('returns', '--arms', 'none5', '--seeds', '2', '3', '4'), 'B', 1.0)
    store(report, jobs_of('returns', '--arms', 'none3', '--seeds', '0'), 'B', 1.0)
    runs = in_order(read_runs(report).values(), study)
    assert [run['seed'] for run in runs] == [0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    one, none3, none5 = sum_up_arms(study, runs)
    assert (one['timed'], one['processor_seconds_median']) == (5, 12.0)
    assert (none5['seeds'], none5['timed'], none5['processor_seconds_median']) == (5, 2, 10.5)
    assert (none3['timed'], none3['area_in_time_median']) == (0, '')
    write_study(study, report)
    assert '| 5 | 0.500' in (report / 'README.md').read_text()
    lines = format_study(study, [one, none3, none5]).splitlines()
    assert lines[3].endswith('| 0.500 (0.500 ... 0.500) | - | - | - | fewer than five seeds |')
    assert lines[4].count(', of 2 | ') == 3 and lines[4].endswith('| no significant difference |')


@pytest.mark.parametrize('line', ['{"task": "Fetch', '[]', '{"task": "FetchPush"}'])
def test_a_damaged_line_is_named_before_anything_is_trained(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report, runs = tmp_path / 'report', tmp_path / 'runs'
    store(report, jobs_of('returns', '--arms', 'one', '--output', str(runs)))
    with (report / 'runs.jsonl').open('a') as file:
        file.write(line + '\n')
    assert main(['--study', 'returns', '--report', str(report), '--output', str(runs)]) == 2
    assert 'runs.jsonl, line 6, is no run' in one_line(capsys)
    assert not runs.exists()


def test_a_run_is_added_below_a_last_line_without_a_newline(tmp_path: Path) -> None:
    """As an editor leaves it, for example after a damaged line was removed."""
    jobs, file = jobs_of('returns', '--arms', 'one', '--seeds', '0', '1'), tmp_path / 'runs.jsonl'
    store(tmp_path, jobs[:1])
    file.write_text(file.read_text().rstrip('\n'))
    store(tmp_path, jobs[1:])
    assert [seed for *_, seed in read_runs(tmp_path)] == [0, 1]


def test_processes_that_store_runs_at_once_lose_nothing(tmp_path: Path) -> None:
    jobs = jobs_of('returns', '--arms', 'one')
    with ThreadPoolExecutor(len(jobs)) as pool:
        list(pool.map(lambda job: store(tmp_path, [job]), jobs))
    assert sorted(seed for *_, seed in read_runs(tmp_path)) == [0, 1, 2, 3, 4]


def test_a_full_disk_leaves_stored_runs_and_page_as_they_were(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = jobs_of('returns', '--arms', 'one', '--seeds', '0', '1')
    store(tmp_path, jobs[:1])
    page = tmp_path / 'README.md'
    page.write_text(f'{BEGIN}\n{END}\n{"words " * 2_000}')
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    largest = len(before['runs.jsonl']) + 100
    with files_at_most(largest), pytest.raises(OSError, match='large'):
        store(tmp_path, jobs[1:])
    with files_at_most(largest), pytest.raises(OSError, match='large'):
        write_study(STUDIES['returns'], tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_study_whose_runs_start_from_one_another_can_be_continued(tmp_path: Path) -> None:
    study = Study(
        'chained',
        None,
        'Do first stages help?',
        {'FetchPickAndPlace': {}, 'FetchPush': {}},
        (Arm('long', 'one stage'), Arm('staged', 'two stages', after='long')),
        starts={'FetchPickAndPlace': Start('FetchPush', {'noise_std': 0.1})},
    )

    def jobs_of_tasks(*tasks: str, seeds: tuple[int, ...] = (0,)) -> list[Job]:
        return study.jobs(tasks, study.arms, seeds, {}, tmp_path / 'runs')

    jobs = jobs_of_tasks(*study.tasks)
    push, pick, staged_pick, staged_push = jobs
    assert push.config.init_from == '' and pick.after is push
    assert staged_pick.after is pick and staged_push.after is push
    store(tmp_path, jobs)
    require_alike(study, jobs_of_tasks(*study.tasks, seeds=(0, 1)), tmp_path)
    with pytest.raises(ValueError, match=r"init_from '.*FetchPush.*', now 'FetchPush'"):
        require_alike(study, jobs_of_tasks('FetchPickAndPlace'), tmp_path)


def test_first_stages_of_another_machine_are_trained_again(tmp_path: Path) -> None:
    stages = (Arm('a', 'one'), Arm('b', 'two', after='a'), Arm('c', 'three', after='b'))
    study = Study('stages', None, 'How many stages?', {'FetchReach': {}}, stages)
    jobs = study.jobs(study.tasks, stages, (0, 1), {}, tmp_path / 'runs')
    store(tmp_path, [job for job in jobs if job.key != ('FetchReach', 'c', 1)])
    assert [job.key[1:] for job in _not_stored(jobs, tmp_path)] == [('a', 1), ('b', 1), ('c', 1)]


@pytest.mark.parametrize(
    ('arm', 'message'),
    [
        (
            Arm('a', 'imitation', {'recipe': 'robust'}),
            'FetchReach/a has algorithm imitation; studies',
        ),
        (Arm('a', 'short', {'time_limit': 1.0}), 'FetchReach/a has time_limit; jobs end when'),
        (Arm('a', 'circular', after='a'), 'FetchReach/a starts from its own networks'),
        (
            Arm('a', 'misspelt', factors={'gama': 2}),
            "'gama' is no field of TrainConfig; did you mean 'gamma'",
        ),
    ],
)
def test_a_study_that_cannot_finish_is_refused_before_it_trains(
    tmp_path: Path, arm: Arm, message: str
) -> None:
    study = Study('odd', None, '?', {'FetchReach': {}}, (arm,))
    with pytest.raises(ValueError, match=message):
        study.jobs(study.tasks, study.arms, (0,), {}, tmp_path)


PAGE = ROOT / 'docs' / 'research' / 'studies.md'
FEW = ['--seeds', '0', '--steps', '800', '--episodes', '2']
FEW += options_of(num_envs=8, evaluation_episodes=4, evaluate_every=400)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Its name; the working directory has it."""
    (example,) = re.findall(r'```python\n(.*?)```', PAGE.read_text(), re.DOTALL)
    name = f'studies_of_{tmp_path.name}'.replace('-', '_')
    (tmp_path / f'{name}.py').write_text(
        f'{example}\nFAILS = 3\n'
        "TWICE = Study('twice', None, '?', WIDTHS.settings, (Arm('a', 'a'),) * 2)\n"
        + example.replace('WIDTHS', 'TAKEN').replace("'widths'", "'values'")
    )
    monkeypatch.chdir(tmp_path)
    return name


@pytest.mark.release
def test_the_study_of_the_page_runs(module: str, tmp_path: Path) -> None:
    assert main(['--study', f'{module}:WIDTHS', *FEW]) == 0
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
        ('{}:TWICE', "has arms ['a', 'a']; allowed: different words"),
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
    assert ended.value.code == 2 and line in one_line(capsys)
