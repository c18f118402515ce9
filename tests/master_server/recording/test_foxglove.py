# SPDX-License-Identifier: Apache-2.0
"""Foxglove opens a recording as it is: a valid MCAP file, in Foxglove's own schemas, in one tree of frames."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message as ProtobufMessage
from jsonschema import Draft202012Validator
from mcap.reader import SeekingReader, make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from master_server.recording.moment import moment_of
from master_server.recording.recording_file import RecordingFile
from master_server.recording.recording_reader import UNREADABLE
from tests.master_server.fakes import S
from tests.master_server.recording.test_replay import STEPS, WALL_LESS_MONOTONIC_NS, Script

PUBLISHED: dict[str, type[ProtobufMessage]] = {
    "/voxels": PointCloud,
    "/unseen": SceneUpdate,
    "/cell": SceneUpdate,
    "/tf": FrameTransforms,
}
"""Foxglove's schema of each topic for people."""

WORLD = "world"

NUMERIC_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}
"""Sizes of the types of a PackedElementField."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds in which voxels walk, a unit dies, and settings and an object's place change."""
    path = tmp_path_factory.mktemp("foxglove") / "a.mcap"
    script = Script()
    file = RecordingFile(path, WALL_LESS_MONOTONIC_NS)
    for number in range(STEPS):
        file.add(moment_of(script.master, script.step(number)))
    file.close()
    return path


def decoded(path: Path, topic: str) -> Iterator[tuple[Message, Any]]:
    """Decode the messages of a topic with only the schema in the file."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        kinds: dict[int, Any] = {}
        for schema, _, message in reader.iter_messages(topics=[topic]):
            assert schema is not None
            if schema.id not in kinds:
                kinds[schema.id] = kind_of(schema)
            found = kinds[schema.id]()
            found.ParseFromString(message.data)
            yield message, found


def files_of(schema: Schema) -> dict[str, descriptor_pb2.FileDescriptorProto]:
    """Return the descriptions in a schema; each must follow those that it needs."""
    described = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}
    for file in described.file:
        assert set(file.dependency) <= files.keys(), "a description comes before one that it needs"
        files[file.name] = file
    return files


def kind_of(schema: Schema) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in files_of(schema).values():
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def published_files(kind: type[ProtobufMessage]) -> dict[str, descriptor_pb2.FileDescriptorProto]:
    """Return the descriptions of a message and its parts in Foxglove's package."""
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}

    def add(file: Any) -> None:
        for needed in file.dependencies:
            add(needed)
        proto = descriptor_pb2.FileDescriptorProto()
        file.CopyToProto(proto)
        files[file.name] = proto

    add(kind.DESCRIPTOR.file)
    return files


def test_each_channel_is_in_the_schema_that_foxglove_publishes(recorded: Path) -> None:
    with recorded.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert channels.keys() > PUBLISHED.keys()
    for topic, kind in PUBLISHED.items():
        schema = summary.schemas[channels[topic].schema_id]
        assert (channels[topic].message_encoding, schema.encoding) == ("protobuf", "protobuf")
        assert schema.name == kind.DESCRIPTOR.full_name
        assert schema.name.startswith("foxglove.")
        assert files_of(schema) == published_files(kind)


def test_our_own_channels_follow_the_schemas_beside_them(recorded: Path) -> None:
    seen = set()
    with recorded.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding != "json":
                continue
            assert schema is not None
            assert schema.encoding == "jsonschema"
            described = json.loads(schema.data)
            # Foxglove requires an object at the root.
            assert described["type"] == "object"
            if (channel.topic, message.data) not in seen and len(seen) < 200:
                Draft202012Validator(described).validate(json.loads(message.data))
                seen.add((channel.topic, message.data))
    assert len({topic for topic, _ in seen}) == 4


def test_frames_form_one_tree_and_everything_stands_in_it(recorded: Path) -> None:
    parents: dict[str, str] = {}
    for message, found in decoded(recorded, "/tf"):
        names = [one.child_frame_id for one in found.transforms]
        assert len(set(names)) == len(names)
        for one in found.transforms:
            # A frame never changes its parent, and the root never has one.
            assert parents.setdefault(one.child_frame_id, one.parent_frame_id) == one.parent_frame_id
            assert one.child_frame_id != WORLD
            assert one.timestamp.ToNanoseconds() == message.log_time
            q = one.rotation
            assert np.linalg.norm((q.x, q.y, q.z, q.w)) == pytest.approx(1.0, abs=1e-9)
    for name in parents:
        above = [name]
        while above[-1] in parents:
            above.append(parents[above[-1]])
            assert len(above) <= len(parents) + 1, f"{name} is above itself"
        assert above[-1] == WORLD
    used = {found.frame_id for _, found in decoded(recorded, "/voxels")}
    entities = [
        one for topic in ("/cell", "/unseen") for _, found in decoded(recorded, topic) for one in found.entities
    ]
    used |= {entity.frame_id for entity in entities}
    assert used <= parents.keys() | {WORLD}
    assert any(name.startswith("object/") for name in used)
    assert any(name.startswith("robot/") for name in used)


