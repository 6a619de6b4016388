"""`fetch_hand_sim benchmark`: train whole studies as resumable jobs, on one machine or on Ray.

`--study paper`: the paper's comparison, DDPG with and without HER on sparse and dense rewards.
Trains task x variant x seed, each in <output>/<task>/<variant>/seed<k>, draws success against steps
and prints a table beside published numbers. With `--page`, reports like the studies below.

`--study best`: the best recipe of every task, one job per core. Some tasks start from the networks
of another. Finally evaluates each best actor on fresh episodes and copies it with its critic,
evaluation and curve into <output>/actors.

`--study NAME`, any other: one of the paper's requests for research, or `ingredients`. Trains
task x variant x seed, measures each run on fresh episodes, and adds it to data, figure and table in
docs/research/NAME. Runs that the folder contains are not trained again.

`--study module:NAME`: a `Study` of your own in a Python module of the working directory.

The same command skips finished jobs and continues interrupted ones. Two terminals with the same
command share the work.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from msgs_spec.text import did_you_mean, one_line
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    given_command,
    require_extra,
    run_command,
    whole_number,
)
from policy_node.policies.files import write_file
from policy_node.policies.loading import is_python_name, working_directory_first
from policy_node.training.configuration.flat import whole, with_assignments
from policy_node.training.configuration.recipes import FROM_NOTHING
from policy_node.training.runs.run_folder import BEST_FILE
from policy_node.training.runs.shipping import ship
from policy_node.training.studies.paper import ARMS, PAPER, best_jobs, reduced_budget
from policy_node.training.studies.published import actors_table
from policy_node.training.studies.report import write_comparison, write_study
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.store import (
    holds,
    read_runs,
    require_alike,
    take_from_other_studies,
)
from policy_node.training.studies.study import (
    FINAL_EPISODES,
    Job,
    Study,
    make_jobs,
    research_jobs,
)
from policy_node.training.studies.workers import (
    JobsStopped,
    Processes,
    Ray,
    ThisProcess,
    is_finished,
    run_jobs,
)

_NAME = 'fetch_hand_sim benchmark'
ACTORS_TABLE = 'actors.md'
# Studies without a page in docs/research.
_OTHERS = ('paper', 'best')
# Options of `TrainConfig` fields with another name.
_OPTIONS = {'total_steps': '--steps', 'simulation_threads': '--threads'}
_OF_STUDY = {'paper': ('recipe', 'full', 'page'), 'best': ('actors',)}


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(
        prog=_NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    names = ', '.join((*_OTHERS, *STUDIES))
    help_of_study = f'{names}, module:NAME; default: paper'
    add('--study', type=_study_name, default='paper', metavar='NAME', help=help_of_study)
    default = 'default: FetchReach; all; the first of the study'
    add('--tasks', nargs='+', choices=list(TASKS), metavar='TASK', help=default)
    help_of_seeds = 'default: 0 to 4 (ingredients: 0 1); 0'
    add('--seeds', nargs='+', type=_seed, metavar='SEED', help=help_of_seeds)
    add('--arms', nargs='+', metavar='ARM', help='variants; default: all; not in study best')
    count = whole_number(1)
    add('--jobs', type=count, help='runs trained in parallel; default: 1; one per core')
    add('--steps', type=_whole, help='environment steps of each job')
    add('--threads', type=_whole, help='simulation threads of each job')
    add('--torch-threads', type=_whole, help='tensor threads of each job')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='any field of TrainConfig')
    add('--output', type=Path, help='default: runs/benchmark; runs/best; runs/research/NAME')
    add('--report', type=Path, help='folder of figure and tables')
    add('--episodes', type=count, help='fresh episodes at the end; default: none; 2000; 500')
    add('--ray', action='store_true', help='independent jobs on Ray (extra: cluster)')
    paper = parser.add_argument_group('study paper').add_argument
    paper('--recipe', choices=FROM_NOTHING, help='recipe of all jobs; default: paper')
    paper('--full', action='store_true', help="the recipe's own budget, not the reduced one")
    paper('--page', action='store_true', help='renew docs/research/paper')
    best = parser.add_argument_group('study best').add_argument
    best('--actors', type=Path, help='folder of actors; default: <output>/actors')
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
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f'{text[:80]!r} is no whole number') from None


def _seed(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        allowed = 'whole numbers with spaces between them: 0 1 2'
        raise argparse.ArgumentTypeError(f'{text[:80]!r} given; allowed: {allowed}') from None


def find_study(name: str) -> Study | None:
    """Return a study of `STUDIES` or of a module; None for `paper` and `best`.

    Raises:
        ValueError: If the name is unknown, or the module fails.
    """
    if not is_python_name(name):
        if name not in (*_OTHERS, *STUDIES):
            allowed = ', '.join((*_OTHERS, *STUDIES))
            hint = did_you_mean(name, (*_OTHERS, *STUDIES))
            raise ValueError(f'{name[:80]!r} given; allowed: {allowed}, module:NAME{hint}')
        return STUDIES.get(name)
    module, _, attribute = name.partition(':')
    try:
        with working_directory_first():
            study = getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        raise ValueError(f'{name}: {type(error).__name__}: {one_line(error)}') from None
    if not isinstance(study, Study):
        raise ValueError(f'{name} is a {type(study).__name__}; allowed: a Study')
    if study.name in (*_OTHERS, *STUDIES) or not study.name.isidentifier():
        raise ValueError(f'{name} is called {study.name!r}; allowed: a word that no other study is')
    if not study.settings or not study.arms:
        raise ValueError(f'{name} has no settings of a task, or no arms')
    return study


def jobs_from_arguments(options: argparse.Namespace) -> list[Job]:
    """Return the jobs, checked against the run folders.

    Raises:
        ValueError: If a value is not allowed or differs from an existing run.
    """
    for owner, names in _OF_STUDY.items():
        for name in names:
            if owner != options.study and getattr(options, name) not in (None, False):
                raise ValueError(f'--{name} belongs to --study {owner}')
    if options.arms is not None and options.study == 'best':
        raise ValueError('--arms does not belong to --study best')
    if options.episodes is not None and options.study == 'paper' and not options.page:
        raise ValueError('--episodes does not belong to --study paper without --page')
    if options.page and (options.full or options.recipe):
        raise ValueError('--page has settings of its own: leave out --full and --recipe')
    overrides, study, output = _overrides(options), _study(options), _output(options)
    seeds = list(dict.fromkeys(options.seeds or ())) or None
    if study is not None:
        tasks = list(dict.fromkeys(options.tasks or study.tasks[:1]))
        arms = [study.arm(name) for name in dict.fromkeys(options.arms or ())] or study.arms
        episodes = options.episodes or FINAL_EPISODES
        seeds = seeds or list(range(study.seeds))
        jobs = research_jobs(study, tasks, arms, seeds, overrides, output, episodes)
    elif options.study == 'paper':
        jobs = _paper_jobs(options, seeds or list(range(5)), overrides, output)
    else:
        # A job collects and learns at the same time, in a thread each.
        threads = {'simulation_threads': 1, 'torch_threads': 1}
        tasks = options.tasks or list(TASKS)
        jobs = best_jobs(tasks, seeds or [0], {**threads, **overrides}, output)
    for job in jobs:
        job.check_configuration()
    return jobs


def _paper_jobs(
    options: argparse.Namespace, seeds: Sequence[int], overrides: dict[str, Any], output: Path
) -> list[Job]:
    recipe = options.recipe or 'paper'
    arms = [PAPER.arm(name) for name in dict.fromkeys(options.arms or ARMS)]
    jobs = []
    for task in dict.fromkeys(options.tasks or ['FetchReach']):
        reduced = {} if options.full or recipe != 'paper' else reduced_budget(task)
        jobs += make_jobs(task, arms, seeds, {'recipe': recipe, **reduced, **overrides}, output)
    return jobs


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of `TrainConfig` that the options set for all jobs."""
    chosen = {
        'total_steps': options.steps,
        'simulation_threads': options.threads,
        'torch_threads': options.torch_threads,
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    overrides = with_assignments(given, options.set, _OPTIONS)
    decided = {'task', 'recipe', 'seed', 'init_from'}
    if (study := _study(options)) is not None:
        decided.update(*(arm.own for arm in study.arms))
    elif options.study == 'paper':
        decided.add('reward_type')
    for name in overrides:
        if name in decided:
            raise ValueError(f'--set {name} is not possible: jobs differ in it')
    for name in ('time_limit', 'success_target'):
        if overrides.get(name):
            raise ValueError(f'--set {name} is not possible: a job ends when its steps are done')
    if overrides.get('strategy') == 'none':
        raise ValueError('--set strategy=none is not possible: choose --arms')
    return overrides


def _study(options: argparse.Namespace) -> Study | None:
    """Return the study whose page is renewed, or None."""
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
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    command = given_command(_NAME, arguments)
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    if options.ray:
        require_extra('cluster')
    study, report = _study(options), _report_folder(options)
    with _usage_errors():
        jobs = jobs_from_arguments(options)
        if study is not None:
            require_alike(study, jobs, report)
    _make_folder(_output(options), 'runs')
    _make_folder(report, 'a report')
    if study is not None:
        with _usage_errors():
            jobs = _not_stored(jobs, options)
    renew = partial(_write_report, study, jobs, report)
    try:
        whole = _run_where_asked(options, jobs, command, renew if study else None)
    except JobsStopped as stopped:
        return stopped.exit_code
    finally:
        renew()
        finished = [job for job in jobs if is_finished(job, report)]
        if len(finished) < len(jobs):
            count = f'{len(finished)} of {len(jobs)} jobs are finished'
            print(f'{count}; the same command continues the others')
    # Not after a stop: that would be thousands of episodes before the command ends.
    shipped = options.study != 'best' or _ship_all(options, finished)
    return EXIT_SUCCESS if whole and shipped else EXIT_FAILURE


@contextlib.contextmanager
def _usage_errors() -> Iterator[None]:
    """Report invalid values in one line."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from None


def _make_folder(folder: Path, content: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f'{folder} cannot hold {content}: {error.strerror}') from None


def _not_stored(jobs: Sequence[Job], options: argparse.Namespace) -> list[Job]:
    """Return the jobs whose runs neither the report nor the report of another study contains."""
    folder = _report_folder(options)
    # --output and --report ask for new runs.
    if options.output is None and options.report is None:
        take_from_other_studies(jobs, folder)
    runs = read_runs(folder)
    missing = [job for job in jobs if not holds(runs, job)]
    if len(missing) < len(jobs):
        count = f'{len(jobs) - len(missing)} of {len(jobs)}'
        print(f'{count} runs are in {folder}; other --report and --output train them again')
    return missing


def _run_where_asked(
    options: argparse.Namespace, jobs: Sequence[Job], command: str, renew: partial[None] | None
) -> bool:
    report = _report_folder(options)
    if options.ray:
        return run_jobs(jobs, Ray(report, command), report, renew)
    cores = len(os.sched_getaffinity(0))
    limit = options.jobs or (cores if options.study == 'best' else 1)
    if limit == 1:
        return run_jobs(jobs, ThisProcess(report, command), report, renew)
    with Processes(limit, report, command) as processes:
        return run_jobs(jobs, processes, report, renew)


def _write_report(study: Study | None, jobs: Sequence[Job], report: Path) -> None:
    """Write the tables and the figure of the stored runs."""
    try:
        if study is None:
            write_comparison(jobs, report)
        else:
            write_study(study, report)
    except (OSError, ValueError) as error:
        raise CommandError(f'no report in {report}: {error}') from None


def _ship_all(options: argparse.Namespace, jobs: Sequence[Job]) -> bool:
    """Evaluate the best actors and copy the better ones; return whether nothing failed."""
    actors, whole = options.actors or _output(options) / 'actors', True
    for job in jobs:
        if not (job.folder / BEST_FILE).is_file():
            complain(_NAME, f'{job.name} has no best actor: no evaluation was whole')
            continue
        try:
            ship(job.folder, actors, episodes=options.episodes or 2000)
        except (OSError, ValueError, CommandError) as error:
            complain(_NAME, f'{job.name} is not shipped: {error}')
            whole = False
    if whole and actors.is_dir():
        table = _report_folder(options) / ACTORS_TABLE
        try:
            write_file(table, f'{actors_table(actors)}\n'.encode())
        except (OSError, ValueError) as error:
            raise CommandError(f'no {table}: {error}') from None
    return whole
