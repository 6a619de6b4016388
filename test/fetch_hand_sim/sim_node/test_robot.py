"""A robot without ROS: when it ticks, what it answers, what it reports, what it refuses."""

from __future__ import annotations

import math
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.sim_node.command_buffer import CommandBuffer
from fetch_hand_sim.sim_node.commanders import CommanderWatch, Endpoint
from fetch_hand_sim.sim_node.health import Health, Surroundings
from fetch_hand_sim.sim_node.pacing import RealTimePacer
from fetch_hand_sim.sim_node.receivers import Receivers
from fetch_hand_sim.sim_node.robot import Robot
from fetch_hand_sim.sim_node.schedule import TickSchedule
from fetch_hand_sim.sim_node.services import open_services
from fetch_hand_sim.sim_node.simulation_interfaces import SimulationInterfaces
from fetch_hand_sim.simulation import Simulation
from msgs_spec.cdr import TopicCodec
from msgs_spec.codecs import build_message, decode_status
from msgs_spec.diagnostics import Level, encode_reports
from msgs_spec.schemas import deserialize, message_class, serialize
from msgs_spec.services import INTERFACE_SERVICES, MAX_STEPS, SERVICES, STANDARD_SERVICES
from msgs_spec.topics import DIAGNOSTICS, topic, topics


