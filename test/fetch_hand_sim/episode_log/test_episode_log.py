"""Finished episodes: what three independent readers find in them."""

from __future__ import annotations

import itertools
import json
import shutil
from collections import Counter

import mujoco
import numpy as np
import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, Header, SummaryOffset
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeWriter,
    files,
    read_episode,
)
from fetch_hand_sim.episode_log.bag import CHUNK_BYTES, offered_qos_text
from fetch_hand_sim.episodes.recorder import (
    compiled_attachment,
    mjcf_attachment,
    model_sha256,
)
from fetch_hand_sim.simulation.models import asset_path, compiled_bytes
from msgs_spec.codecs import decode
from msgs_spec.schemas import deserialize, schema_text, type_hash
from msgs_spec.topics import LATCHED, topics
from support.episode_recorder import Recorder

TASKS = ('FetchReach', 'HandReach', 'HandManipulateBlockRotateZ')


class Bag:
    """A finished episode and its input."""

    def __init__(self, directory, task):
        self.recorder = Recorder(task)
        self.spec = self.recorder.spec
        self.metadata = self.recorder.metadata(started='2024-11-21T12:00:00+00:00')
        self.ticks = self.recorder.ticks()
        self.directory = write_bag(self.recorder, self.ticks, directory, self.metadata)
        self.file = self.directory / f'{self.directory.name}_0.mcap'

    def written(self):
        """(log time, topic, CDR) of every message, by the rule of `log_times`."""
        messages = []
        for tick in self.ticks:
            extra = [] if tick.command is None else [(self.recorder.commands, tick.command)]
            for rank, (topic, data) in enumerate([*tick.messages, *extra]):
                messages.append((tick.stamp_ns + rank, '/' + topic.name.lstrip('/'), data))
        return messages

    def records(self):
        with self.file.open('rb') as stream:
            return list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)

    def info(self):
        return yaml.safe_load((self.directory / 'metadata.yaml').read_text())[
            'rosbag2_bagfile_information'
        ]


def write_bag(recorder, ticks, directory, metadata, attachments=()):
    writer = EpisodeWriter(directory, 'episode', metadata, attachments)
    recorder.write(writer, ticks)
    return writer.finish({'success': 'false', 'return': '-50.0'})


@pytest.fixture(scope='module', params=TASKS)
def bag(request, tmp_path_factory):
    return Bag(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope='module')
def reach(tmp_path_factory):
    return Bag(tmp_path_factory.mktemp('reach'), 'FetchReach')


def test_mcap_reads_every_message_with_its_time_and_sequence(bag):
    with bag.file.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        read = list(reader.iter_messages(log_time_order=False))
        summary = reader.get_summary()
    assert [(m.log_time, c.topic, m.data) for _, c, m in read] == bag.written()
    assert all(later.log_time > m.log_time for (_, _, m), (_, _, later) in itertools.pairwise(read))
    for topic in {channel.topic for _, channel, _ in read}:
        sequences = [m.sequence for _, channel, m in read if channel.topic == topic]
        assert sequences == list(range(len(sequences)))
    assert summary.statistics.message_count == len(read)
    assert summary.statistics.message_start_time == bag.ticks[0].stamp_ns
    assert set(summary.statistics.channel_message_counts) == set(summary.channels)
    assert all(summary.statistics.channel_message_counts.values())


def test_every_channel_says_type_quality_of_service_and_hash(bag):
    specs = {'/' + spec.name.lstrip('/'): spec for spec in topics(bag.spec)}
    with bag.file.open('rb') as stream:
        summary = make_reader(stream).get_summary()
    logged = {channel.topic for channel in summary.channels.values()}
    subscribed = {name for name, spec in specs.items() if spec.direction == 'subscribed'}
    assert logged == (set(specs) - subscribed) | {'/commands'}
    for channel in summary.channels.values():
        spec, schema = specs[channel.topic], summary.schemas[channel.schema_id]
        (profile,) = yaml.safe_load(channel.metadata['offered_qos_profiles'])
        assert channel.message_encoding == 'cdr'
        assert (schema.name, schema.encoding) == (spec.type_name, 'ros2msg')
        assert schema.data.decode() == schema_text(spec.type_name)
        assert profile['durability'] == spec.qos.durability
        assert profile['depth'] == spec.qos.depth
        assert channel.metadata['topic_type_hash'] == type_hash(spec.type_name)
    assert len({schema.name for schema in summary.schemas.values()}) == len(summary.schemas)


