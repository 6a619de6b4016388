"""The services of a robot.

`simulation_interfaces` is replaced by stand-ins with the fields of its releases 1.0.0 to 2.1.0;
`test_ros_messages.py` uses the real package.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

from fetch_hand_sim.sim_node.services import SimulationInterfaces, open_services
from msgs_spec.topics import INTERFACE_SERVICES, SERVICES, STANDARD_SERVICES


class Features:
    SIMULATION_RESET, SIMULATION_RESET_STATE = 20, 22
    SIMULATION_STATE_GETTING, SIMULATION_STATE_SETTING, SIMULATION_STATE_PAUSE = 24, 25, 26
    STEP_SIMULATION_SINGLE, STEP_SIMULATION_MULTIPLE = 31, 32


def response():
    return SimpleNamespace(
        result=SimpleNamespace(result=None, error_message=None),
        state=SimpleNamespace(state=None),
        features=SimpleNamespace(features=[], spawn_formats=[], custom_info=''),
    )


def call(method, **fields):
    answer = method(SimpleNamespace(**fields), response())
    return answer.result.result, answer.result.error_message


def state(number):
    return SimpleNamespace(state=number)


def test_simulation_interfaces_translate_to_the_robot(make):
    case = make()
    case.robot.tick()
    services = SimulationInterfaces(case.robot, Features)
    assert services.get_simulation_state(None, response()).state.state == 1
    assert call(services.step_simulation, steps=2) == (
        4,
        'a simulation is stepped only while it is paused',
    )
    assert call(services.set_simulation_state, state=state(2)) == (1, 'paused at 1.000 s')
    assert call(services.set_simulation_state, state=state(2)) == (101, 'already paused')
    assert services.get_simulation_state(None, response()).state.state == 2
    assert call(services.step_simulation, steps=2)[0] == 1
    assert len(case.ticks) == 3
    assert call(services.step_simulation, steps=0)[0] == 4
    assert call(services.set_simulation_state, state=state(0))[0] == 0
    assert call(services.reset_simulation, scope=1)[0] == 0
    assert call(services.reset_simulation, scope=2) == (
        1,
        'episode 0 ends; a tick of its own starts episode 1 with seed 1',
    )
    case.robot.tick_when_due()
    # Scope 0 means all: as after a new start, except time.
    for scope in (0, 255):
        case.robot.step(10)
        assert call(services.reset_simulation, scope=scope)[1].endswith(
            'a tick of its own starts episode 0 with seed 0; time goes on'
        )
        case.robot.tick_when_due()
    before, after = case.ticks[0][0], case.ticks[-1][0]
    assert after.stamp_ns > before.stamp_ns
    assert (after.status.seed, after.status.tick) == (before.status.seed, 0)
    assert after.desired_goal.tolist() == before.desired_goal.tolist()
    assert call(services.set_simulation_state, state=state(1)) == (1, 'running at 2.000 s')


def test_simulation_interfaces_list_only_features_the_release_knows(make):
    services = SimulationInterfaces(make().robot, Features)
    found = services.get_simulator_features(None, response()).features.features
    assert found == [20, 22, 24, 25, 26, 31, 32]
    older = SimpleNamespace(SIMULATION_RESET=10, STEP_SIMULATION_SINGLE=15)
    services = SimulationInterfaces(make().robot, older)
    assert services.get_simulator_features(None, response()).features.features == [10, 15]


def test_services_open_with_and_without_simulation_interfaces(make, monkeypatch):
    """Stand-in modules: the real ones need type support that no wheel has."""
    package = 'simulation_interfaces'
    # Where they are installed, as if they were not.
    monkeypatch.setitem(sys.modules, f'{package}.msg', None)
    case = make()
    opened = {}
    node = SimpleNamespace(create_service=lambda type_, name, call: opened.update({name: call}))
    open_services(node, case.robot)
    assert set(opened) == {spec.name for spec in STANDARD_SERVICES}
    answer = opened['~/step'](None, SimpleNamespace(success=None, message=None))
    assert (answer.success, 'pause it first' in answer.message) == (False, True)

    types = {spec.type_name.rpartition('/')[2]: object for spec in INTERFACE_SERVICES}
    monkeypatch.setitem(sys.modules, package, ModuleType(package))
    for name, content in (('msg', {'SimulatorFeatures': Features}), ('srv', types)):
        module = ModuleType(f'{package}.{name}')
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, f'{package}.{name}', module)
    open_services(node, case.robot)
    assert set(opened) == {spec.name for spec in SERVICES}
    assert call(opened['~/set_simulation_state'], state=state(2))[0] == 1
    assert case.robot.schedule.is_paused
