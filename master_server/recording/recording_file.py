# SPDX-License-Identifier: Apache-2.0
"""One file of a recording. If the master is killed, at most one chunk is lost."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from pydantic import BaseModel

from master_server.recording import foxglove
from master_server.recording.moment import (
    FORMAT_MAJOR,
    FORMAT_MINOR,
    MAP_TOPIC,
    METADATA,
    SEEN_TOPIC,
    SETTINGS_TOPIC,
    STATE_TOPIC,
    MapRecord,
    Moment,
    SeenRecord,
    StateRecord,
    cell_attachment,
    mesh_attachment,
)
from shared.cell import Cell
from shared.clock import NS_PER_S
from shared.settings import Settings

CHUNK_S = 1.0
"""Duration of a chunk, which is written as a whole. A kill loses one; a seek moves by one."""

CHUNK_BYTES = 2**22
"""A chunk that grows faster is written earlier; bounds the memory of writer and reader."""

UNSEEN_PERIOD_NS = NS_PER_S
"""Period of the unseen blocks drawn as boxes for people, who need no faster; SEEN_TOPIC has them without loss."""

NEVER_BYTES = 2**62
"""Too large to be reached: the library would start a chunk within a moment, so this module starts all chunks."""

RECORDS: dict[str, type[BaseModel]] = {
    STATE_TOPIC: StateRecord,
    MAP_TOPIC: MapRecord,
    SEEN_TOPIC: SeenRecord,
    SETTINGS_TOPIC: Settings,
}
VOXELS_TOPIC = "/voxels"
UNSEEN_TOPIC = "/unseen"
CELL_TOPIC = "/cell"
TRANSFORMS_TOPIC = "/tf"
PICTURES: dict[str, type[Message]] = {
    VOXELS_TOPIC: PointCloud,
    UNSEEN_TOPIC: SceneUpdate,
    CELL_TOPIC: SceneUpdate,
    TRANSFORMS_TOPIC: FrameTransforms,
}


class RecordingFile:
    """Write moments to an MCAP file; every method may raise OSError."""

    def __init__(self, path: Path, wall_less_monotonic_ns: int) -> None:
        """Make a new file. Log times are the master's clock plus `wall_less_monotonic_ns`."""
        self.path = path
        self.maps = 0
        self._offset_ns = wall_less_monotonic_ns
        self._file = path.open("xb")
        try:
            self._writer = Writer(self._file, chunk_size=NEVER_BYTES)
            self._writer.start()
            self._writer.add_metadata(METADATA, {"format": f"{FORMAT_MAJOR}.{FORMAT_MINOR}"})
            self._channels = {topic: self._json_channel(topic, model) for topic, model in RECORDS.items()}
            self._channels |= {topic: self._foxglove_channel(topic, kind) for topic, kind in PICTURES.items()}
            self._file.flush()
        except OSError:
            self._file.close()
            raise
        self._attached: set[str] = set()
        self._before: Moment | None = None
        self._drawn: tuple[int, Any] | None = None
        self._chunk_began_ns: int | None = None
        self._chunk_bytes = 0

    @property
    def bytes_written(self) -> int:
        """Size of the file, without the current chunk."""
        return self._file.tell()

    def add(self, moment: Moment) -> bool:
        """Write all changes of a moment; return True if that finished a chunk."""
        log_ns = moment.at_ns + self._offset_ns
        # Repeat the state in each chunk, so that a reader that seeks, or has only part of the file, can use it.
        before = None if self._chunk_began_ns is None else self._before
        if self._chunk_began_ns is None:
            self._chunk_began_ns = moment.at_ns
        if before is None or moment.settings != before.settings:
            self._record(SETTINGS_TOPIC, moment.settings, log_ns)
        if before is None or not _same_map(moment, before):
            self._record(MAP_TOPIC, MapRecord.of(moment.view), log_ns)
        if before is None or not _same_seen(moment, before):
            self._record(SEEN_TOPIC, SeenRecord.of(moment), log_ns)
        self._write_schemas(moment, log_ns)
        # Last, so that a reader that finds it finds everything that belongs to it.
        self._record(STATE_TOPIC, StateRecord.of(moment), log_ns)
        self._before = moment
        full = moment.at_ns - self._chunk_began_ns >= CHUNK_S * NS_PER_S or self._chunk_bytes >= CHUNK_BYTES
        if full:
            self.flush()
        return full

    def flush(self) -> None:
        """Finish the current chunk."""
        self._writer.flush()
        self._chunk_began_ns, self._chunk_bytes = None, 0

    def close(self) -> None:
        """Finish the file with its index; the file is closed even after an error."""
        try:
            self._writer.finish()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without an index; data that no longer fits is lost."""
        with contextlib.suppress(OSError):
            self._file.close()

    def _write_schemas(self, moment: Moment, log_ns: int) -> None:
        """Write the changes in the schemas for people."""
        before = self._before
        stamp = foxglove.stamp_of(log_ns)
        if before is None or moment.reference != before.reference:
            self._attach(moment, log_ns)
        if before is None or _drawn_parts(moment.cell) != _drawn_parts(before.cell):
            self._write_foxglove(CELL_TOPIC, foxglove.cell_scene(moment.cell, stamp), log_ns)
        if before is None or not _same_map(moment, before):
            self._write_foxglove(VOXELS_TOPIC, foxglove.point_cloud(moment.view, stamp), log_ns)
            self.maps += 1
        self._write_foxglove(TRANSFORMS_TOPIC, foxglove.transforms(moment, stamp), log_ns)
        self._write_unseen(moment, stamp, log_ns)

    def _write_unseen(self, moment: Moment, stamp: Timestamp, log_ns: int) -> None:
        unseen = (moment.blocks, moment.seen_by == 0)
        if self._drawn is not None:
            at_ns, (blocks, drawn) = self._drawn
            same = blocks == unseen[0] and np.array_equal(drawn, unseen[1])
            if same or moment.at_ns - at_ns < UNSEEN_PERIOD_NS:
                return
        self._drawn = moment.at_ns, unseen
        self._write_foxglove(UNSEEN_TOPIC, foxglove.unseen_scene(moment.blocks, moment.seen_by, stamp), log_ns)

    def _attach(self, moment: Moment, log_ns: int) -> None:
        """Write the cell and its meshes, each once in a file."""
        for sha256, mesh in moment.cell.meshes.items():
            if sha256 not in self._attached:
                name = mesh_attachment(sha256)
                self._writer.add_attachment(log_ns, log_ns, name, "application/octet-stream", mesh.to_bytes())
        sha256 = moment.reference.sha256
        if sha256 not in self._attached:
            document = json.dumps(moment.cell.document()).encode()
            self._writer.add_attachment(log_ns, log_ns, cell_attachment(sha256), "application/json", document)
        self._attached |= {sha256, *moment.cell.meshes}

    def _json_channel(self, topic: str, model: type[BaseModel]) -> int:
        schema = json.dumps(model.model_json_schema(mode="serialization")).encode()
        schema_id = self._writer.register_schema(f"cellwatch.{model.__name__}", SchemaEncoding.JSONSchema, schema)
        return self._writer.register_channel(topic, MessageEncoding.JSON, schema_id)

    def _foxglove_channel(self, topic: str, kind: type[Message]) -> int:
        return self._writer.register_channel(topic, MessageEncoding.Protobuf, register_schema(self._writer, kind))

    def _record(self, topic: str, record: BaseModel, log_ns: int) -> None:
        self._message(topic, record.model_dump_json().encode(), log_ns)

    def _write_foxglove(self, topic: str, message: Message, log_ns: int) -> None:
        self._message(topic, message.SerializeToString(), log_ns)

    def _message(self, topic: str, data: bytes, log_ns: int) -> None:
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns)
        self._chunk_bytes += len(data)


def _same_map(a: Moment, b: Moment) -> bool:
    return (
        a.view.lattice_version == b.view.lattice_version
        and np.array_equal(a.view.keys, b.view.keys)
        and np.array_equal(a.view.witnesses, b.view.witnesses)
        and a.view.reports.keys() == b.view.reports.keys()
        and all(np.array_equal(keys, b.view.reports[unit_id]) for unit_id, keys in a.view.reports.items())
    )


def _same_seen(a: Moment, b: Moment) -> bool:
    return a.blocks == b.blocks and np.array_equal(a.seen_by, b.seen_by)


def _drawn_parts(cell: Cell) -> tuple[object, ...]:
    """Return what a cell looks like, without the poses of its objects; equal for cells whose objects moved."""
    box = (*cell.box_min_m.tolist(), *cell.box_max_m.tolist())
    return (box, cell.static, cell.robot, [(body.name, body.mesh.sha256) for body in cell.objects])