def test_profile_chunks_and_indexes(bag):
    records = bag.records()
    chunks = [record for record in records if isinstance(record, Chunk)]
    indexes = [record for record in records if isinstance(record, ChunkIndex)]
    assert isinstance(records[0], Header) and records[0].profile == 'ros2'
    assert all(chunk.uncompressed_crc for chunk in chunks)
    assert all(chunk.compression == 'lz4' for chunk in chunks)
    assert all(chunk.uncompressed_size < 2 * CHUNK_BYTES for chunk in chunks)
    # A flush comes with the first tick 150 ms after the one before: every fourth tick.
    assert all(c.message_end_time - c.message_start_time < 200_000_000 for c in chunks)
    duration = bag.ticks[-1].stamp_ns - bag.ticks[0].stamp_ns
    assert len(indexes) == len(chunks) == -(-duration // 160_000_000)
    assert all(index.message_index_offsets for index in indexes)
    groups = [record for record in records if isinstance(record, SummaryOffset)]
    assert groups and all(group.group_length > 0 for group in groups)


def test_rosbags_deserialises_every_message(bag):
    specs = {'/' + spec.name.lstrip('/'): spec for spec in topics(bag.spec)}
    expected = bag.written()
    with AnyReader([bag.directory]) as reader:
        for read, (written_ns, topic, written) in zip(reader.messages(), expected, strict=True):
            connection, time_ns, data = read
            message = reader.deserialize(data, connection.msgtype)
            assert (connection.topic, time_ns) == (topic, written_ns)
            spec = specs[connection.topic]
            if spec.layout:
                values = decode(spec, deserialize(spec.type_name, written))
                np.testing.assert_array_equal(decode(spec, message), values)
        assert reader.message_count == len(expected)
        assert reader.start_time == bag.ticks[0].stamp_ns
    with AnyReader([bag.file]) as reader:
        assert reader.message_count == len(expected)


def test_mcap_ros2_support_decodes_every_message(bag):
    factory = pytest.importorskip('mcap_ros2.decoder').DecoderFactory()
    with bag.file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[factory])
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == len(bag.written())
    joints = [message for _, channel, _, message in decoded if channel.topic == '/joint_states']
    assert [message.name for message in joints] == [list(bag.spec.robot.joints)] * len(bag.ticks)
    stamps = [message.header.stamp for message in joints]
    assert [s.sec * 10**9 + s.nanosec for s in stamps] == [tick.stamp_ns for tick in bag.ticks]


def test_metadata_yaml_agrees_with_the_file(bag):
    info = bag.info()
    counts = Counter(topic for _, topic, _ in bag.written())
    times = [time for time, _, _ in bag.written()]
    span = {
        'starting_time': {'nanoseconds_since_epoch': times[0]},
        'duration': {'nanoseconds': times[-1] - times[0]},
        'message_count': len(times),
    }
    assert (info['version'], info['storage_identifier'], info['ros_distro']) == (9, 'mcap', 'jazzy')
    assert (info['compression_format'], info['compression_mode']) == ('', '')
    assert {key: info[key] for key in span} == span
    assert info['relative_file_paths'] == ['episode_0.mcap']
    assert info['files'] == [{'path': 'episode_0.mcap', **span}]
    for entry in info['topics_with_message_count']:
        topic = entry['topic_metadata']
        assert entry['message_count'] == counts.pop(topic['name'])
        assert topic['serialization_format'] == 'cdr'
        assert topic['type_description_hash'] == type_hash(topic['type'])
    assert not counts


def test_episode_metadata_name_versions_and_orders(reach):
    metadata = read_episode(reach.directory).metadata
    assert json.loads(metadata['command_order']) == ['x', 'y', 'z', 'gripper']
    assert metadata['numpy_version'] == np.__version__
    assert 'checkpoint_sha256' not in metadata
    # YAML 1.2 reads some text as numbers that YAML 1.1 does not.
    info = YAML(typ='safe').load((reach.directory / 'metadata.yaml').read_text())
    custom = info['rosbag2_bagfile_information']['custom_data']
    assert custom == reach.info()['custom_data'] and custom['source_revision'] == '12e4567'


def test_metadata_records_say_what_the_episode_is_and_how_it_ended(bag):
    with bag.file.open('rb') as stream:
        records = [(r.name, r.metadata) for r in make_reader(stream).iter_metadata()]
    names = [name for name, _ in records]
    assert names == ['episode', 'rosbag2', 'episode_result', 'rosbag2']
    assert records[0][1] == {'episode_id': 'episode', **bag.metadata}
    assert records[2][1] == {'success': 'false', 'return': '-50.0', 'complete': 'true'}
    opened, closed = (
        yaml.safe_load(record['serialized_metadata'])
        for name, record in records
        if name == 'rosbag2'
    )
    assert closed == bag.info()
    assert opened['message_count'] == 0 and opened['topics_with_message_count'] == []
    assert closed['custom_data'] == {**opened['custom_data'], **records[2][1]}


@pytest.mark.parametrize('part', ['directory', 'file'])
def test_read_episode_gives_back_what_was_written(bag, part):
    episode = read_episode(getattr(bag, part))
    read = sorted(
        (message.log_time_ns, name, message.data)
        for name, topic in episode.topics.items()
        for message in topic.messages
    )
    assert read == bag.written()
    assert episode.is_complete
    assert episode.path == bag.file


