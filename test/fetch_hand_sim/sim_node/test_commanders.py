"""Who commands a robot, as the graph tells it."""

from __future__ import annotations

from fetch_hand_sim.sim_node.commanders import CommanderWatch, Endpoint


def endpoint(node, name='/commands', type_name='T', reliable=True, gid=None):
    return Endpoint(node, name, type_name, reliable, gid or f'{node}{name}'.encode())


def test_newcomers_and_rivals_are_named():
    watch = CommanderWatch({'/commands': 'T', '/joint_commands': 'J'})
    assert not watch.update([], 0.0)
    a, b = endpoint('/a'), endpoint('/a', '/joint_commands', 'J')
    assert watch.update([a, b], 1.0)
    assert not watch.update([a, b], 2.0)
    assert (watch.names, watch.problems()) == (['/a'], [])
    assert watch.update([a, endpoint('/b')], 3.0)
    assert watch.problems() == ['2 publish commands: /a, /b']
    watch.update([], 4.0)
    assert watch.update([endpoint('/a', gid=b'again')], 5.0)


def test_a_restarted_commander_is_one_and_two_of_a_name_are_two():
    """The graph remembers a killed process for 20 s."""
    watch = CommanderWatch({'/commands': 'T'})
    killed, successor = endpoint('/a'), endpoint('/a', gid=b'other')
    watch.update([killed], 0.0)
    assert watch.update([killed, successor], 10.0)
    assert watch.names == ['/a']
    watch.update([killed, successor], 29.0)
    assert watch.problems() == []
    # Still both there: it never was killed.
    watch.update([killed, successor], 36.0)
    assert watch.problems() == ['2 publish commands: /a, /a']


def test_commanders_nobody_can_hear_are_named_with_the_reason():
    watch = CommanderWatch({'/commands': 'T'})
    watch.update([endpoint('/a', reliable=False), endpoint('/b', type_name='S')], 0.0)
    assert watch.names == []
    assert watch.problems() == [
        '/commands of /a is not received: it is best effort; offer reliable',
        '/commands of /b is not received: its type is S',
    ]
