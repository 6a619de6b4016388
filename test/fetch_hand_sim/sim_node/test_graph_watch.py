"""Publishers of a robot's inputs, as the graph shows them."""

from __future__ import annotations

from fetch_hand_sim.sim_node.graph_watch import Endpoint, InputWatch


def endpoint(node, name='/commands', type_name='T', reliable=True, gid=None):
    return Endpoint(node, name, type_name, reliable, gid or f'{node}{name}'.encode())


def test_new_and_competing_commanders_are_reported():
    watch = InputWatch(
        {'/commands': 'T', '/joint_commands': 'J', '/set_goal': 'G'},
        ['/commands', '/joint_commands'],
    )
    assert not watch.update([endpoint('/goals', '/set_goal', 'G')], 0.0)
    a, b = endpoint('/a'), endpoint('/a', '/joint_commands', 'J')
    assert watch.update([a, b], 1.0)
    assert not watch.update([a, b], 2.0)
    assert (watch.commanders, watch.problems()) == (['/a'], [])
    assert watch.update([a, endpoint('/b')], 3.0)
    assert watch.problems() == ['2 publish commands: /a, /b']
    watch.update([], 4.0)
    assert watch.update([endpoint('/a', gid=b'again')], 5.0)


def test_a_restarted_commander_is_one_and_two_of_a_name_are_two():
    """The graph shows a killed process for 20 s."""
    watch = InputWatch({'/commands': 'T'}, ['/commands'])
    killed, successor = endpoint('/a'), endpoint('/a', gid=b'other')
    watch.update([killed], 0.0)
    assert watch.update([killed, successor], 10.0)
    assert watch.commanders == ['/a']
    watch.update([killed, successor], 29.0)
    assert watch.problems() == []
    # Both are still there, so neither was killed.
    watch.update([killed, successor], 36.0)
    assert watch.problems() == ['2 publish commands: /a, /a']


def test_publishers_that_the_robot_cannot_receive_are_reported_with_the_reason():
    watch = InputWatch({'/commands': 'T', '/set_goal': 'G'}, ['/commands'])
    others = [endpoint('/c', '/set_goal', 'P')]
    watch.update([endpoint('/a', reliable=False), endpoint('/b', type_name='S'), *others], 0.0)
    assert watch.commanders == []
    assert watch.problems() == [
        '/commands of /a is not received: it is best effort; allowed: reliable',
        '/commands of /b is not received: its type is S; allowed: T',
        '/set_goal of /c is not received: its type is P; allowed: G',
    ]
