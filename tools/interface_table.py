"""The tables of docs/interface.md, generated from `msgs_spec`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

from markdown_table import table

from msgs_spec.parameters import NODES, ParameterSpec
from msgs_spec.robots import FETCH, FINGERTIPS, JOINT_PREFIX, SHADOW_HAND
from msgs_spec.tasks import TASKS, GoalKind, TaskSpec, VectorPart
from msgs_spec.tick import PHASES, EpisodeStatus
from msgs_spec.topics import MONITORING, SERVICES, QosSpec, TopicSpec, topics, view_topics

_PUBLISHING = (
    'All messages of a tick that have a header carry one stamp; simulated time starts at 1 s.\n'
    '`reward` and `applied_command` start with the first step of an episode; `episode_status` is\n'
    'sent at the first and the last tick of an episode, and while the robot waits for its first\n'
    'command; `desired_goal` every tick. `joint_states` has as many positions as velocities and\n'
    'efforts.'
)
_VIEWING = (
    'None of them is logged. The scalars of a tick carry its stamp, for plots: '
    '`scalars/distance/vector/x`.'
)
_COMMANDS = (
    'The order of the values in `commands` and `applied_command`. A joint is named as here in '
    '`joint_commands`, after the prefix. `policy_node` names the observation that a command '
    'answers: its layout has a second dimension of size 1 with the label `answers <stamp in 19 '
    'digits, ns>`.'
)
_FAMILIES: dict[str, Callable[[TaskSpec], bool]] = {
    'all': lambda task: True,
    'Fetch*': lambda task: task.robot is FETCH,
    'Hand*': lambda task: task.robot is SHADOW_HAND,
    'with an object': lambda task: task.has_object,
    'FetchReach': lambda task: task.robot is FETCH and not task.has_object,
    'FetchPush, FetchSlide, FetchPickAndPlace': lambda task: (
        task.robot is FETCH and task.has_object
    ),
    'HandReach': lambda task: task.goal is GoalKind.FINGERTIPS,
    'HandManipulate*': lambda task: task.goal is GoalKind.POSE,
    'whose position counts': lambda task: task.position_counts,
}


def interface_markdown() -> str:
    """Returns the section as GitHub Markdown."""
    parts = [
        ('Topics published by `sim_node`', f'{_topic_table(_published)}\n\n{_PUBLISHING}'),
        ('Topics `sim_node` subscribes to', _topic_table(_subscribed)),
        (
            'Topics published by `visualization_node`',
            f'{_topic_table(view_topics)}\n\n{_VIEWING}',
        ),
        ('Order of values', _orders()),
        ('Observation vectors', _observation_table()),
        ('Parameters', _parameter_table()),
        ('Services', _service_table()),
    ]
    return '\n\n'.join(f'## {title}\n\n{text}' for title, text in parts)


def _code(text: str) -> str:
    return f'`{text}`'


def _family(tasks: Iterable[TaskSpec]) -> str:
    """Return the name of a set of tasks."""
    names = {task.name for task in tasks}
    for label, belongs in _FAMILIES.items():
        if names == {task.name for task in TASKS.values() if belongs(task)}:
            return label
    raise LookupError(f'no name for the tasks {", ".join(sorted(names))}')


def _published(task: TaskSpec) -> list[TopicSpec]:
    return [s for s in (*topics(task), *MONITORING) if s.direction == 'published']


def _subscribed(task: TaskSpec) -> list[TopicSpec]:
    return [s for s in topics(task) if s.direction == 'subscribed']


def _topic_names(topics_of: Callable[[TaskSpec], Iterable[TopicSpec]]) -> list[str]:
    """Names of the topics of all tasks, in an order that agrees with that of each task."""
    names: list[str] = []
    for task in TASKS.values():
        place = 0
        for spec in topics_of(task):
            if spec.name not in names:
                names.insert(place, spec.name)
            place = names.index(spec.name) + 1
    return names


def _topic_table(topics_of: Callable[[TaskSpec], Iterable[TopicSpec]]) -> str:
    tasks: dict[TopicSpec, list[TaskSpec]] = {}
    for task in TASKS.values():
        for spec in topics_of(task):
            tasks.setdefault(spec, []).append(task)
    names = _topic_names(topics_of)
    return table(
        ('topic', 'type', 'tasks', 'values', 'unit', 'frame', 'QoS', 'content'),
        (
            (
                _code(spec.name),
                spec.type_name.replace('/msg/', '/'),
                _family(tasks[spec]),
                str(spec.size or ''),
                spec.unit,
                spec.frame,
                _qos(spec.qos),
                spec.description,
            )
            for spec in sorted(tasks, key=lambda spec: names.index(spec.name))
        ),
    )


def _qos(spec: QosSpec) -> str:
    kept = 'latched' if spec.durability == 'transient_local' else f'last {spec.depth}'
    return f'{spec.reliability}, {kept}'


def _orders() -> str:
    keys = [field.name for field in dataclasses.fields(EpisodeStatus)]
    lines = (
        'Quaternions: xyzw in messages, wxyz in observations and goals.',
        f'Joint names begin with `{JOINT_PREFIX}`, or with the parameter `joint_prefix`.',
        f'`joint_states` of a Fetch: {_names(FETCH.joints)}.',
        f'`joint_states` of a hand: {_names(SHADOW_HAND.joints)}.',
        f'Fingertips: {_names(FINGERTIPS)}.',
        f'Keys of `episode_status`: {_names(keys)}. Values are text; booleans are `True` and '
        '`False`. `joint_prefix`, `disturbances` and `variation` are left out if they have '
        'their defaults.',
        f'`phase`: {", ".join(f"`{phase}` {when}" for phase, when in PHASES.items())}.',
    )
    values = '\n'.join(f'- {line}' for line in lines)
    return f'{values}\n\n### Commands\n\n{_COMMANDS}\n\n{_command_table()}'


def _names(names: Sequence[str]) -> str:
    return ', '.join(_code(name.removeprefix(JOINT_PREFIX)) for name in names)


def _command_table() -> str:
    return table(
        ('robot', 'index', 'value', 'lowest', 'highest', 'unit'),
        (
            (
                robot,
                str(index),
                _code(part.name.removeprefix(JOINT_PREFIX)),
                f'{part.lower:g}',
                f'{part.upper:g}',
                part.unit,
            )
            for robot, spec in (('Fetch', FETCH), ('hand', SHADOW_HAND))
            for index, part in enumerate(spec.command)
        ),
    )


def _observation_table() -> str:
    tasks: dict[tuple[VectorPart, ...], list[TaskSpec]] = {}
    for task in TASKS.values():
        tasks.setdefault(task.observation, []).append(task)
    rows = []
    for parts, users in tasks.items():
        start = 0
        for part in parts:
            indices = f'{start} ... {start + part.size - 1}'
            rows.append((_family(users), indices, _code(part.name), part.unit))
            start += part.size
        goal = users[0].goal
        rows.append((_family(users), f'0 ... {goal.size - 1}', 'either goal', goal.name.lower()))
    return table(('tasks', 'indices', 'part', 'unit'), rows)


def _parameter_table() -> str:
    rows = [(node, spec) for node, specs in NODES.items() for spec in specs]
    return table(
        ('node', 'parameter', 'type', 'default', 'allowed', 'at run time', 'meaning'),
        (
            (
                node,
                _code(spec.name),
                spec.type,
                _code(repr(spec.default)),
                _allowed(spec),
                'fixed' if spec.read_only else 'settable',
                spec.description,
            )
            for node, spec in rows
        ),
    )


def _allowed(spec: ParameterSpec) -> str:
    if set(TASKS) <= set(spec.choices):
        others = [choice for choice in spec.choices if choice not in TASKS]
        return ', '.join([*map(_code, map(repr, others)), f'one of the {len(TASKS)} tasks'])
    return ', '.join(map(_code, map(repr, spec.choices))) or spec.allowed


def _service_table() -> str:
    return table(
        ('service', 'type', 'node', 'what it does'),
        (
            (_code(spec.name), spec.type_name.replace('/srv/', '/'), spec.node, spec.description)
            for spec in SERVICES
        ),
    )
