"""`benchmark`: trains whole studies, as resumable jobs, on one machine or on Ray.

`--study paper`: the paper's comparison, DDPG with and without HER on sparse and dense rewards.
Trains task x arm x seed, each in <output>/<task>/<arm>/seed<k>, then draws success against steps
and prints a table beside the published numbers; or, with `--page`, reports as the studies below.

`--study best`: the best recipe of every task, as many at once as there are cores; some start from
the networks of another. At the end it also evaluates each best actor on fresh episodes and puts it
with its critic, evaluation and curve into <output>/actors.

`--study NAME`, any other: one of the paper's requests for research, or `ingredients`. Trains
task x arm x seed, measures each run on fresh episodes, and adds it to data, figure and table in
docs/research/NAME. What these hold already, from whatever machine, is not run again.

`--study module:NAME`: one of your own, a `Study` of a module that Python finds here.

Finished jobs are skipped and interrupted ones continued, so the same command goes on where it
stopped; given twice at once, it shares the work.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    given_command,
    require_extra,
    run_command,
    whole_number,
)
from policy_node.policies.files import write_file
from policy_node.training.configuration.config_options import with_assignments
from policy_node.training.configuration.config_rules import FROM_NOTHING
from policy_node.training.configuration.config_values import whole
from policy_node.training.studies.actors_table import actors_table
from policy_node.training.studies.jobs import ARMS, Job
from policy_node.training.studies.own_study import find_study
from policy_node.training.studies.reporting import report, require_readable, ship_all
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.shared_runs import (
    take_from_other_reports,
    take_from_other_studies,
)
from policy_node.training.studies.stored_runs import StoredRuns
from policy_node.training.studies.studies import PAPER, best_jobs, paper_jobs, reduced_budget
from policy_node.training.studies.study import FINAL_EPISODES, Study, research_jobs
from policy_node.training.studies.workers import (
    JobsStopped,
    Processes,
    Ray,
    ThisProcess,
    run_jobs,
)

_NAME = 'benchmark'
ACTORS_TABLE = 'actors.md'


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = CommandParser(
        prog=_NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    names = ', '.join(('paper', 'best', *STUDIES))
    help_of_study = f'{names}, module:NAME; default: paper'
    add('--study', type=_study_name, default='paper', metavar='NAME', help=help_of_study)
    default = 'default: FetchReach; all; the first of the study'
    add('--tasks', nargs='+', choices=list(TASKS), metavar='TASK', help=default)
    help_of_seeds = 'default: 0 to 4 (ingredients: 0 1); 0'
    add('--seeds', nargs='+', type=_seed, metavar='SEED', help=help_of_seeds)
    add('--arms', nargs='+', metavar='ARM', help='default: all; not in study best')
    count = whole_number(1)
    add('--jobs', type=count, help='at once; default: 1; one per core')
    add('--steps', type=_whole, help='environment steps of each job')
    add('--threads', type=_whole, help='simulation threads of each job')
    add('--torch-threads', type=_whole, help='tensor threads of each job')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='any field of TrainConfig')
    add('--output', type=Path, help='default: runs/benchmark; runs/best; runs/research/NAME')
    add('--report', type=Path, help='where figure and tables go')
    add('--episodes', type=count, help='fresh episodes at the end; default: none; 2000; 500')
    add('--ray', action='store_true', help='independent jobs on Ray (extra: cluster)')
    paper = parser.add_argument_group('study paper').add_argument
    paper('--recipe', choices=FROM_NOTHING, help='of all jobs; default: paper')
    paper('--full', action='store_true', help="the recipe's own budget, not the reduced one")
    paper('--page', action='store_true', help='renew docs/research/paper')
    best = parser.add_argument_group('study best').add_argument
    best('--actors', type=Path, help='where actors go; default: <output>/actors')
    return parser.parse_args(arguments)


def _study_name(text: str) -> str:
    try:
        find_study(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _whole(text: str) -> int:
    try:
        return whole(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text[:80]!r} is no whole number') from None


def _seed(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        allowed = 'whole numbers with spaces between them: 0 1 2'
        raise argparse.ArgumentTypeError(f'{text[:80]!r} given; allowed: {allowed}') from None


# What options of fields of `TrainConfig` are called.
_OPTIONS = {'total_steps': '--steps', 'simulation_threads': '--threads'}
_OF_STUDY = {'paper': ('recipe', 'full', 'page'), 'best': ('actors',)}


def jobs_from_arguments(options: argparse.Namespace) -> list[Job]:
    """Lists the jobs and checks them against what the folders hold.

    Raises:
        ValueError: If a value is not allowed or does not fit a run that is there.
    """
    for study, names in _OF_STUDY.items():
        for name in names:
            if study != options.study and getattr(options, name) not in (None, False):
                raise ValueError(f'--{name} belongs to --study {study}')
    if options.arms is not None and options.study == 'best':
        raise ValueError('--arms does not belong to --study best')
    if options.episodes is not None and options.study == 'paper' and not options.page:
        raise ValueError('--episodes does not belong to --study paper without --page')
    if options.page and (options.full or options.recipe):
        raise ValueError('--page has settings of its own: leave out --full and --recipe')
    overrides = _overrides(options)
    of_a_page = _study(options)
    if of_a_page is not None:
        jobs = _research(of_a_page, options, overrides)
    else:
        jobs = {'paper': _paper, 'best': _best}[options.study](options, overrides)
    for job in jobs:
        job.check_configuration()
    return jobs


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    chosen = {
        'total_steps': options.steps,
        'simulation_threads': options.threads,
        'torch_threads': options.torch_threads,
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    overrides = with_assignments(given, options.set, _OPTIONS)
    decided: tuple[str, ...] = ('task', 'recipe', 'seed', 'init_from')
    if (study := _study(options)) is not None:
        decided = (*decided, *(name for arm in study.arms for name in arm.own))
    elif options.study == 'paper':
        decided = (*decided, 'reward_type')
    for name in decided:
        if name in overrides:
            raise ValueError(f'--set {name} is not possible: jobs differ in it')
    for name in ('time_limit', 'success_target'):
        if overrides.get(name):
            raise ValueError(f'--set {name} is not possible: a job ends when its steps are done')
    if overrides.get('strategy') == 'none':
        raise ValueError('--set strategy=none is not possible: choose --arms')
    return overrides


def _paper(options: argparse.Namespace, overrides: dict[str, Any]) -> list[Job]:
    recipe, output = options.recipe or 'paper', _output(options)
    seeds = list(dict.fromkeys(options.seeds or range(5)))
    arms = list(dict.fromkeys(options.arms or ARMS))
    for name in arms:
        if name not in ARMS:
            raise ValueError(f'--arms {name!r}; allowed: {", ".join(ARMS)}')
    jobs = []
    for task in dict.fromkeys(options.tasks or ['FetchReach']):
        reduced = {} if options.full or recipe != 'paper' else reduced_budget(task)
        jobs += paper_jobs([task], arms, seeds, recipe, {**reduced, **overrides}, output)
    return jobs


def _best(options: argparse.Namespace, overrides: dict[str, Any]) -> list[Job]:
    # A job collects and learns at the same time, in a thread each.
    threads = {'simulation_threads': 1, 'torch_threads': 1}
    seeds = list(dict.fromkeys(options.seeds or [0]))
    tasks = options.tasks or list(TASKS)
    return best_jobs(tasks, seeds, {**threads, **overrides}, _output(options))


def _research(study: Study, options: argparse.Namespace, overrides: dict[str, Any]) -> list[Job]:
    seeds = list(dict.fromkeys(options.seeds or range(study.seeds)))
    tasks = list(dict.fromkeys(options.tasks or study.tasks[:1]))
    names = dict.fromkeys(options.arms or [arm.name for arm in study.arms])
    arms = [study.arm(name) for name in names]
    episodes = options.episodes or FINAL_EPISODES
    return research_jobs(study, tasks, arms, seeds, overrides, _output(options), episodes)


def _study(options: argparse.Namespace) -> Study | None:
    """The study whose page is renewed; None renews none."""
    return PAPER if options.page else find_study(options.study)


def _output(options: argparse.Namespace) -> Path:
    folders = {'paper': Path('benchmark'), 'best': Path('best')}
    study = _study(options)
    folder = Path('research') / study.name if study else folders[options.study]
    return Path(options.output or Path('runs') / folder)


def _report_folder(options: argparse.Namespace) -> Path:
    study = _study(options)
    page = Path('docs') / 'research' / study.name if study else _output(options)
    return Path(options.report or page)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    command = given_command(_NAME, arguments)
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    if options.ray:
        require_extra('cluster')
    study = _study(options)
    with _refusing():
        jobs = jobs_from_arguments(options)
        if study is not None:
            StoredRuns.read(_report_folder(options)).require_alike(study, jobs)
    _make_folder(_output(options), 'runs')
    _make_folder(_report_folder(options), 'a report')
    with _refusing():
        if study is not None:
            jobs = _not_stored(study, jobs, options)
        finished = [job for job in jobs if job.is_finished]
    require_readable(finished)
    try:
        whole = _run_where_asked(options, jobs, command)
    except JobsStopped as stopped:
        return stopped.exit_code
    finally:
        finished = _report(options, jobs, command)
    # Not where jobs were stopped: that would be thousands of episodes before the command ends.
    shipped = options.study != 'best' or _ship(options, finished)
    return EXIT_SUCCESS if whole and shipped else EXIT_FAILURE


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """What does not fit is said in one line."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from None


