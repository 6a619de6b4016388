"""Tasks of other packages: what is taken, what is refused in one line, whose simulation it is."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from msgs_spec import foreign_tasks
from msgs_spec.task_checks import accept
from msgs_spec.tasks import TASKS, VectorPart, task_spec

PUSH = replace(TASKS['FetchPush'], name='Pushed')
_accept = partial(accept, known=dict(TASKS))
FIRST = replace(PUSH.robot.command[0], lower=1.0, upper=1.0)


@pytest.mark.parametrize(
    ('change', 'line'),
    [
        ({'name': 'x' * 65}, 'a name has letters, digits, .*, 64 at most, not'),
        ({'robot': None}, 'robot is no RobotSpec but NoneType'),
        ({'goal': 'point'}, 'goal is no GoalKind but str'),
        ({'observation': list(PUSH.observation)}, 'unhashable .*tuples, not lists or arrays'),
        ({'distance_threshold': -1.0}, 'distance_threshold -1.0; allowed: a number of more than 0'),
        ({'distance_threshold': float('nan')}, 'distance_threshold nan; allowed: a number of'),
        ({'episode_ticks': 0}, 'episode_ticks 0; allowed: a whole number, 1 or more'),
        ({'distance_threshold': None}, 'distance_threshold None; allowed: a number of more than 0'),
        ({'rotation_threshold': '5'}, "rotation_threshold '5'; allowed: a number of more than 0"),
        ({'episode_ticks': 30.5}, 'episode_ticks 30.5; allowed: a whole number, 1 or more'),
        ({'observation': (('tip', 3, 'm'),)}, r"observation has \('tip', 3, 'm'\), which is no Ve"),
        ({'observation': (VectorPart('tip', 3.0, 'm'),)}, 'tip has size 3.0; allowed: 1 or more'),
        ({'formulas': (1, 2)}, 'formulas is no TaskFormulas but tuple'),
        (
            {'looks_like': 'FetchPsh'},
            "looks_like 'FetchPsh'; allowed: None, .*did you mean 'FetchP",
        ),
        (
            {'object_symmetry': 'sphere'},
            "object_symmetry 'sphere'; allowed: None, cube, rev",
        ),
        ({'robot': replace(PUSH.robot, joints=())}, 'fetch has 0 joints with units .*; allowed'),
        ({'robot': replace(PUSH.robot, joint_units=('rad',))}, r"15 joints with units \('rad',\)"),
        (
            {'robot': replace(PUSH.robot, command=('x',))},
            "command has 'x', which is no Comma",
        ),
        (
            {'robot': replace(PUSH.robot, command=(replace(FIRST, lower='-1'),))},
            r"command x has limits \('-1', 1.0\); allowed: two numbers",
        ),
        ({'robot': replace(PUSH.robot, command=(FIRST,))}, 'command x has limits 1 ... 1'),
        ({'robot': replace(PUSH.robot, joints=list(PUSH.robot.joints))}, 'unhashable .*tuples'),
    ],
)
def test_what_would_fail_far_away_is_refused(change: dict[str, Any], line: str) -> None:
    spec = replace(PUSH, **change)
    with pytest.raises(ValueError, match=line):
        _accept(spec.name, spec)


def test_an_episode_has_a_tick_at_any_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TASKS, PUSH.name, replace(PUSH, episode_ticks=1))
    assert task_spec(PUSH.name, control_hz=12.5).episode_ticks == 1


def test_a_task_made_from_a_twin_is_none() -> None:
    """Its id would take the place of the twin's."""
    assert PUSH.reference_id is not None
    assert _accept('Pushed', PUSH) == replace(PUSH, reference_id=None)


class Package:
    """An entry point of a package of somebody else."""

    def __init__(self, package: str, name: str, given: object) -> None:
        self.dist = self
        self.name, self.value = package, f'{package}:{name}'
        self._given = given

    def load(self) -> object:
        if isinstance(self._given, BaseException):
            raise self._given
        return self._given


class Point(Package):
    """With the name of its task."""

    def __init__(self, package: str, name: str, given: object) -> None:
        super().__init__(package, name, given)
        self.dist = Package(package, name, given)
        self.name = name


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Point]]:
    points: dict[str, list[Point]] = {foreign_tasks.SPECS: [], foreign_tasks.SIMULATIONS: []}

    def entry_points(group: str, name: str | None = None) -> list[Point]:
        return [each for each in points[group] if name in (None, each.name)]

    monkeypatch.setattr(foreign_tasks, 'entry_points', entry_points)
    monkeypatch.setattr(foreign_tasks, '_PACKAGES', {})
    return points


def test_a_package_that_ends_the_program_costs_its_own_task(
    installed: dict[str, list[Point]], caplog: pytest.LogCaptureFixture
) -> None:
    installed[foreign_tasks.SPECS] += [
        Point('leaving', 'Left', SystemExit(2)),
        Point('staying', 'Pushed', PUSH),
    ]
    with caplog.at_level(logging.WARNING):
        assert list(foreign_tasks.foreign_tasks(_accept)) == ['Pushed']
    assert 'task Left is left out: leaving: leaving:Left: 2' in caplog.text


def test_a_task_is_simulated_by_the_package_that_it_is_of(
    installed: dict[str, list[Point]],
) -> None:
    installed[foreign_tasks.SPECS] += [
        Point('broken', 'Pushed', ImportError('no such thing')),
        Point('whole', 'Pushed', PUSH),
        Point('lonely', 'Alone', replace(PUSH, name='Alone')),
    ]
    installed[foreign_tasks.SIMULATIONS] += [
        Point('broken', 'Pushed', 'its class'),
        Point('whole', 'Pushed', 'the class'),
        # Of a task whose specification is a package of its own.
        Point('elsewhere', 'Alone', 'another class'),
    ]
    foreign_tasks.foreign_tasks(_accept)
    assert foreign_tasks.foreign_simulation('Pushed') == 'the class'
    assert foreign_tasks.foreign_simulation('Alone') == 'another class'


def test_a_specification_that_brings_the_simulation_is_named(
    installed: dict[str, list[Point]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It asks for the tasks while they are being read, and leaves all of them unregistered."""

    class Heavy(Point):
        def load(self) -> object:
            monkeypatch.setitem(sys.modules, 'fetch_hand_sim', logging)
            return super().load()

    monkeypatch.delitem(sys.modules, 'fetch_hand_sim', raising=False)
    other = replace(PUSH, name='Other')
    installed[foreign_tasks.SPECS] += [Heavy('heavy', 'Pushed', PUSH), Heavy('b', 'Other', other)]
    assert list(foreign_tasks.foreign_tasks(_accept)) == ['Pushed', 'Other']
    assert caplog.messages == [
        'task Pushed: heavy: heavy:Pushed imports fetch_hand_sim, which only its simulation may'
    ]
