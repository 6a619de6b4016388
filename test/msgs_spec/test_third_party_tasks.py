"""Tasks of other packages: what is taken, what is refused in one line, whose simulation it is."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from msgs_spec import tasks
from msgs_spec.tasks import TASKS, task_spec

PUSH = replace(TASKS['FetchPush'], name='Pushed')


def test_an_episode_has_a_tick_at_any_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TASKS, PUSH.name, replace(PUSH, episode_ticks=1))
    assert task_spec(PUSH.name, control_hz=12.5).episode_ticks == 1


def point(package: str, name: str, given: Any) -> Any:
    """An entry point of a third-party package, with the name of its task."""

    def load() -> Any:
        if isinstance(given, BaseException):
            raise given
        return given

    dist = SimpleNamespace(name=package)
    return SimpleNamespace(name=name, value=f'{package}:{name}', dist=dist, load=load)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    points: dict[str, list[Any]] = {tasks.SPECS: [], tasks.SIMULATIONS: []}

    def entry_points(group: str, name: str | None = None) -> list[Any]:
        return [each for each in points[group] if name in (None, each.name)]

    monkeypatch.setattr(tasks, 'entry_points', entry_points)
    monkeypatch.setattr(tasks, '_PACKAGES', {})
    return points


def test_a_package_that_exits_at_import_loses_only_its_own_task(
    installed: dict[str, list[Any]], caplog: pytest.LogCaptureFixture
) -> None:
    installed[tasks.SPECS] += [
        point('leaving', 'Left', SystemExit('no such\nrobot')),
        point('staying', 'Pushed', PUSH),
    ]
    with caplog.at_level(logging.WARNING):
        assert list(tasks.third_party_tasks()) == ['Pushed']
    assert 'task Left is left out: leaving: leaving:Left: no such robot' in caplog.text


def test_a_task_is_simulated_by_the_package_that_it_is_of(
    installed: dict[str, list[Any]],
) -> None:
    installed[tasks.SPECS] += [
        point('broken', 'Pushed', ImportError('no such thing')),
        point('whole', 'Pushed', PUSH),
        point('lonely', 'Alone', replace(PUSH, name='Alone')),
    ]
    installed[tasks.SIMULATIONS] += [
        point('broken', 'Pushed', 'its class'),
        point('whole', 'Pushed', 'the class'),
        # Of a task whose specification is a package of its own.
        point('elsewhere', 'Alone', 'another class'),
    ]
    tasks.third_party_tasks()
    assert tasks.third_party_simulation('Pushed') == 'the class'
    assert tasks.third_party_simulation('Alone') == 'another class'
    with pytest.raises(ValueError, match='task Gone has no simulation: no installed package'):
        tasks.third_party_simulation('Gone')


@pytest.mark.parametrize(
    ('name', 'given', 'line'),
    [
        ('Pushed', None, 'NoneType given; allowed: a TaskSpec'),
        ('Other', PUSH, "has the name 'Pushed'; allowed: 'Other'"),
        ('x' * 65, replace(PUSH, name='x' * 65), 'allowed: up to 64 letters'),
        ('Push (near)', replace(PUSH, name='Push (near)'), 'letters, digits, _, - and .'),
        ('Pushed', replace(PUSH, observation=list(PUSH.observation)), 'unhashable'),
        ('FetchPush', replace(PUSH, name='FetchPush'), 'another task has this name'),
    ],
)
def test_a_specification_that_cannot_be_listed_gives_one_warning(
    installed: dict[str, list[Any]],
    caplog: pytest.LogCaptureFixture,
    name: str,
    given: Any,
    line: str,
) -> None:
    installed[tasks.SPECS].append(point('wrong', name, given))
    assert tasks.third_party_tasks() == {}
    assert len(caplog.messages) == 1 and line in caplog.text


def test_a_copy_of_a_reference_task_has_no_environment_id(
    installed: dict[str, list[Any]],
) -> None:
    assert PUSH.reference_id is not None
    installed[tasks.SPECS].append(point('own', 'Pushed', PUSH))
    found = tasks.third_party_tasks()
    assert found == {'Pushed': replace(PUSH, reference_id=None)}
