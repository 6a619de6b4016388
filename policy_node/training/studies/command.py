"""`fetch_hand_sim benchmark`: train whole studies as resumable jobs, on one machine or on Ray.

`--study NAME`: the paper's comparison (`paper`, the default), one of its nine requests for
research, or `ingredients`. Trains task x variant x seed, measures each run on fresh episodes, and
adds it to data, figure and table in docs/research/NAME. Runs in this folder are not trained again.

`--study best`: the best recipe of every task, one job per core. Some tasks start from the networks
of another: of a run if `--tasks` contains that task, else of its shipped policy. Some are then
fine-tuned (variant `finetuned`, recipe `finetune`). Finally chooses between the best and the latest
actor of each last stage, evaluates it on fresh episodes, and copies the best of each task with its
critic, evaluation and curve into <output>/actors.

`--study module:NAME`: a `Study` of your own in a Python module of the working directory.

The same command skips finished jobs and continues interrupted ones. Two terminals with the same
command share the work.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from msgs_spec.text import did_you_mean, one_line
from node_runtime.command_line import (
    EXIT_FAILURE,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    given_command,
    require_extra,
    run_command,
    usage_errors,
    whole_number,
)
from policy_node.policies.files import write_file
from policy_node.policies.loading import is_python_name, working_directory_first
from policy_node.training.configuration.config import FIELDS
from policy_node.training.configuration.flat import (
    add_field_option,
    given_fields,
    with_assignments,
)
from policy_node.training.runs.shipping import ship
from policy_node.training.studies.best import BEST
from policy_node.training.studies.published import actors_table
from policy_node.training.studies.report import write_study
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.store import holds, read_runs, require_alike
from policy_node.training.studies.study import FINAL_EPISODES, Job, Study
from policy_node.training.studies.workers import (
    Place,
    Processes,
    Ray,
    ThisProcess,
    is_finished,
    run_jobs,
)

_NAME = 'fetch_hand_sim benchmark'
ACTORS_TABLE = 'actors.md'
_STUDIES = {**STUDIES, BEST.name: BEST}
# Fields of `TrainConfig` with an option; `--set` sets the others.
_FIELD_OPTIONS = ('total_steps', 'simulation_threads', 'torch_threads')


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(
        prog=_NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    help_of_study = f'{", ".join(_STUDIES)}, module:NAME; default: paper'
    add('--study', type=find_study, default='paper', metavar='NAME', help=help_of_study)
    default = 'default: the first of the study; all of study best'
    add('--tasks', nargs='+', choices=list(TASKS), metavar='TASK', help=default)
    seed, default = whole_number(0), 'default: 0 to 4 (ingredients: 0 1; best: 0)'
    add('--seeds', nargs='+', type=seed, metavar='SEED', help=default)
    add('--arms', nargs='+', metavar='ARM', help='variants; default: all')
    count = whole_number(1)
    add('--jobs', type=count, help='runs trained in parallel; default: 1; one per core')
    for name in _FIELD_OPTIONS:
        add_field_option(parser, FIELDS[name])
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='any field of TrainConfig')
    add('--output', type=Path, help='default: runs/research/NAME or runs/best')
    add('--report', type=Path, help='of figure and tables; default: docs/research/NAME or --output')
    add('--episodes', type=count, help='fresh episodes at the end; default: 500; best: 2000')
    add('--ray', action='store_true', help='independent jobs on Ray (extra: cluster)')
    add('--actors', type=Path, help='folder of actors of study best; default: <output>/actors')
    return parser.parse_args(arguments)


def find_study(name: str) -> Study:
    """Return the study `name`: one of this package, or `module:NAME`.

    Raises:
        ArgumentTypeError: If the name is unknown, or the module fails.
    """
    if name in _STUDIES:
        return _STUDIES[name]
    if not is_python_name(name):
        hint, allowed = did_you_mean(name, list(_STUDIES)), ', '.join(_STUDIES)
        line = f'{name[:80]!r} given; allowed: {allowed}, module:NAME{hint}'
        raise argparse.ArgumentTypeError(line)
    module, _, attribute = name.partition(':')
    try:
        with working_directory_first():
            study = getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        line = f'{name}: {type(error).__name__}: {one_line(error)}'
        raise argparse.ArgumentTypeError(line) from None
    if not isinstance(study, Study):
        line = f'{name} is a {type(study).__name__}; allowed: a Study'
    elif study.name in _STUDIES or not study.name.isidentifier():
        line = f'{name} is called {study.name!r}; allowed: a word that no other study is'
    elif not study.settings or not study.arms:
        line = f'{name} has no settings of a task, or no arms'
    elif len({arm.name for arm in study.arms if arm.name.isidentifier()}) < len(study.arms):
        line = f'{name} has arms {[arm.name for arm in study.arms]}; allowed: different words'
    else:
        return study
    raise argparse.ArgumentTypeError(line)


def jobs_from_arguments(options: argparse.Namespace) -> list[Job]:
    """Return the jobs that the options select.

    Raises:
        ValueError: If an option has a value that is not allowed, or the folder of a job contains a
            run with another configuration.
    """
    study: Study = options.study
    if options.actors is not None and not study.ships:
        raise ValueError('--actors belongs to --study best')
    jobs = study.jobs(
        options.tasks or (study.tasks if study.ships else study.tasks[:1]),
        [study.arm(name) for name in dict.fromkeys(options.arms or ())] or study.arms,
        list(dict.fromkeys(options.seeds or range(study.seeds))),
        _overrides(options, study),
        options.output or study.output,
        0 if study.ships else options.episodes or FINAL_EPISODES,
    )
    for job in jobs:
        job.check_configuration()
    return jobs


def _overrides(options: argparse.Namespace, study: Study) -> dict[str, Any]:
    """Return the `TrainConfig` fields that the options set for all jobs, or raise ValueError."""
    overrides = with_assignments(given_fields(options), options.set)
    decided = {'task', 'recipe', 'seed', 'init_from'}.union(*(arm.own for arm in study.arms))
    for name in overrides:
        if name in decided:
            raise ValueError(f'--set {name} is not possible: jobs differ in it')
    return overrides


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    command = given_command(_NAME, arguments)
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    if options.ray:
        require_extra('cluster')
    study: Study = options.study
    output = options.output or study.output
    report = options.report or (output if study.ships else Path('docs') / 'research' / study.name)
    with usage_errors((ValueError, TypeError)):
        jobs = jobs_from_arguments(options)
        if not study.ships:
            require_alike(study, jobs, report)
            jobs = _not_stored(jobs, report)
    for folder, content in ((output, 'runs'), (report, 'a report')):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f'{folder} cannot hold {content}: {error.strerror}') from None

    def renew() -> None:
        try:
            write_study(study, report)
        except (OSError, ValueError) as error:
            raise CommandError(f'no report in {report}: {error}') from None

    try:
        with _place(options, report, command) as place:
            status = run_jobs(jobs, place, report, renew)
    finally:
        renew()
        finished = [job for job in jobs if is_finished(job, report)]
        if len(finished) < len(jobs):
            count = f'{len(finished)} of {len(jobs)} jobs are finished'
            print(f'{count}; the same command continues the others')
    # Not after a stop: that would be thousands of episodes before the command ends.
    if study.ships and status <= EXIT_FAILURE and not _ship_all(options, finished, output, report):
        return EXIT_FAILURE
    return status


def _not_stored(jobs: Sequence[Job], folder: Path) -> list[Job]:
    """Return the jobs whose runs are not in the report `folder`; print how many runs are in it."""
    runs = read_runs(folder)
    keys = {job.key for job in jobs if not holds(runs, job)}
    # A first stage that another machine trained is trained again. It precedes the second in `jobs`.
    for job in reversed(jobs):
        if job.key in keys and job.after and not job.after.is_trained:
            keys.add(job.after.key)
    missing = [job for job in jobs if job.key in keys]
    if len(missing) < len(jobs):
        count = f'{len(jobs) - len(missing)} of {len(jobs)}'
        print(f'{count} runs are in {folder}; other --report and --output train them again')
    return missing


def _place(
    options: argparse.Namespace, report: Path, command: str
) -> contextlib.AbstractContextManager[Place]:
    """Return a context manager of the place where jobs run, chosen by `--jobs` and `--ray`."""
    cores = len(os.sched_getaffinity(0))
    limit = options.jobs or (cores if options.study.ships else 1)
    if options.ray:
        return contextlib.nullcontext(Ray(report, command))
    if limit == 1:
        return contextlib.nullcontext(ThisProcess(report, command))
    return Processes(limit, report, command)


def _ship_all(options: argparse.Namespace, jobs: Sequence[Job], output: Path, report: Path) -> bool:
    """Evaluate the actors of each job; copy the better one to `--actors` if it beats that there.

    Stages that another job of their task continues are left out. Return False if an evaluation or
    a copy failed. Otherwise write a table of the actors to the folder `report` and return True.
    """
    actors, whole = options.actors or output / 'actors', True
    continued = [job.after for job in jobs if job.after and job.after.key[0] == job.key[0]]
    for job in (job for job in jobs if job not in continued):
        try:
            ship(job.folder, actors, episodes=options.episodes or 2000)
        except (OSError, ValueError, CommandError) as error:
            complain(_NAME, f'{job.name} is not shipped: {error}')
            whole = False
    if whole and actors.is_dir():
        table = report / ACTORS_TABLE
        try:
            write_file(table, f'{actors_table(actors)}\n'.encode())
        except (OSError, ValueError) as error:
            raise CommandError(f'no {table}: {error}') from None
    return whole
