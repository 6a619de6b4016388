"""Joining the messages of a tick in any order, with losses."""

from __future__ import annotations

import itertools

import numpy as np

from fetch_hand_sim.watch.tick_assembly import TickAssembly

STAMPED = ('joint_states', 'desired_goal', 'achieved_goal')
NAMES = (*STAMPED, 'is_success', 'reward', 'applied_command')


def run(messages):
    """Returns {stamp: {name: value}}. A message is (name, stamp), and its value is the stamp."""
    assembly, ended = TickAssembly(NAMES), []
    for name, tick in messages:
        ended += assembly.add(name, tick if name in STAMPED else 0, np.array([tick]))
    ended += assembly.flush()
    ticks = [(stamp, {name: int(v[0]) for name, v in values.items()}) for stamp, values in ended]
    assert [stamp for stamp, _ in ticks] == sorted({stamp for stamp, _ in ticks})
    return dict(ticks)


def whole(tick):
    return dict.fromkeys(NAMES, tick)


def test_a_tick_is_complete_in_any_order_of_its_messages():
    for order in itertools.permutations(NAMES):
        ticks = run([(name, tick) for tick in (0, 40, 80) for name in order])
        assert ticks == {tick: whole(tick) for tick in (0, 40, 80)}, order


def test_the_joints_of_a_tick_may_come_after_the_next_tick_has_begun():
    late = [(name, 40) for name in NAMES[1:]]
    ticks = run([*late, ('desired_goal', 80), ('joint_states', 40), ('joint_states', 80)])
    assert ticks[40] == whole(40)


def test_a_lost_message_spoils_no_other_tick():
    for lost in NAMES:
        sent = [(n, tick) for tick in (40, 80, 120) for n in NAMES if (n, tick) != (lost, 80)]
        ticks = run(sent)
        assert ticks[40] == whole(40) and ticks[120] == whole(120)
        assert (80 in ticks) == (lost not in STAMPED)
        assert ticks.get(80, {}).get(lost) is None


def test_ticks_without_reward_and_command_are_those_of_resets():
    names = [name for name in NAMES if name not in ('reward', 'applied_command')]
    ticks = run([(name, tick) for tick in (40, 80, 120, 160) for name in names])
    assert ticks == {tick: dict.fromkeys(names, tick) for tick in (40, 80, 120, 160)}


def test_a_repeated_tick_ends_again():
    """A robot repeats its last tick for new subscribers."""
    assembly = TickAssembly(NAMES)
    for _ in range(2):
        ended = [assembly.add(name, 40, np.zeros(1)) for name in NAMES]
        assert [len(each) for each in ended] == [0, 0, 0, 0, 0, 1]


def test_messages_that_come_twice_lose_no_tick():
    ticks = run([(name, tick) for tick in (0, 40, 80) for name in NAMES for _ in range(2)])
    assert [ticks[tick]['joint_states'] for tick in (0, 40, 80)] == [0, 40, 80]
