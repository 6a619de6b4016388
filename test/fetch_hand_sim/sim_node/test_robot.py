"""A robot without ROS: when it ticks and what it answers."""

from __future__ import annotations

import math

import pytest

from fetch_hand_sim.sim_node.robot import Answer
from msgs_spec.topics import MAX_STEPS


def test_lockstep_takes_one_tick_per_valid_command_and_none_by_itself(make):
    case = make('lockstep')
    assert case.robot.last_messages == []
    assert case.robot.wait() == 0.0  # the first reset
    case.robot.tick_when_due()
    case.clock.now += 1000.0
    with pytest.raises(ValueError, match='3 values given; allowed: 4'):
        case.robot.buffer.accept([0.0] * 3)
    for tick in range(3):
        assert (case.robot.wait(), case.place) == (math.inf, (0, tick))
        case.command()
        assert case.robot.wait() == 0.0
        case.robot.tick_when_due()
    assert (case.robot.wait(), case.place) == (math.inf, (0, 3))
    assert case.robot.last_messages == case.ticks[-1][1]


def test_lockstep_steps_when_asked_and_realtime_only_while_paused(make):
    case = make('lockstep')
    case.robot.tick()
    assert case.robot.step().success
    assert case.place == (0, 1)
    case = make('realtime')
    case.robot.tick()
    answer = case.robot.step()
    assert not answer.success and 'pause it first' in answer.message
    assert len(case.ticks) == 1
    case.robot.pause(True)
    assert case.robot.wait() == math.inf
    assert case.robot.step(3) == Answer(True, '3 run, now at 1.120 s')
    assert len(case.ticks) == 4


def test_a_step_refuses_counts_that_would_block_and_ends_with_the_last_episode(make):
    case = make('lockstep', episodes=1)
    for count in (0, -1, MAX_STEPS + 1, 2**64 - 1):
        line = f'{count} ticks given; allowed: 1 ... {MAX_STEPS}'
        assert case.robot.step(count) == Answer(False, line)
    assert case.ticks == []
    line = 'all episodes are done; 51 of 60 ticks ran'
    assert case.robot.step(60) == Answer(False, line)


def test_a_running_robot_answers_and_resets_at_the_next_tick(make):
    case, end = make(), '; commands and goals count from then on'
    no_episode = 'no episode is running; the next tick starts episode 0 with seed 0'
    assert case.robot.reset().message == no_episode + end
    case.robot.tick()
    first_ends = 'episode 0 ends; the next tick starts episode 1 with seed 1'
    assert case.robot.reset().message == first_ends + end
    case.robot.tick()
    assert (case.place, case.last.status.phase) == ((1, 0), 'reset')
    assert case.robot.counters.ended_early == 1
    case = make('lockstep', episodes=1)
    case.robot.tick()
    assert case.robot.reset().message == 'episode 0 ends; it was the last'
    assert case.robot.wait() == math.inf


@pytest.mark.parametrize('mode', ['realtime', 'lockstep'])
@pytest.mark.parametrize('between_episodes', [False, True])
def test_a_paused_robot_publishes_the_state_after_a_reset_at_once(make, mode, between_episodes):
    case = make(mode)
    case.robot.tick()
    while between_episodes and not case.robot.runner.is_between_episodes:
        case.robot.tick()
    case.robot.pause(True)
    assert case.robot.wait() == math.inf
    assert 'a tick of its own starts episode 1 with seed 1' in case.robot.reset().message
    assert case.robot.wait() == 0.0
    case.robot.tick_when_due()
    assert (case.robot.wait(), case.place) == (math.inf, (1, 0))


def test_a_robot_in_lockstep_waits_with_a_reset_for_the_command_that_is_on_its_way(make):
    """It answers the tick before; counted for the one after, its commander would lag behind."""
    case = make('lockstep')
    case.robot.tick_when_due()
    case.clock.now += 0.05
    assert case.robot.reset().success
    assert 0.0 < case.robot.wait() <= 0.2
    case.command()
    assert case.robot.wait() == 0.0
    case.robot.tick_when_due()
    assert (case.robot.wait(), case.place) == (math.inf, (1, 0))
    # A policy would have answered by now.
    case.clock.now += 10.0
    assert case.robot.reset().success
    assert case.robot.wait() == 0.0
    case.robot.tick_when_due()
    assert case.place == (2, 0)


@pytest.mark.parametrize('factor', [0.0, 1.0, 20.0])
def test_commands_that_stop_are_missed_in_any_mode(make, factor):
    case = make(factor=factor)
    for _ in range(3):
        case.tick_after(2.0)
        assert not case.robot.misses_commands, 'no command came yet'
    case.command()
    case.clock.now += 0.9
    assert not case.robot.misses_commands
    case.clock.now += 0.2
    assert case.robot.misses_commands
    while not case.robot.runner.is_between_episodes:
        case.robot.tick_when_due()
    case.robot.tick_when_due()
    assert case.robot.misses_commands, 'the next episode misses them too'
    case.command()
    assert not case.robot.misses_commands
    case.clock.now += 0.9
    case.robot.pause(True)
    case.clock.now += 5.0
    assert not case.robot.misses_commands
    case.robot.pause(False)
    assert not case.robot.misses_commands
    case.clock.now += 1.1
    assert case.robot.misses_commands
    for paused in (True, False):
        case.robot.pause(paused)
    assert case.robot.misses_commands, 'they had stopped before the pause'
    case = make('lockstep')
    assert not case.robot.misses_commands
    case.robot.tick_when_due()
    case.clock.now += 1.1
    assert case.robot.misses_commands


