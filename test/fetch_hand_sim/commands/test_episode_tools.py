"""Episodes listed, recovered, checked, loaded, generated and taught from."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from fetch_hand_sim.commands import episodes_check, episodes_list, episodes_recover
from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeLogError,
    EpisodeReadError,
    EpisodeWriter,
    expand_episodes,
    find_episodes,
    find_leftovers,
    load_episodes,
    read_episode,
    read_summary,
    recover_episode,
)
from fetch_hand_sim.episode_log.files import mcap_file
from fetch_hand_sim.episode_log.metadata import parse_task
from fetch_hand_sim.episode_log.reader import split_ticks
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.generator import EpisodeGenerator
from fetch_hand_sim.episodes.recorder import RecordingContext, former_model_sha256, model_sha256
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec
from msgs_spec.robots import action_from_command
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.topics import topic
from policy_node.policies.policy import RandomPolicy
from policy_node.training import generate_episodes
from policy_node.training.experience.episode_files import read_experience
from support.episode_recorder import Recorder, rested_episode

# One of each kind of goal and robot.
FAMILIES = ('FetchReach', 'FetchPickAndPlace', 'HandReach', 'HandManipulatePenFull')


def generate(directory, task, episodes, num_envs=3, **options):
    """Writes episodes under random actions; returns their directories."""
    simulation = Simulation(task, num_envs=num_envs, num_threads=1, **options)
    policy = RandomPolicy(simulation.spec.robot.action_size)
    context = RecordingContext(simulation, with_compiled_model=False)
    generator = EpisodeGenerator(
        simulation, directory, lambda observation: policy.predict(observation)[0], context
    )
    return [logged.path for logged in generator.generate(episodes, first_seed=11)]


@pytest.fixture(scope='module', params=FAMILIES)
def generated(request, tmp_path_factory):
    """A task and its generated episodes: two batches, the second not full."""
    directory = tmp_path_factory.mktemp(request.param)
    return request.param, generate(directory, request.param, episodes=4)


@pytest.fixture(scope='module')
def reach(tmp_path_factory):
    """A directory of three complete FetchReach episodes."""
    directory = tmp_path_factory.mktemp('reach')
    generate(directory, 'FetchReach', episodes=3)
    return directory


def copy_of(episodes, tmp_path):
    directory = tmp_path / 'copy'
    shutil.copytree(episodes, directory)
    return directory


def rewrite(source, directory, change=lambda tick, name, data: data, last=None, **metadata):
    """Write an episode again with changed messages; `change` returns None to leave one out."""
    episode = read_episode(source)
    writer = EpisodeWriter(directory, source.name, {**episode.metadata, **metadata})
    for number, tick in enumerate(split_ticks(episode)[:last]):
        changed = [(m.topic, change(number, m.topic.name, m.data)) for m in tick.published]
        writer.write_tick(tick.stamp_ns, [(t, data) for t, data in changed if data is not None])
        for message in tick.received:
            writer.write_received(message.topic, message.data)
    kept = {k: v for k, v in episode.result.items() if k not in ('complete', 'reason')}
    if last is None:
        return writer.finish(kept)
    return writer.finish({'steps': str(last - 1)}, 'test')


def finish_short(writer, result, reason=None):
    """Finish an episode of a single message."""
    spec = topic(task_spec('FetchReach'), '/clock')
    writer.write_tick(1, [(spec, TopicCodec(spec).encode(0, []))])
    return writer.finish(result, reason)


# fetch_hand_sim episodes generate and fetch_hand_sim episodes check


def test_generated_episodes_equal_those_of_one_robot(generated):
    """Batch and single robot, bit for bit, with number, seed and stamps of a series."""
    task, paths = generated
    for index, path in enumerate(paths):
        result = check_episode(path)
        assert result.difference is None, result
        assert result.changed == []
        assert result.ticks == TASKS[task].episode_ticks + 1
        metadata = read_episode(path).metadata
        assert (metadata['episode'], metadata['seed']) == (str(index), str(11 + index))
        assert path.name == f'{task}_{index:06d}_seed{11 + index}'


@pytest.mark.parametrize(('timing', 'ticks'), [('seconds', 250), ('ticks', 50)])
def test_episodes_of_other_rates_rewards_and_rules_check_and_load(timing, ticks, tmp_path):
    rules = {'reward_type': 'dense', 'success_rule': 'paper', 'timing': timing}
    (path,) = generate(tmp_path, 'FetchPush', episodes=1, control_hz=125.0, **rules)
    result = check_episode(path)
    assert (result.difference, result.changed, result.ticks) == (None, [], ticks + 1)
    recorded = read_summary(path).metadata
    assert recorded.get('timing', 'ticks') == timing
    assert recorded['episode_ticks'] == str(ticks)
    (arrays,) = load_episodes(path)
    assert arrays.spec == replace(TASKS['FetchPush'], episode_ticks=ticks)
    assert len(arrays) == ticks


def flip(target, at_tick, byte):
    """Changes one bit of the messages of a topic at one tick."""

    def change(tick, name, data):
        if (tick, name) != (at_tick, target):
            return data
        damaged = bytearray(data)
        damaged[byte] ^= 1
        return bytes(damaged)

    return change


def without(target, at_tick):
    """Leaves out the message of a topic at one tick."""
    return lambda tick, name, data: None if (tick, name) == (at_tick, target) else data


# Bytes of velocity, effort and their lengths, which follow the positions.
AFTER_POSITIONS = 2 * (8 * len(task_spec('FetchReach').robot.joints) + 8)


@pytest.mark.parametrize(
    ('change', 'tick', 'field'),
    [
        (flip('joint_states', 7, -AFTER_POSITIONS - 8), 7, 'joint_states.position[14]'),
        (without('joint_states', 3), 3, 'topic of message 1'),
        (flip('episode_status', 0, -8), 0, 'episode_status'),
    ],
)
def test_check_names_the_first_tick_and_field_that_differ(reach, tmp_path, change, tick, field):
    difference = check_episode(rewrite(min(reach.iterdir()), tmp_path, change)).difference
    assert difference is not None
    assert difference.tick == tick and difference.field.startswith(field)
    assert difference.recorded != difference.simulated
    assert 'np.' not in str(difference)


def test_check_compares_applied_commands_with_received_ones(tmp_path):
    """The physics of FetchReach ignores the gripper, the last value."""
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    assert check_episode(path).difference is None
    changed = rewrite(path, tmp_path / 'changed', flip('applied_command', 20, -3))
    difference = check_episode(changed).difference
    assert difference is not None
    assert (difference.tick, difference.field) == (20, 'applied_command')


def test_check_names_the_version_that_changed(reach, tmp_path):
    revision = f'{"12e4567" * 6}-dirty'
    changes = {'mujoco_version': '3.9.0', 'source_revision': revision}
    result = check_episode(rewrite(min(reach.iterdir()), tmp_path, **changes))
    changed = sorted(change.split()[:2] for change in result.changed)
    assert changed == [['mujoco', '3.9.0'], ['source_revision', '12e456712e45-dirty']]


def test_check_runs_goals_that_were_set_on_the_way(tmp_path):
    recorder = Recorder('HandManipulateBlockFull')
    goal_topic = topic(recorder.spec, 'set_goal')
    encoder = TopicCodec(goal_topic)
    directory = EpisodeDirectory(tmp_path)
    writer = directory.begin(recorder.spec.name, 0, recorder.metadata())
    for number, (tick, messages) in enumerate(rested_episode(recorder.runner)):
        writer.write_tick(tick.stamp_ns, messages)
        if number == 30:
            # Neither of unit length nor in the hemisphere of the object.
            goal = np.array([1.0, 0.87, 0.2, -0.5, 0.5, 0.5, 0.2])
            writer.write_received(goal_topic, encoder.encode(tick.stamp_ns, goal))
            recorder.runner.simulation.set_goal(goal[None])
    path = writer.finish({})
    assert check_episode(path).difference is None
    (arrays,) = load_episodes(path)
    assert len(np.unique(arrays.goals, axis=0)) == 2


def test_check_of_an_episode_at_the_end_of_ros_time_is_one_line(tmp_path):
    recorder = Recorder('FetchReach')
    first = 2**31 * 10**9 - 5 * 40_000_000
    recorder.runner = EpisodeRunner(recorder.simulation, first_stamp_ns=first)
    writer = EpisodeDirectory(tmp_path).begin(recorder.spec.name, 0, recorder.metadata())
    for tick, messages in islice(rested_episode(recorder.runner), 5):
        writer.write_tick(tick.stamp_ns, messages)
    # A sixth tick, whose stamp would not fit into a message.
    writer.write_tick(tick.stamp_ns + 10**6, messages)
    path = writer.finish({}, 'cut')
    with pytest.raises(EpisodeReadError, match=r'simulated again \(stamp of 2147483648 s; allowed'):
        check_episode(path)


def test_the_fingerprint_of_a_log_of_1_0_is_known_too(tmp_path, monkeypatch):
    monkeypatch.setattr('support.episode_recorder.model_sha256', former_model_sha256)
    recorder = Recorder('FetchReach')
    path = recorder.record(EpisodeDirectory(tmp_path))
    recorded = read_episode(path).metadata['model_sha256']
    assert recorded != model_sha256(recorder.simulation.model)
    assert not [line for line in check_episode(path).changed if 'model' in line]


def test_check_episode_codes(reach, tmp_path, capsys):
    assert episodes_check.main([str(reach)]) == 0
    assert capsys.readouterr().out.count('identical, 51 ticks') == 3
    changed = rewrite(min(reach.iterdir()), tmp_path, flip('reward', 5, -1))
    assert episodes_check.main([str(changed), str(reach)]) == 1
    assert 'differs at tick 5 (1.200 s), reward.data' in capsys.readouterr().out
    (tmp_path / 'empty').mkdir()
    assert episodes_check.main([str(tmp_path / 'empty')]) == 2
    assert all(len(line) < 300 for line in capsys.readouterr().err.splitlines())


# load_episodes


def test_loaded_observations_equal_those_of_the_simulation(generated):
    task, paths = generated
    # The second robot of the first batch, and the only one of the second batch.
    for arrays in load_episodes(paths[0].parent)[1::2]:
        spec, steps = arrays.spec, TASKS[task].episode_ticks
        simulation = Simulation(task, num_threads=1)
        observation = simulation.reset(seed=int(arrays.metadata['seed']))
        for k in range(steps + 1):
            for key, values in observation.items():
                assert arrays.observations[key][k].tobytes() == values[0].tobytes(), (k, key)
            if k < steps:
                result = simulation.step_commands(arrays.commands[k][None])
                observation = result.observation
                assert arrays.rewards[k] == result.reward[0]
                assert arrays.success[k + 1] == result.success[0]
        assert len(arrays) == steps and arrays.is_complete
        assert arrays.observations['observation'].shape == (steps + 1, spec.observation_size)
        assert not arrays.terminated.any()
        assert arrays.truncated.tolist() == [False] * (steps - 1) + [True]
        np.testing.assert_array_equal(
            arrays.actions, action_from_command(spec.robot, arrays.commands)
        )


def test_interrupted_episodes_load_as_far_as_they_go(reach, tmp_path):
    path = rewrite(min(reach.iterdir()), tmp_path, last=20)
    (cut,), (whole,) = load_episodes(path), load_episodes(min(reach.iterdir()))
    assert len(cut) == 19 and not cut.is_complete and cut.truncated[-1]
    np.testing.assert_array_equal(cut.commands, whole.commands[:19])
    assert cut.goals.shape == (20, 3)


@pytest.mark.parametrize(
    'change',
    [
        without('reward', 9),
        without('joint_states', 9),
        flip('desired_goal', 9, 8),
    ],
)
def test_a_hole_in_an_episode_is_an_error(reach, tmp_path, change):
    path = rewrite(min(reach.iterdir()), tmp_path, change)
    with pytest.raises(EpisodeReadError, match=r'stamps|missing|allowed|steps') as caught:
        load_episodes(path)
    assert str(path) in str(caught.value)


def test_one_bad_file_does_not_hide_the_others(reach, tmp_path):
    directory = copy_of(reach, tmp_path)
    (directory / 'text.mcap').write_text('no bag')
    with pytest.raises(EpisodeReadError, match=r'text\.mcap'):
        load_episodes(directory)
    skipped = []
    assert len(load_episodes(directory, on_skip=skipped.append)) == 3
    assert len(skipped) == 1


# fetch_hand_sim episodes list and fetch_hand_sim episodes recover


def test_list_shows_the_metadata_of_the_files(reach, capsys):
    assert episodes_list.main([str(reach)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    for index, line in enumerate(lines[1:4]):
        summary = read_summary(reach / f'FetchReach_{index:06d}_seed{11 + index}')
        words = line.split()
        assert words[:4] == [summary.path.parent.name, 'FetchReach', str(11 + index), '50']
        assert float(words[4]) == float(summary.result['return'])
        assert words[5:7] == ['no', '2.00'] and words[8] == 'complete'
    assert lines[-1] == '3 episodes, 0 successes; 0 filtered'


def test_list_takes_one_file_or_bag_like_the_other_commands(reach, tmp_path, capsys):
    bag = min(reach.iterdir())
    for path in (bag, mcap_file(bag)):
        assert episodes_list.main([str(path)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[1].split()[0] == bag.name
        assert lines[-1] == '1 episode, 0 successes; 0 filtered'
    # A bag of another storage is no empty folder of episodes.
    (tmp_path / 'metadata.yaml').touch()
    assert episodes_list.main([str(tmp_path)]) == 1
    assert f'skipped {tmp_path} holds 0 MCAP files' in capsys.readouterr().err


def test_list_calls_episodes_as_their_folders_and_names_those_below(
    reach, tmp_path, capsys, monkeypatch
):
    name = f'FetchReach_{0:06d}_seed11'
    for copy in ('kept', 'kept too'):
        shutil.copytree(reach / name, tmp_path / 'day 1' / copy)
    assert episodes_list.main([str(tmp_path / 'day 1')]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split('  ')[0] for line in lines[1:3]] == ['kept', 'kept too']
    assert episodes_list.main([str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f'episodes are in {tmp_path / "day 1"}'
    monkeypatch.chdir(tmp_path / 'day 1' / 'kept')
    assert episodes_list.main(['.']) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith('kept ')
    cut = cut_off(reach / name, tmp_path, 2000)
    monkeypatch.chdir(cut)
    assert episodes_list.main(['.']) == 1
    assert f'`fetch_hand_sim episodes recover {tmp_path}` ends it' in capsys.readouterr().err


def test_a_narrow_terminal_wraps_names_and_numbers_instead_of_cutting_them(
    reach, monkeypatch, capsys
):
    monkeypatch.setenv('COLUMNS', '40')
    assert episodes_list.main([str(reach)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:-1]] == sorted(
        path.name for path in reach.iterdir()
    )
    assert not any('…' in line for line in lines)


def test_a_leftover_beside_its_finished_episode_is_called_a_copy(reach, tmp_path, capsys):
    source = sorted(reach.iterdir())[0]
    shutil.copytree(source, tmp_path / source.name)
    cut_off(source, tmp_path, 60_000)
    assert episodes_recover.main([str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert f'if .{source.name}.active is an older copy of it, remove that' in error


def test_tasks_of_long_names_are_read_as_they_were_written(monkeypatch):
    name = 'FetchReachAroundObstaclesWithAVeryLongName'
    monkeypatch.setitem(TASKS, name, replace(TASKS['FetchReach'], name=name))
    assert parse_task({'task': name}).name == name
    with pytest.raises(ValueError, match=f"unknown task '{name[:40]}'"):
        parse_task({'task': f'{name}s'})


def test_list_filters(reach, tmp_path, capsys):
    directory = copy_of(reach, tmp_path)
    for name, task, result, reason in (
        ('x0', 'FetchPush', {'success': 'true', 'steps': '1', 'return': '-1.0'}, None),
        ('x1', 'FetchReach', {'success': 'false'}, 'the reason'),
        # Killed and recovered: its success is unknown.
        ('x2', 'HandReach', {}, 'killed'),
        ('x3', 'HandReach', {'success': 'true', 'steps': '1', 'return': '-1.0'}, 'SIGINT'),
    ):
        writer = EpisodeWriter(directory, name, {'task': task, 'seed': '1'})
        finish_short(writer, result, reason)

    reach_names = [path.name for path in sorted(reach.iterdir())]
    for options, expected in (
        ('--task HandReach', ['x2', 'x3']),
        ('--task HandReach --failure', []),
        ('--task HandReach --success', ['x3']),
        ('', [*reach_names, 'x0', 'x1', 'x2', 'x3']),
        ('--task FetchPush', ['x0']),
        ('--success', ['x0', 'x3']),
        ('--failure', [*reach_names, 'x1']),
        ('--complete', [*reach_names, 'x0']),
        ('--no-complete', ['x1', 'x2', 'x3']),
        ('--complete --failure --task FetchReach', reach_names),
    ):
        assert episodes_list.main([str(directory), *options.split()]) == 0
        table = capsys.readouterr().out.splitlines()[1:-1]
        assert [line.split()[0] for line in table] == expected, options
    assert episodes_list.main([str(directory)]) == 0
    assert capsys.readouterr().out.endswith('7 episodes (3 interrupted), 1 success; 0 filtered\n')


def test_list_shows_no_control_characters_and_no_long_values_of_a_file(tmp_path, capsys):
    writer = EpisodeWriter(tmp_path, 'x', {'task': '\x1b]0;owned\x07[red]1[/red]', 'seed': '\x1b'})
    finish_short(writer, {'success': '\x9b', 'return': 'nan', 'steps': '\n'})
    writer = EpisodeWriter(tmp_path, 'long', {'task': 'y' * 400, 'seed': '1' * 400})
    finish_short(writer, {}, 'z' * 400)
    assert episodes_list.main([str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert '[red]1[/red]' in output and {'x', 'long'} <= set(output.split())
    assert output.isascii() and all(c.isprintable() or c == '\n' for c in output)


def cut_off(source: Path, directory: Path, size: int) -> Path:
    """A leftover: the file of an episode up to a size, in its hidden directory."""
    active = directory / f'.{source.name}.active'
    active.mkdir(parents=True)
    file = f'{source.name}_0.mcap'
    (active / file).write_bytes((source / file).read_bytes()[:size])
    return active


def test_recover_makes_bags_of_leftovers_and_names_failures(reach, tmp_path, capsys):
    sources = sorted(reach.iterdir())
    size = (sources[0] / f'{sources[0].name}_0.mcap').stat().st_size
    cut_off(sources[0], tmp_path, size // 2)
    cut_off(sources[1], tmp_path, 2000)
    damaged = cut_off(sources[2], tmp_path, size) / f'{sources[2].name}_0.mcap'
    damaged.write_bytes(bytes(100) + damaged.read_bytes()[100:])
    assert episodes_recover.main([str(tmp_path), '--dry-run']) == 0
    assert episodes_list.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count('complete it with fetch_hand_sim episodes recover') == 3
    assert episodes_recover.main([str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert 'marked as interrupted' in output
    lines = [line for line in output.splitlines() if 'moved to' in line]
    for line, source in zip(lines, sources[1:], strict=True):
        assert source.name in line and 'no readable message' in line
    aside = [tmp_path / f'.{source.name}.aside' for source in sources]
    assert sorted(tmp_path.iterdir()) == sorted([*aside, tmp_path / sources[0].name])
    assert 10 < check_episode(tmp_path / sources[0].name).ticks < 51
    assert episodes_recover.main([str(reach)]) == 0


# Learning


def test_logged_episodes_become_experience(generated):
    task, paths = generated
    experience, skipped = read_experience(paths[0].parent, TASKS[task])
    loaded = load_episodes(paths[0].parent)
    assert len(experience) == 4 and skipped == []
    assert experience.ticks == TASKS[task].episode_ticks
    for index, arrays in enumerate(loaded):
        pairs = (
            (experience.observation, arrays.observations['observation']),
            (experience.achieved_goal, arrays.observations['achieved_goal']),
            (experience.desired_goal, arrays.goals[0]),
            (experience.action, arrays.actions),
        )
        for given, expected in pairs:
            assert given.dtype == np.float32
            np.testing.assert_array_equal(given[index], expected.astype(np.float32))


def test_unusable_episodes_are_skipped_and_named(reach, tmp_path):
    source = min(reach.iterdir())
    rewrite(source, tmp_path / 'mixed', last=20)
    shutil.copytree(max(reach.iterdir()), tmp_path / 'mixed' / 'whole')
    (tmp_path / 'mixed' / 'text.mcap').write_text('no bag')
    generate(tmp_path / 'mixed', 'FetchPush', episodes=1)
    generate(tmp_path / 'mixed', 'FetchReach', episodes=1, control_hz=50.0)
    experience, skipped = read_experience(tmp_path / 'mixed', TASKS['FetchReach'])
    assert len(experience) == 1 and len(skipped) == 4
    reasons = ('19 of 50 steps', 'FetchPush, not FetchReach', '50.0 Hz', 'no MCAP file')
    assert [sum(reason in line for line in skipped) for reason in reasons] == [1, 1, 1, 1]
    with pytest.raises(ValueError, match='holds no usable episode of HandReach'):
        read_experience(tmp_path / 'mixed', TASKS['HandReach'])


def test_the_command_line_generates(tmp_path, capsys):
    arguments = ['--policy', 'random', '--task', 'FetchReach', '--output', str(tmp_path)]
    assert generate_episodes.main([*arguments, '--episodes', '2', '--threads', '1']) == 0
    assert '2 episodes of FetchReach' in capsys.readouterr().out
    assert episodes_list.main([str(tmp_path), '--complete']) == 0
    assert generate_episodes.main(['--policy', 'random', '--output', str(tmp_path)]) == 2
    assert 'random needs a task' in capsys.readouterr().err
    assert generate_episodes.main([*arguments, '--episodes', '3', '--threads', '1']) == 0
    assert '2 of these seeds of FetchReach; --first-seed 2' in capsys.readouterr().err
    more = ['--episodes', '1', '--threads', '1', '--first-seed', '3']
    assert generate_episodes.main([*arguments, *more]) == 0
    assert capsys.readouterr().err == ''
    with pytest.raises(SystemExit) as caught:
        generate_episodes.main([*arguments, '--episodes', '0'])
    assert caught.value.code == 2
    file = tmp_path / 'file'
    file.touch()
    assert generate_episodes.main([*arguments[:-1], str(file), '--episodes', '1']) == 1
    assert 'cannot log episode' in capsys.readouterr().err


def test_actions_of_a_policy_are_clipped_as_on_the_robot_or_nonsense(tmp_path, monkeypatch, capsys):
    (tmp_path / 'strange_policy.py').write_text(
        'import itertools\nimport numpy as np\ncalls = itertools.count()\n'
        'def strong(spec):\n    return lambda _: np.full(4, 1.5)\n'
        'def broken(spec):\n    return lambda _: np.full(4, 0.0 if next(calls) < 20 else np.nan)\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    arguments = ['--trust', '--task', 'FetchReach', '--episodes', '1', '--threads', '1']
    arguments += ['--output', str(tmp_path / 'out'), '--policy']
    assert generate_episodes.main([*arguments, 'strange_policy:strong']) == 0
    (episode,) = load_episodes(tmp_path / 'out')
    assert (episode.commands == 1.0).all()
    assert generate_episodes.main([*arguments, 'strange_policy:broken', '--first-seed', '1']) == 1
    assert 'strange_policy:broken returned [[nan' in capsys.readouterr().err


def test_loaded_episodes_have_paths_and_paths_may_be_text(reach, tmp_path):
    first, second, *_ = episodes = load_episodes(str(reach))
    assert episodes.index(second) == 1 and len({first, second, first}) == 2
    assert read_episode(str(first.path)).metadata == read_summary(str(first.path)).metadata
    assert find_episodes(str(reach)) == expand_episodes(str(reach)) == find_episodes(reach)
    assert find_leftovers(str(reach)) == []
    with pytest.raises(EpisodeLogError, match='is no unfinished episode'):
        recover_episode(str(reach))
    for writer in (
        EpisodeDirectory(str(tmp_path)).begin('FetchReach', 0, {}),
        EpisodeWriter(str(tmp_path), 'mine', {}),
    ):
        assert finish_short(writer, {}).parent == tmp_path