def test_drawn_entities_are_complete(recorded: Path) -> None:
    clouds = 0
    for message, cloud in decoded(recorded, "/voxels"):
        assert cloud.timestamp.ToNanoseconds() == message.log_time
        assert len(cloud.data) % cloud.point_stride == 0
        assert {"x", "y", "z"} <= {field.name for field in cloud.fields}
        taken: set[int] = set()
        for field in cloud.fields:
            places = set(range(field.offset, field.offset + NUMERIC_BYTES[field.type]))
            assert max(places) < cloud.point_stride
            assert not places & taken
            taken |= places
        assert cloud.pose.orientation.w == 1.0
        clouds += 1
    assert clouds > 5
    ids: Counter[str] = Counter()
    for _, scene in decoded(recorded, "/cell"):
        ids.update(entity.id for entity in scene.entities)
        for entity in scene.entities:
            for model in entity.models:
                assert (model.media_type, bool(model.url)) == ("model/stl", False)
                count = int.from_bytes(model.data[80:84], "little")
                assert len(model.data) == 84 + 50 * count > 84
                # Foxglove takes data with this start for an ASCII STL.
                assert not model.data.startswith(b"solid")
            for line in entity.lines:
                assert len(line.points) % 2 == 0
    assert set(ids.values()) == {1}


def problems(path: Path) -> list[str]:
    """Check as `mcap doctor` does: order, ids, times, counts, offsets and checksums; empty for a valid file."""
    found: list[str] = []
    schemas: set[int] = set()
    channels: set[int] = set()
    counts: Counter[int] = Counter()
    last: dict[int, int] = defaultdict(int)
    newest_ns, chunks, attachments, ended = 0, 0, 0, False
    expected_indexes: dict[int, Counter[int]] = {}
    records: list[McapRecord] = []
    with path.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
    if not isinstance(records[0], Header):
        found.append("it does not begin with a header")
    elif not records[0].library:
        found.append("nobody is named who wrote it")
    if not isinstance(records[-1], Footer):
        found.append("it does not end with a footer")
    elif not records[-1].summary_start or not records[-1].summary_crc:
        found.append("its footer knows no summary, or no checksum of it")
    for record in records:
        if ended:
            continue
        if isinstance(record, Schema):
            schemas.add(record.id)
        elif isinstance(record, Channel):
            if record.schema_id not in schemas:
                found.append(f"channel {record.topic} comes before its schema")
            channels.add(record.id)
        elif isinstance(record, Chunk):
            chunks += 1
            expected_indexes = {}
            times = []
            for inner in breakup_chunk(record, validate_crc=True):
                if isinstance(inner, Schema):
                    schemas.add(inner.id)
                elif isinstance(inner, Channel):
                    if inner.schema_id not in schemas:
                        found.append(f"channel {inner.topic} comes before its schema")
                    channels.add(inner.id)
                elif isinstance(inner, Message):
                    if inner.channel_id not in channels:
                        found.append(f"a message of channel {inner.channel_id} comes before it")
                    if inner.log_time < last[inner.channel_id]:
                        found.append(f"channel {inner.channel_id} goes back in time")
                    if inner.log_time < newest_ns:
                        found.append("a message is older than one before it")
                    newest_ns = max(newest_ns, inner.log_time)
                    last[inner.channel_id] = inner.log_time
                    counts[inner.channel_id] += 1
                    expected_indexes.setdefault(inner.channel_id, Counter())[inner.log_time] += 1
                    times.append(inner.log_time)
            if times and (min(times), max(times)) != (record.message_start_time, record.message_end_time):
                found.append("a chunk's times are not those of its messages")
        elif isinstance(record, MessageIndex):
            there = Counter(log_ns for log_ns, _ in record.records)
            if there != expected_indexes.get(record.channel_id, Counter()):
                found.append(f"the index of channel {record.channel_id} is not that of its chunk")
        elif isinstance(record, Attachment):
            attachments += 1
        elif isinstance(record, DataEnd):
            ended = True
    if not ended:
        found.append("its data do not end")
    with path.open("rb") as stream:
        summary = SeekingReader(stream, validate_crcs=True).get_summary()
    if summary is None or summary.statistics is None:
        return [*found, "there is no summary"]
    told = summary.statistics
    if (told.chunk_count, told.attachment_count, told.message_count) != (chunks, attachments, counts.total()):
        found.append("its statistics count others than are there")
    if dict(told.channel_message_counts) != dict(counts):
        found.append("its statistics count a channel's messages otherwise")
    if told.message_end_time != newest_ns:
        found.append("its statistics end at another time")
    if (len(summary.chunk_indexes), len(summary.attachment_indexes)) != (chunks, attachments):
        found.append("not everything is in its index")
    return found


def test_it_is_a_sound_file(recorded: Path) -> None:
    assert problems(recorded) == []
    with recorded.open("rb") as stream:
        first = next(make_reader(stream).iter_messages())[2]
    # Of this century: a viewer's timeline shows the date.
    assert first.log_time > WALL_LESS_MONOTONIC_NS
    assert first.log_time - WALL_LESS_MONOTONIC_NS > S


def test_the_check_finds_a_file_that_ends_too_early(recorded: Path, tmp_path: Path) -> None:
    whole = recorded.read_bytes()
    cut = tmp_path / "cut.mcap"
    for share in (0.3, 0.7, 0.999):
        cut.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(UNREADABLE):
            problems(cut)


def test_the_check_finds_times_that_go_back_and_schemas_that_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "wrong.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="")
        channel = writer.register_channel("/voxels", "protobuf", 7)
        for log_ns in (30, 20):
            writer.add_message(channel, log_ns, b"", log_ns)
        writer.finish()
    assert problems(path) == [
        "nobody is named who wrote it",
        "channel /voxels comes before its schema",
        "channel 1 goes back in time",
        "a message is older than one before it",
    ]