def test_paused_time_is_not_made_up_for(make):
    case = make()
    case.robot.tick_when_due()
    case.robot.pause(True)
    case.clock.now += 60.0
    assert case.robot.pause(False).message == 'running at 1.000 s'
    assert case.robot.pause(False).message == 'already running'
    case.robot.tick_when_due()
    assert case.robot.wait() == pytest.approx(0.04)
    assert case.robot.schedule.missed_ticks == 0


def test_late_ticks_are_counted_and_never_accumulate(make):
    case = make()
    for late in (0.0, 0.13, 0.0, 0.07):
        case.tick_after(case.robot.wait() + late)
    assert case.robot.schedule.missed_ticks == 3 + 1
    # The next tick stays on the old grid, less than a period from now.
    assert 0.0 < case.robot.wait() <= 0.04
    assert math.remainder(case.clock.now + case.robot.wait() - 100.0, 0.04) == pytest.approx(0.0)


@pytest.mark.parametrize('factor', [0.1, 1.0, 3.0, 20.0])
def test_real_time_factor_changes_while_running(make, factor):
    case = make()
    case.robot.tick_when_due()
    case.robot.set_real_time_factor(factor)
    for _ in range(2):
        assert case.robot.wait() == pytest.approx(0.04 / factor)
        case.tick_after(case.robot.wait())
    assert case.robot.schedule.missed_ticks == 0
    case.robot.set_real_time_factor(0.0)
    assert case.robot.wait() == 0.0


@pytest.mark.parametrize(
    'meddle',
    [
        lambda robot: robot.set_real_time_factor(0.08),
        lambda robot: (robot.pause(True), robot.pause(False)),
    ],
)
def test_requests_do_not_make_a_robot_tick_faster(make, meddle):
    case = make(factor=0.08)
    for _ in range(32):
        if case.robot.wait() <= 0.0:
            case.robot.tick_when_due()
        case.clock.now += 0.125
        meddle(case.robot)
    # 4 s at 2 ticks per second.
    assert len(case.ticks) == 8


def run(case, delays):
    """Answer each tick after a delay, s, or never (None); return the wall time of each step."""
    case.robot.tick_when_due()
    began = []
    for delay in delays:
        published = case.clock.now
        while case.robot.wait() > 0.0:
            answer = math.inf if delay is None else published + delay
            left = answer - case.clock.now
            if 0.0 < left <= case.robot.wait():
                case.clock.now = answer
                case.command()
            else:
                case.clock.now += case.robot.wait()
        case.robot.tick_when_due()
        began.append(round(case.clock.now - 100.0, 3))
    return began


def test_steps_without_a_new_command_are_counted_as_late(make):
    case = make()
    assert run(case, [0.01, None, 0.01, None, None]) == [0.04, 0.08, 0.12, 0.16, 0.2]
    assert [tick.late_commands for tick, _ in case.ticks] == [0, 0, 1, 1, 2, 3]
    assert case.robot.counters.late_commands == 3
    case.robot.reset()
    case.robot.tick_when_due()
    assert case.last.late_commands == 0, 'each episode has a count of its own'
    assert case.robot.counters.late_commands == 3


def test_no_command_is_late_before_the_first_and_after_the_last_and_none_in_lockstep(make):
    case = make()
    run(case, [None] * 3)
    assert case.robot.counters.late_commands == 0
    run(case, [0.01, *[None] * 30])
    # After a second of silence no policy commands.
    assert 23 <= case.robot.counters.late_commands <= 25
    case = make('lockstep', answer_wait=1.0)
    case.robot.tick_when_due()
    case.command()
    case.robot.tick_when_due()
    case.robot.step()
    assert [tick.late_commands for tick, _ in case.ticks] == [None] * 3
    assert case.robot.counters.late_commands == 0


def test_a_tick_waits_for_its_answer_and_the_deadlines_move_with_it(make):
    case = make(answer_wait=0.02)
    # In time, 15 ms late, in time, never, in time.
    began = run(case, [0.01, 0.055, 0.01, None, 0.01])
    assert began == [0.04, 0.095, 0.135, 0.195, 0.235]
    assert case.robot.counters.late_commands == 1
    assert case.robot.schedule.missed_ticks == 0


def test_no_tick_waits_where_no_policy_commands(make):
    assert run(make(answer_wait=0.02), [None] * 3) == [0.04, 0.08, 0.12]
    case = make(answer_wait=0.02)
    case.robot.has_commander = True
    assert run(case, [None] * 3) == [0.06, 0.12, 0.18], 'the robot has waited for a policy'
    assert case.robot.counters.late_commands == 3


@pytest.mark.parametrize('answer_wait', [0.0, 0.1])
def test_a_robot_as_fast_as_possible_waits_only_with_answer_wait(make, answer_wait):
    case = make(factor=0.0, answer_wait=answer_wait)
    case.command()
    case.robot.tick_when_due()
    assert case.robot.wait() == pytest.approx(answer_wait)
    case.command()
    assert case.robot.wait() == 0.0


def test_a_command_that_answers_an_older_observation_is_late(make):
    case = make(answer_wait=0.02)
    case.command()
    case.robot.tick_when_due()
    older = case.robot.runner.stamp_ns
    for value, wait, late in ((0.1, 0.04, 0), (0.2, 0.06, 1)):
        case.command(value, older)
        assert case.robot.wait() == pytest.approx(wait)
        case.tick_after(case.robot.wait())
        assert case.robot.counters.late_commands == late
    assert case.last.applied_command.tolist() == [0.2] * 4