class Clock:
    """A steady clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope='module')
def simulations():
    return {name: Simulation(name, num_threads=1) for name in ('FetchReach', 'HandReach')}


@pytest.fixture
def make(simulations):
    def make(mode='realtime', task='FetchReach', factor=1.0, episodes=0):
        clock, ticks = Clock(), []
        runner = EpisodeRunner(simulations[task], episodes=episodes)
        pacer = RealTimePacer(0.04, factor, clock.now)
        robot = Robot(
            runner,
            CommandBuffer(runner.spec.robot, 0.5),
            TickSchedule(mode, pacer),
            lambda tick, messages: ticks.append((tick, messages)),
            clock,
        )
        return SimpleNamespace(robot=robot, clock=clock, ticks=ticks)

    return make


def test_lockstep_takes_one_tick_per_valid_command_and_none_by_itself(make):
    case = make('lockstep')
    assert case.robot.wait() == 0.0  # the first reset
    case.robot.tick_when_due()
    case.clock.now += 1000.0
    assert case.robot.wait() == math.inf
    with pytest.raises(ValueError, match='3 values'):
        case.robot.accept_command([0.0] * 3)
    assert case.robot.wait() == math.inf
    for _ in range(3):
        case.robot.accept_command([0.1] * 4)
        assert case.robot.wait() == 0.0
        case.robot.tick_when_due()
        assert case.robot.wait() == math.inf
    assert [tick.status.tick for tick, _ in case.ticks] == [0, 1, 2, 3]


def test_lockstep_steps_when_asked_and_realtime_only_while_paused(make):
    case = make('lockstep')
    case.robot.tick()
    assert case.robot.step().success
    assert case.ticks[-1][0].status.tick == 1
    case = make('realtime')
    case.robot.tick()
    answer = case.robot.step()
    assert not answer.success
    assert 'pause it first' in answer.message
    assert len(case.ticks) == 1
    case.robot.pause(True)
    assert case.robot.wait() == math.inf
    assert case.robot.step(3).message == '3 run, now at 1.120 s'
    assert len(case.ticks) == 4


@pytest.mark.parametrize('count', [0, -1, MAX_STEPS + 1, 2**64 - 1])
def test_step_refuses_counts_that_would_block(make, count):
    case = make('lockstep')
    answer = case.robot.step(count)
    assert not answer.success
    assert f'allowed: 1 ... {MAX_STEPS}' in answer.message
    assert case.ticks == []


def test_step_ends_with_the_last_episode(make):
    case = make('lockstep', episodes=1)
    answer = case.robot.step(60)
    assert not answer.success
    assert answer.message == 'all episodes are done; 51 of 60 ticks ran'


@pytest.mark.parametrize(
    ('mode', 'paused', 'words'),
    [
        ('realtime', False, 'the next tick starts episode 1 with seed 1'),
        ('lockstep', False, 'the next command starts episode 1 with seed 1'),
        ('lockstep', True, 'the next step starts episode 1 with seed 1'),
    ],
)
def test_reset_says_what_follows_and_it_does(make, mode, paused, words):
    case = make(mode)
    assert 'about to start anyway' in case.robot.reset().message
    case.robot.tick()
    case.robot.pause(paused)
    answer = case.robot.reset()
    assert answer.success
    assert words in answer.message
    case.robot.tick()
    status = case.ticks[-1][0].status
    assert (status.episode, status.tick, status.phase) == (1, 0, 'reset')
    assert case.robot.counters.given_up == 1


def test_paused_time_is_not_made_up_for(make):
    case = make()
    case.robot.tick_when_due()
    case.robot.pause(True)
    case.clock.now += 60.0
    assert case.robot.pause(False).message == 'running at 1.000 s'
    assert case.robot.pause(False).message == 'already running'
    case.robot.tick_when_due()
    assert case.robot.wait() == pytest.approx(0.04)
    assert case.robot.schedule.pacer.missed_ticks == 0


def test_late_ticks_are_counted_and_never_accumulate(make):
    case = make()
    for late in (0.0, 0.13, 0.0, 0.07):
        case.clock.now += case.robot.wait() + late
        case.robot.tick_when_due()
    assert case.robot.schedule.pacer.missed_ticks == 3 + 1
    # Whatever was late, the next tick comes on the old grid, less than a period from now.
    assert 0.0 < case.robot.wait() <= 0.04
    assert math.remainder(case.clock.now + case.robot.wait() - 100.0, 0.04) == pytest.approx(0.0)


@pytest.mark.parametrize('factor', [0.1, 1.0, 3.0, 20.0])
def test_real_time_factor_changes_while_running(make, factor):
    case = make()
    case.robot.tick_when_due()
    case.robot.set_real_time_factor(factor)
    case.robot.tick_when_due()
    assert case.robot.wait() == pytest.approx(0.04 / factor)
    case.robot.set_real_time_factor(0.0)
    assert case.robot.wait() == 0.0


def test_the_present_tick_can_be_heard_again_with_the_same_bytes(make):
    case = make('lockstep')
    assert case.robot.present() == []
    case.robot.tick()
    assert case.robot.present() == case.ticks[-1][1]


def test_goals_that_are_refused_are_counted(make):
    case = make()
    target = topic(case.robot.runner.spec, 'set_goal')

    def goal(*values):
        return build_message(target, 0, values)

    with pytest.raises(ValueError, match='no episode is running'):
        case.robot.set_goal(target, goal(1.0, 1.0, 1.0))
    case.robot.tick()
    with pytest.raises(ValueError, match=r'1e\+200 given; allowed: -1000 ... 1000'):
        case.robot.set_goal(target, goal(1.0, 1e200, 0.5))
    case.robot.set_goal(target, goal(1.3, 0.7, 0.6))
    case.robot.tick()
    assert case.ticks[-1][0].desired_goal.tolist() == [1.3, 0.7, 0.6]
    assert (case.robot.counters.goals_set, case.robot.counters.goals_rejected) == (1, 2)


# Commanders


def endpoint(node, name='/commands', type_name='T', reliable=True, gid=None):
    return Endpoint(node, name, type_name, reliable, gid or f'{node}{name}'.encode())


def test_newcomers_and_duplicates_are_named():
    watch = CommanderWatch({'/commands': 'T', '/joint_commands': 'J'})
    assert not watch.look([])
    a, b = endpoint('/a'), endpoint('/a', '/joint_commands', 'J')
    assert watch.look([a, b])
    assert not watch.look([a, b])
    assert (watch.names, watch.problems()) == (['/a'], [])
    assert watch.look([a, endpoint('/b')])
    assert watch.problems() == ['2 publish commands: /a, /b']
    # Two processes under one name.
    assert watch.look([a, endpoint('/a', gid=b'other')])
    assert watch.problems() == ['2 publish commands: /a, /a']
    # One that was restarted.
    watch.look([])
    assert watch.look([endpoint('/a', gid=b'again')])


def test_commanders_nobody_can_hear_are_named_with_the_reason():
    watch = CommanderWatch({'/commands': 'T'})
    watch.look([endpoint('/a', reliable=False), endpoint('/b', type_name='S')])
    assert watch.names == []
    assert watch.problems() == [
        '/commands of /a is not received: it is best effort; offer reliable',
        '/commands of /b is not received: its type is S',
    ]


# Reports

FINE = Surroundings(['/policy_node'], [], ['/sim_node'], True, 'episodes', False)


def report_after(case, surroundings=FINE, seconds=1.0, ticks=25):
    health = Health(case.robot, '/sim_node', case.clock.now)
    health.report(surroundings, case.clock.now)
    for _ in range(ticks):
        case.clock.now += case.robot.wait() if case.robot.wait() < math.inf else 0.0
        case.robot.tick_when_due()
    case.clock.now = max(case.clock.now, 100.0 + seconds)
    return health.report(surroundings, case.clock.now)


def test_report_of_a_healthy_robot(make):
    report = report_after(make(), ticks=26)
    assert report.level is Level.OK, report.message
    assert report.message == 'FetchReach runs, 26.0 ticks per second'
    assert report.values['real time factor'] == '1.040'
    assert report.values['missed ticks'] == '0'
    assert report.values['commanders'] == '/policy_node'


@pytest.mark.parametrize(
    ('problem', 'level', 'text'),
    [
        ('missed', Level.WARN, '3 ticks missed'),
        ('rejected', Level.WARN, '1 commands rejected; command of 3 values dropped; allowed: 4'),
        ('stalled', Level.WARN, 'tick 1 of episode 0 waits for a valid command; nobody publishes'),
        ('clock', Level.ERROR, '/clock has 2 publishers: /a/sim_node, /b/sim_node; start all'),
        ('log', Level.ERROR, 'logging to episodes has failed'),
        ('diverged', Level.ERROR, 'MuJoCo lost the state 1 times'),
        ('duplicate', Level.WARN, '2 publish commands: /a, /b'),
    ],
)
def test_report_says_what_is_wrong(make, monkeypatch, problem, level, text):
    case = make('lockstep' if problem == 'stalled' else 'realtime')
    changes = {
        'clock': {'clock_publishers': ['/a/sim_node', '/b/sim_node']},
        'log': {'log': 'logging to episodes has failed', 'has_log_failed': True},
        'duplicate': {'problems': ['2 publish commands: /a, /b']},
        'stalled': {'commanders': []},
    }.get(problem, {})
    surroundings = Surroundings(**{f: getattr(FINE, f) for f in FINE.__slots__} | changes)
    health = Health(case.robot, '/sim_node', case.clock.now)
    case.robot.tick_when_due()
    health.report(surroundings, case.clock.now)
    if problem == 'missed':
        case.clock.now += 0.17
        case.robot.tick_when_due()
    elif problem == 'rejected':
        with pytest.raises(ValueError, match='dropped'):
            case.robot.accept_command([1.0] * 3)
    elif problem == 'diverged':
        monkeypatch.setattr(case.robot.runner.simulation, 'divergences', 1)
    case.clock.now += 1.0
    report = health.report(surroundings, case.clock.now)
    assert report.level is level
    assert text in report.message
    status = deserialize(DIAGNOSTICS.type_name, encode_reports(5, [report])).status[0]
    assert (status.level, status.name, status.message) == (level, '/sim_node', report.message)


def test_report_counts_rejections_by_reason(make):
    case = make()
    case.robot.tick()
    for bad in ([0.0] * 3, [np.nan] * 4, [np.inf] * 4):
        with pytest.raises(ValueError, match='dropped'):
            case.robot.accept_command(bad)
    values = Health(case.robot, '/sim_node', case.clock.now).report(FINE, 101.0).values
    assert values['commands rejected'] == '3'
    assert (values['rejected: wrong size'], values['rejected: not finite']) == ('1', '2')


def test_monitoring_is_no_part_of_a_tick(make):
    case = make()
    case.robot.tick()
    assert {spec.name for spec, _ in case.ticks[0][1]}.isdisjoint({'/diagnostics'})
    assert DIAGNOSTICS not in topics(case.robot.runner.spec)


# simulation_interfaces, against stand-ins with the fields of its release 2.0.0


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
    assert call(services.reset_simulation, scope=255)[0] == 0
    assert call(services.reset_simulation, scope=0) == (
        1,
        'episode 0 ends; the next step starts episode 1 with seed 1',
    )
    assert call(services.set_simulation_state, state=state(1)) == (1, 'running at 1.080 s')


def test_simulation_interfaces_list_only_features_the_release_knows(make):
    services = SimulationInterfaces(make().robot, Features)
    found = services.get_simulator_features(None, response()).features.features
    assert found == [20, 22, 24, 25, 26, 31, 32]
    older = SimpleNamespace(SIMULATION_RESET=10, STEP_SIMULATION_SINGLE=15)
    services = SimulationInterfaces(make().robot, older)
    assert services.get_simulator_features(None, response()).features.features == [10, 15]


def test_services_open_with_and_without_simulation_interfaces(make, monkeypatch):
    """Stand-in modules: the real ones need type support that no wheel has."""
    case = make()
    opened = {}
    node = SimpleNamespace(create_service=lambda type_, name, call: opened.update({name: call}))
    open_services(node, case.robot)
    assert set(opened) == {spec.name for spec in STANDARD_SERVICES}
    answer = opened['~/step'](None, SimpleNamespace(success=None, message=None))
    assert (answer.success, 'pause it first' in answer.message) == (False, True)

    types = {spec.type_name.rpartition('/')[2]: object for spec in INTERFACE_SERVICES}
    package = 'simulation_interfaces'
    monkeypatch.setitem(sys.modules, package, ModuleType(package))
    for name, content in (('msg', {'SimulatorFeatures': Features}), ('srv', types)):
        module = ModuleType(f'{package}.{name}')
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, f'{package}.{name}', module)
    open_services(node, case.robot)
    assert set(opened) == {spec.name for spec in SERVICES}
    assert call(opened['~/set_simulation_state'], state=state(2))[0] == 1
    assert case.robot.schedule.is_paused


# What comes over the network

HOSTILE = [math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1e308, -1e308, 0.0, -0.0, 1.0, 1e-310]


def hostile_vector(generator, size):
    length = int(generator.choice([size, size, size, 0, 1, abs(size - 1), size + 1, 1000]))
    if generator.random() < 0.5:
        return generator.uniform(-2.0, 2.0, length)
    return generator.choice(HOSTILE, length)


def hostile_message(generator, spec):
    if spec.name == 'commands':
        array = message_class(spec.type_name)
        layout = message_class('std_msgs/msg/MultiArrayLayout')(dim=[], data_offset=2**32 - 1)
        return array(layout=layout, data=hostile_vector(generator, spec.size))
    if spec.name == 'joint_commands':
        names = [*spec.names, '', 'robot0:', '\N{SNOWMAN}' * 100, spec.names[0]]
        chosen = [str(name) for name in generator.choice(names, generator.integers(0, 24))]
        message = build_message(spec, 0, np.zeros(spec.size))
        message.name, message.position = chosen, hostile_vector(generator, len(chosen))
        return message
    if spec.name == 'policy_status':
        message = message_class(spec.type_name)
        header = build_message(topic_of_header(), 0, np.zeros(3)).header
        return message(header=header, status=[])
    values = hostile_vector(generator, spec.size)
    return build_message(spec, 0, np.resize(values, spec.size) if values.size else [0] * spec.size)


def damaged(generator, data):
    """The bytes, every twentieth time cut off or with wrong ones among them."""
    if generator.random() > 0.05:
        return data
    found = bytearray(data)
    found[generator.integers(len(found))] ^= 0xFF
    return bytes(found[: generator.integers(len(found))])


def topic_of_header():
    from msgs_spec.tasks import task_spec

    return topic(task_spec('FetchReach'), 'set_goal')


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach'])
def test_hostile_messages_are_refused_and_counted_and_no_state_is_lost(make, task, hostile_count):
    """Every message is applied or counted, and what is published stays finite."""
    case = make('realtime', task=task, factor=0.0)
    spec = case.robot.runner.spec
    lines = []
    receivers = Receivers(case.robot, None, lambda sha256: None, lines.append)
    targets = [each for each in topics(spec) if each.direction == 'subscribed']
    callbacks = {each.name: receivers.callback(each) for each in targets}
    joint_states = TopicCodec(topic(spec, 'joint_states'))
    generator = np.random.default_rng(6)
    sent = dict.fromkeys(callbacks, 0)
    for index in range(hostile_count):
        target = targets[generator.integers(len(targets))]
        data = serialize(target.type_name, hostile_message(generator, target))
        callbacks[target.name](damaged(generator, data))
        sent[target.name] += 1
        if index % 10 == 0:
            case.clock.now += 0.04
            case.robot.tick_when_due()
            tick, messages = case.ticks.pop()
            data = next(data for each, data in messages if each.name == 'joint_states')
            assert np.isfinite(joint_states.decode(data)[1]).all()
            assert np.isfinite(tick.desired_goal).all()
            assert np.isfinite(tick.achieved_goal).all()
    buffer, counters = case.robot.buffer, case.robot.counters
    commands = sent['commands'] + sent.get('joint_commands', 0)
    assert buffer.accepted + buffer.rejected.total() == commands
    assert counters.goals_set + counters.goals_rejected == sent['set_goal']
    assert len(lines) >= buffer.rejected.total() + counters.goals_rejected
    assert buffer.rejected['unreadable'] > 0
    assert min(buffer.accepted, buffer.rejected.total(), counters.goals_rejected) > 0
    assert max(len(line) for line in lines) < 1000
    assert all('\n' not in line for line in lines)
    assert case.robot.runner.simulation.divergences == 0


def test_status_without_pairs_is_harmless():
    assert decode_status(SimpleNamespace(status=[])) == {}
