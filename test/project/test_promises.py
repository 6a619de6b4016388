"""The names that docs/promises.md keeps still exist."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from gymnasium.envs.registration import registry
from reference_pages import leaves

from fetch_hand_sim.gym_envs.registration import reference_ids
from msgs_spec.parameters import NODES
from msgs_spec.tasks import TASKS
from msgs_spec.tick import PHASES, EpisodeStatus
from msgs_spec.topics import MONITORING, SERVICES, topics
from policy_node.training.configuration.config import FIELDS
from support import ROOT
from support.entry_points import console_scripts

# One promise per line, written by `write` when 1.0 was released. Lines may be added, never changed.
PROMISED = ROOT / 'test' / 'data' / 'promises_1_0.txt'


def present() -> Iterator[str]:
    """Everything of the kinds that are promised, as it is now."""
    for name, task in TASKS.items():
        parts = ' '.join(f'{part.name}:{part.size}' for part in task.observation)
        limits = f'{task.distance_threshold:g} m, {task.rotation_threshold or 0:g} rad'
        yield f'task {name}: {task.goal.name} {task.episode_ticks} ticks, {limits}'
        yield f'observation {name}: {parts}'
        yield f'joints {name}: {" ".join(task.robot.joints)}'
        commands = (f'{p.name}:{p.lower:g}:{p.upper:g}' for p in task.robot.command)
        yield f'command {name}: {" ".join(commands)}'
        for topic in (*topics(task), *MONITORING):
            quality = f'{topic.qos.reliability} {topic.qos.durability}'
            yield f'topic {name}: {topic.direction} {topic.name} {topic.type_name} {quality}'
    yield from (f'service {spec.node}: {spec.name} {spec.type_name}' for spec in SERVICES)
    for node, parameters in NODES.items():
        yield from (f'parameter {node}: {p.name} {p.type} {p.default!r}' for p in parameters)
    yield from (f'episode_status: {field.name}' for field in dataclasses.fields(EpisodeStatus))
    yield from (f'phase: {phase}' for phase in PHASES)
    paths = [path[:depth] for path, _ in leaves() for depth in range(1, len(path) + 1)]
    yield from (f'command line: {" ".join(path)}' for path in paths)
    yield from (f'executable: {name}' for name in console_scripts())
    yield from (f'training field: {name}' for name in FIELDS)
    own = (name for name in registry if name.startswith('fetch_hand_sim/'))
    yield from (f'environment: {name}' for name in (*own, *reference_ids()))


def test_every_promised_name_exists() -> None:
    promised = set(PROMISED.read_text(encoding='utf-8').splitlines())
    assert len(promised) > 300
    gone = sorted(promised - set(present()))
    assert not gone, 'promised for all of 1.x in docs/promises.md, and gone: ' + '\n'.join(gone)


def write() -> None:
    """Writes the promises of a release: for the next major version."""
    PROMISED.write_text('\n'.join(sorted(set(present()))) + '\n', encoding='utf-8')