def test_the_models_come_with_the_episode_and_compile(reach, tmp_path):
    path, simulated = asset_path('fetch/reach.xml'), reach.recorder.simulation.model
    given = [mjcf_attachment(path), compiled_attachment(simulated)]
    bag = write_bag(reach.recorder, reach.ticks, tmp_path, {}, attachments=given)
    attached = read_episode(bag).attachments
    assert zstandard.decompress(attached['model.mjb.zst']) == compiled_bytes(simulated)
    text = attached['model.xml'].decode()
    spec = mujoco.MjSpec.from_string(text)
    spec.meshdir = str(path.parent / spec.meshdir)
    spec.texturedir = str(path.parent / spec.texturedir)
    model, original = spec.compile(), mujoco.MjModel.from_xml_path(str(path))
    assert [model.joint(i).name for i in range(model.njnt)] == list(reach.spec.robot.joints)
    np.testing.assert_allclose(model.body_mass, original.body_mass, rtol=1e-6)
    assert model.nmeshvert == original.nmeshvert
    assert len(text) < 64 * 1024


def test_a_model_hash_does_not_depend_on_the_folder(reach, tmp_path):
    original = asset_path('fetch/reach.xml')
    shutil.copytree(original.parents[1], tmp_path / 'elsewhere')
    models = [
        mujoco.MjSpec.from_file(str(path)).compile()
        for path in (original, tmp_path / 'elsewhere' / 'fetch' / 'reach.xml')
    ]
    assert models[0].paths != models[1].paths
    assert model_sha256(models[0]) == model_sha256(models[1])
    fingerprints = {model_sha256(models[0])}
    for change in (
        lambda model: setattr(model.opt, 'timestep', 0.003),
        lambda model: setattr(model.vis.map, 'stiffness', 1.0),
        lambda model: model.mesh_vert.__setitem__(0, 1.0),
        lambda model: model.body_mass.__setitem__(1, 1.0),
    ):
        change(models[1])
        fingerprints.add(model_sha256(models[1]))
    assert len(fingerprints) == 5


def test_a_chunk_ends_after_the_message_that_fills_it(reach, tmp_path, monkeypatch):
    monkeypatch.setattr('fetch_hand_sim.episode_log.bag.CHUNK_BYTES', 4096)
    monkeypatch.setattr('fetch_hand_sim.episode_log.writer.FLUSH_PERIOD_NS', 10**12)
    path = write_bag(reach.recorder, reach.ticks, tmp_path, {})
    with (path / 'episode_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    size = sum(len(data) for _, _, data in reach.written())
    assert {index.compression for index in summary.chunk_indexes} == {'lz4'}
    assert size / (2 * 4096) < len(summary.chunk_indexes) < 2 * size / 4096
    episode = read_episode(path)
    assert sum(len(t.messages) for t in episode.topics.values()) == len(reach.written())


def test_relative_names_are_resolved_in_the_namespace(reach, tmp_path):
    writer = EpisodeWriter(tmp_path, 'episode', {}, namespace='/left')
    reach.recorder.write(writer, reach.ticks)
    names = set(read_episode(writer.finish({})).topics)
    assert {'/clock', '/left/joint_states', '/left/commands'} <= names


def test_a_finished_writer_rejects_messages(reach, tmp_path):
    writer = EpisodeWriter(tmp_path, 'episode', {})
    reach.recorder.write(writer, reach.ticks)
    path = writer.finish({})
    before = (path / 'episode_0.mcap').read_bytes()
    assert writer.write_tick(10**12, reach.ticks[0].messages) is False
    assert writer.finish({'success': 'true'}) is writer.finish({}, 'late') is None
    assert (path / 'episode_0.mcap').read_bytes() == before


def test_a_command_needs_a_tick_before_it(reach, tmp_path):
    writer = EpisodeWriter(tmp_path, 'episode', {})
    with pytest.raises(ValueError, match='commands was written before the first tick'):
        writer.write_received(reach.recorder.commands, reach.ticks[0].command)
    writer.finish({}, 'test')


@pytest.mark.parametrize(
    'task', ['FetchReach', 'Fetch-Near', 'fetch.near v2', 'Näher_000001_seed1']
)
def test_numbers_go_on_after_what_is_there(tmp_path, task):
    for name in (
        f'.{task}_000006_seed9.active',
        f'{task}Old_000044_seed0',
        'HandReach_000055_seed0',
    ):
        (tmp_path / name).mkdir()
    # Two recorders at once, of the same task and seed.
    directories = [EpisodeDirectory(tmp_path) for _ in range(2)]
    writers = [each.begin(task, 5, {}) for each in (*directories, *directories)]
    for number, writer in enumerate(writers, start=7):
        assert files.active_path(tmp_path, f'{task}_{number:06d}_seed5').is_dir()
        assert writer.finish({}, 'no messages') is None
    assert not list(tmp_path.glob('.*_seed5.active'))


def test_quality_of_service_is_written_as_rosbag2_version_9():
    unlimited = '    sec: 9223372036\n    nsec: 854775807\n'
    assert offered_qos_text(LATCHED) == (
        '- history: keep_last\n  depth: 1\n'
        '  reliability: reliable\n  durability: transient_local\n'
        f'  deadline:\n{unlimited}  lifespan:\n{unlimited}'
        f'  liveliness: automatic\n  liveliness_lease_duration:\n{unlimited}'
        '  avoid_ros_namespace_conventions: false\n'
    )
