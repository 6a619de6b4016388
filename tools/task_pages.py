"""The numbers in the pages of docs/tasks, from `msgs_spec` and the shipped actors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from markdown_table import table

from msgs_spec.robots import FETCH
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TASKS, GoalKind, TaskSpec
from policy_node.training.runs.initial_networks import steps_behind
from policy_node.training.studies.published import BEST, CEILINGS, RERUN

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / 'docs' / 'tasks'
ACTORS = ROOT / 'policy_node' / 'actors'

_GOALS = {
    GoalKind.POINT: 'a point, metres, world',
    GoalKind.FINGERTIPS: 'positions of five fingertips, metres, world',
    GoalKind.POSE: 'position, metres, and quaternion wxyz, world',
}
_ARMS = {
    'her_sparse': 'DDPG+HER, sparse',
    'her_dense': 'DDPG+HER, dense',
    'ddpg_sparse': 'DDPG, sparse',
    'ddpg_dense': 'DDPG, dense',
}


def task_section(task: TaskSpec) -> str:
    """Returns all that is generated of a task's page, as GitHub Markdown."""
    parts = [
        ('The task in numbers', _contract(task)),
        ('Observation', _observation(task)),
        ('Published results', _published(task)),
        ('Our policy', _actor(task)),
        ('Try it', _commands(task.name)),
    ]
    return '\n\n'.join(f'## {title}\n\n{text}' for title, text in parts)


def index_section() -> str:
    """Returns the table of all tasks."""
    rows = []
    for task in _thirteen():
        success = f'{_report(task)["success_gymnasium"]:.3f}'
        name = f'[{task.name}]({task.name}.md)'
        rows.append((name, str(task.observation_size), _success(task), success))
    return table(('task', 'observation', 'success', 'our policy'), rows)


def _thirteen() -> list[TaskSpec]:
    # Third-party tasks have no reference.
    return [task for task in TASKS.values() if task.reference_id is not None]


def _contract(task: TaskSpec) -> str:
    is_fetch = task.robot is FETCH
    parts = task.robot.command
    command = f'{len(parts)} values: ' + (
        f'{", ".join(part.name for part in parts)}, each -1 ... 1'
        if is_fetch
        else 'joint positions in radians (`commands`), or -1 ... 1 over their ranges (Gymnasium)'
    )
    seconds = task.episode_ticks / DEFAULT_CONTROL_HZ
    dense = 'minus (10 x metres + radians)' if task.goal is GoalKind.POSE else 'minus the distance'
    rows = [
        ('robot', 'Fetch arm' if is_fetch else 'Shadow hand'),
        ('command', command),
        ('goal', f'{task.goal.size} values: {_GOALS[task.goal]}'),
        ('success', _success(task)),
        ('success rules', _rules(task)),
        ('reward', f'sparse: 0 at the goal, -1 elsewhere; dense: {dense}'),
        ('episode', f'{task.episode_ticks} ticks, {seconds:g} s at {DEFAULT_CONTROL_HZ:g} Hz'),
        ('Gymnasium', f'`fetch_hand_sim/{task.name}-v0`; equals `{task.reference_id}`'),
    ]
    return table(('', ''), rows)


def _success(task: TaskSpec) -> str:
    distance = f'within {100 * task.distance_threshold:g} cm'
    if task.rotation_threshold is None:
        return distance
    rotation = f'within {task.rotation_threshold:g} rad'
    if task.ignores_z_rotation:
        rotation += ", any turn about the object's own z axis"
    return f'{distance} and {rotation}' if task.position_counts else f'{rotation}, any position'


def _rules(task: TaskSpec) -> str:
    if task.goal is GoalKind.FINGERTIPS:
        return '`gymnasium`: the norm over all 15 coordinates; `paper`: the mean of five distances'
    if task.goal is GoalKind.POSE:
        return '`gymnasium`: raw quaternions, q and -q are 2 pi apart; `paper`: the angle between'
    return '`gymnasium` and `paper` are the same'


