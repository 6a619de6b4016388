"""Late commands and `answer_wait` on a real graph."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

from fetch_hand_sim.commands.episodes_list import main as list_episodes
from fetch_hand_sim.episode_log import Episode
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.runner import FIRST_STAMP_NS
from msgs_spec.codecs import CommandCodec, answered_stamp, message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic
from support.graph import (
    POLICY_NODE,
    SIM_NODE,
    Client,
    Start,
    client,
    end,
    episodes_in,
    logged_run,
    payload,
    ros_args,
)

REACH = task_spec('FetchReach')
COMMANDS = topic(REACH, 'commands')


def unanswered(episode: Episode) -> int:
    """Return the steps before which the log has no command that answers the last tick."""
    late = 0
    states = episode.topics['/joint_states'].messages
    for state, following in itertools.pairwise(states):
        came = [
            message
            for message in episode.topics['/commands'].messages
            if state.log_time_ns < message.log_time_ns < following.log_time_ns
        ]
        stamp = message_stamp(deserialize('sensor_msgs/msg/JointState', state.data))
        answered = [answered_stamp(deserialize(COMMANDS.type_name, m.data)) for m in came]
        late += answered[-1:] not in ([None], [stamp])
    return late


def answer_after(robot: Client, seconds: float, steps: int) -> float:
    """Answer one tick after the other up to this one; return the wall time that it took."""
    codec = CommandCodec(COMMANDS)
    states = robot.received['joint_states']
    first = None
    last = FIRST_STAMP_NS + steps * 40_000_000
    while not states or message_stamp(states[-1]) < last:
        count = len(states)
        robot.spin_until(lambda: len(states) > count, 'tick')  # noqa: B023
        first = first or robot.received_at['joint_states'][-1]
        robot.spin(seconds)
        stamp = message_stamp(states[count])
        robot.publish('commands', codec.encode(stamp, [0.1, 0.0, 0.0, 0.0]))
    return robot.received_at['joint_states'][-1] - first


def test_late_commands_are_in_diagnostics_in_the_file_and_in_the_list(
    start_process: Start, tmp_path: Path, capsys
) -> None:
    arguments = ros_args(wait_for_commands=True, episode_dir=tmp_path, seed=3)
    sim = start_process(*SIM_NODE, *arguments)
    with client(REACH) as robot:
        robot.subscribe('joint_states', '/diagnostics')
        robot.connect('commands')
        answer_after(robot, 0.055, 55)
        robot.spin_until(lambda: int(robot.values()['late commands']) > 5, 'report')
        text = 'late commands: not the answer to the last observation'
        assert any(text in each.message for each in robot.reports())
        # With `answer_wait`, a slow policy slows the robot instead.
        assert robot.set_parameter('sim_node', 'answer_wait', 400.0).successful
        began = robot.stamps('joint_states')[-1]
        seconds = answer_after(robot, 0.08, 95)
        simulated = (robot.stamps('joint_states')[-1] - began) / 1e9
        assert 1.5 < simulated < 0.6 * seconds
    output = end(sim)
    episode, cut = episodes_in(tmp_path)
    shutil.rmtree(cut.path.parent)
    late = episode.outcome.late_commands
    assert late is not None and 45 < late == unanswered(episode)
    assert f'success, {late} late commands' in output or f'failure, {late} late' in output
    assert f'late_commands: "{late}"' in (episode.path.parent / 'metadata.yaml').read_text()
    assert check_episode(episode.path).difference is None
    assert list_episodes([str(tmp_path)]) == 0
    header, row, *_ = capsys.readouterr().out.splitlines()
    assert header.endswith('late commands') and row.split()[-1] == str(late)
    assert list_episodes([str(tmp_path), '--json']) == 0
    assert json.loads(capsys.readouterr().out)[0]['late_commands'] == late


def test_with_answer_wait_real_time_equals_lockstep(start_process: Start, tmp_path: Path) -> None:
    policy = start_process(*POLICY_NODE)

    def played(name: str, **parameters: object) -> tuple[list[object], list[int | None]]:
        """Return the published messages of two episodes, and their late commands."""
        episodes = logged_run(start_process, tmp_path / name, episodes=2, seed=5, **parameters)
        assert [each.result['success'] for each in episodes] == ['true', 'true']
        assert all(len(each.metadata['checkpoint_sha256']) == 64 for each in episodes)
        # The answer to the last tick of an episode may come in the next one, where it is late.
        messages = [payload(each) for each in episodes]
        for each in messages:
            del each['/commands']
        return list(messages), [each.outcome.late_commands for each in episodes]

    expected, late = played('lockstep')
    assert late == [None, None]
    for attempt in range(3):
        paced, late = played(
            str(attempt), mode='realtime', real_time_factor=20.0, answer_wait=1000.0
        )
        # A very busy machine may stop a policy for a second.
        if late == [0, 0]:
            break
    end(policy)
    assert late == [0, 0]
    assert paced == expected