def _not_stored(study: Study, jobs: Sequence[Job], options: argparse.Namespace) -> list[Job]:
    """The jobs whose runs neither the report nor that of another study holds."""
    folder = _report_folder(options)
    # Who names a folder wants runs of their own.
    if options.output is None:
        take_from_other_studies(jobs, _output(options).parent)
        if options.report is None:
            take_from_other_reports(study, jobs, folder)
    stored = StoredRuns.read(folder)
    missing = [job for job in jobs if not stored.holds(job)]
    if len(missing) < len(jobs):
        count = f'{len(jobs) - len(missing)} of {len(jobs)}'
        print(f'{count} runs are in {folder}; with other --report and --output they are run again')
    return missing


def _make_folder(folder: Path, content: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f'{folder} cannot hold {content}: {error.strerror}') from None


def _run_where_asked(options: argparse.Namespace, jobs: Sequence[Job], command: str) -> bool:
    # Pages of a study after every run: a machine that is lost then loses one run at most.
    renew = partial(_report_finished, options, jobs, command) if _study(options) else None
    if options.ray:
        return run_jobs(jobs, Ray(command), renew)
    cores = len(os.sched_getaffinity(0))
    limit = options.jobs or (cores if options.study == 'best' else 1)
    if limit == 1:
        return run_jobs(jobs, ThisProcess(command), renew)
    with Processes(limit, command) as processes:
        return run_jobs(jobs, processes, renew)


def _report_finished(options: argparse.Namespace, jobs: Sequence[Job], command: str) -> list[Job]:
    """Reports on the jobs that are finished, and returns them."""
    finished = [job for job in jobs if job.is_finished]
    report(finished, _study(options), _report_folder(options), command)
    return finished


def _report(options: argparse.Namespace, jobs: Sequence[Job], command: str) -> list[Job]:
    """Draws and prints what is finished, which it returns, and says how much is not."""
    finished = _report_finished(options, jobs, command)
    if len(finished) < len(jobs):
        print(f'{len(finished)} of {len(jobs)} jobs are finished; the same command goes on')
    return finished


def _ship(options: argparse.Namespace, finished: Sequence[Job]) -> bool:
    """Evaluates and ships the best actors of finished jobs; whether nothing failed."""
    actors = options.actors or _output(options) / 'actors'
    whole = ship_all(finished, actors, options.episodes or 2000)
    if whole and actors.is_dir():
        table = _report_folder(options) / ACTORS_TABLE
        try:
            write_file(table, f'{actors_table(actors)}\n'.encode())
        except (OSError, ValueError) as error:
            raise CommandError(f'no {table}: {error}') from None
    return whole