def _observation(task: TaskSpec) -> str:
    rows, start = [], 0
    for part in task.observation:
        note = ' (the achieved goal)' if part.name == task.achieved_goal else ''
        rows.append((f'{start} ... {start + part.size - 1}', f'`{part.name}`{note}', part.unit))
        start += part.size
    return f'{start} values.\n\n' + table(('index', 'part', 'unit'), rows)


def _published(task: TaskSpec) -> str:
    rows = [
        (f'{_ARMS[arm]}: {number.source}', number.success, number.kind)
        for (name, arm), number in RERUN.items()
        if name == task.name
    ]
    if best := BEST.get(task.name):
        rows.append((f'best known: {best.source}', best.success, best.kind))
    if not rows:
        return 'No number found: the paper has curves only.'
    return table(('source and steps', 'success', 'how read'), rows)


def _report(task: TaskSpec) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((ACTORS / f'{task.name}.json').read_text(encoding='utf-8'))
    return report


def _actor(task: TaskSpec) -> str:
    report = _report(task)
    lower, upper = report['success_gymnasium_interval_95']
    rows = [
        (
            'success at the last step',
            f'**{report["success_gymnasium"]:.3f}** ({lower:.3f} ... {upper:.3f}, 95 %)',
        ),
        ('by the rule `paper`', f'{report["success_paper"]:.3f}'),
        ('episodes, fresh seeds', f'{report["episodes"]:,}, from {report["first_seed"]:,}'),
        ('mean return, sparse', f'{report["mean_return"]:.2f}'),
        ('environment steps of training', f'{steps_behind(report):,}'),
    ]
    if reference := report.get('reference'):
        lower, upper = reference['interval_95']
        success = f'{reference["success"]:.3f} ({lower:.3f} ... {upper:.3f})'
        rows.insert(
            1,
            (f'in `{reference["environment"]}`', f'{success}, {reference["episodes"]:,} episodes'),
        )
    failures = f'### Failures\n\n{_failures(task, report)}'
    shows = 'Success during training (for averaged policies: an earlier run)'
    curve = f'![{shows}](../../policy_node/actors/{task.name}.png)'
    return f'{table(("", ""), rows)}\n\n{curve}\n\n{failures}'


def _failures(task: TaskSpec, report: dict[str, Any]) -> str:
    episodes = report['episodes']
    failed = round(episodes * (1 - report['success_gymnasium']))
    never = round(episodes * (1 - report['touched']))
    lines = [
        f'{failed:,} of {episodes:,} episodes: {never:,} never reached the goal, '
        f'{failed - never:,} reached it but lost it before the end.'
    ]
    if 'stay' in report:
        stay = f'with probability {report["stay"]:.3f}'
        lines.append(f'A reached goal is still reached at the next step {stay}.')
    if report.get('dropped') is not None:
        lines.append(f'{report["dropped"]:.1%} of the objects lay below the palm at the end.')
    if report.get('long_way') is not None:
        lines.append(
            f'In {report["long_way_share"]:.1%} of the episodes the rule requires the long way '
            f'round (quaternions of opposite sign at the start); {report["long_way"]:.3f} succeed.'
        )
    lines += [
        f'{name} to the goal at the end, median over all episodes: {report[key]:.3g} {unit}.'
        for key, name, unit in (('distance', 'Distance', 'm'), ('rotation', 'Rotation', 'rad'))
        if report.get(key) is not None
    ]
    return '\n'.join(f'- {line}' for line in [*lines, _ceiling(task)] if line)


def _ceiling(task: TaskSpec) -> str:
    if task.name not in CEILINGS:
        return ''
    return (
        f'At most {CEILINGS[task.name]:.3f} can succeed: the other goals are out of reach '
        '([ceilings](../results.md#ceilings)).'
    )


def _commands(task: str) -> str:
    return f"""\
    make demo TASK={task}
    fetch_hand_sim view --task {task}
    fetch_hand_sim evaluate --policy {task} --episodes 1000
    fetch_hand_sim train --task {task}"""


def sections() -> dict[Path, str]:
    """Returns what each page must hold, by its path."""
    found = {PAGES / f'{task.name}.md': task_section(task) for task in _thirteen()}
    return found | {PAGES / 'index.md': index_section()}
