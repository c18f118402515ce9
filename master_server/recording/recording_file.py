# SPDX-License-Identifier: Apache-2.0
"""One file of a recording, written so that a killed master loses one chunk at most."""

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
"""A chunk is written whole and handed to the operating system; what a kill loses, and the step in which one seeks."""

CHUNK_BYTES = 2**22
"""A chunk that grows faster is written earlier; bounds the memory of who writes and of who reads."""

UNSEEN_PERIOD_NS = NS_PER_S
"""Of the unseen blocks as boxes for people, who follow nothing faster; without loss they are in SEEN_TOPIC."""

NEVER_BYTES = 2**62
"""The library would begin a chunk in the middle of a moment; chunks begin where this module says."""

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
    """Moments in, an MCAP file out; every method may raise OSError."""

    def __init__(self, path: Path, wall_less_monotonic_ns: int) -> None:
        """Begin a file that is not there yet. Log times are the master's clock plus `wall_less_monotonic_ns`."""
        self.path = path
        self.maps = 0
        self._offset_ns = wall_less_monotonic_ns
        self._file = path.open("xb")
        try:
            self._writer = Writer(self._file, chunk_size=NEVER_BYTES)
            self._writer.start()
            self._writer.add_metadata(METADATA, {"format": f"{FORMAT_MAJOR}.{FORMAT_MINOR}"})
            self._channels = {topic: self._json_channel(topic, model) for topic, model in RECORDS.items()}
            self._channels |= {topic: self._picture_channel(topic, kind) for topic, kind in PICTURES.items()}
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
        """In the file, without the chunk that is under way."""
        return self._file.tell()

    def add(self, moment: Moment) -> bool:
        """Write what is new in a moment; whether a chunk was finished with it."""
        log_ns = moment.at_ns + self._offset_ns
        # Each chunk can be understood by itself, by who seeks and by who has no more than a part of the file.
        before = None if self._chunk_began_ns is None else self._before
        if self._chunk_began_ns is None:
            self._chunk_began_ns = moment.at_ns
        if before is None or moment.settings != before.settings:
            self._record(SETTINGS_TOPIC, moment.settings, log_ns)
        if before is None or not _same_map(moment, before):
            self._record(MAP_TOPIC, MapRecord.of(moment.view), log_ns)
        if before is None or not _same_seen(moment, before):
            self._record(SEEN_TOPIC, SeenRecord.of(moment), log_ns)
        self._draw(moment, log_ns)
        # Last, so that who finds it finds all that belongs to it.
        self._record(STATE_TOPIC, StateRecord.of(moment), log_ns)
        self._before = moment
        full = moment.at_ns - self._chunk_began_ns >= CHUNK_S * NS_PER_S or self._chunk_bytes >= CHUNK_BYTES
        if full:
            self.flush()
        return full

    def flush(self) -> None:
        """Finish the chunk that is under way."""
        self._writer.flush()
        self._chunk_began_ns, self._chunk_bytes = None, 0

    def close(self) -> None:
        """Finish the file with its index; closed in any case."""
        try:
            self._writer.finish()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, without an index; what does not fit any more is lost."""
        with contextlib.suppress(OSError):
            self._file.close()

    def _draw(self, moment: Moment, log_ns: int) -> None:
        """What is new, for people."""
        before = self._before
        stamp = foxglove.stamp_of(log_ns)
        if before is None or moment.reference != before.reference:
            self._attach(moment, log_ns)
        if before is None or _drawn_parts(moment.cell) != _drawn_parts(before.cell):
            self._picture(CELL_TOPIC, foxglove.cell_scene(moment.cell, stamp), log_ns)
        if before is None or not _same_map(moment, before):
            self._picture(VOXELS_TOPIC, foxglove.point_cloud(moment.view, stamp), log_ns)
            self.maps += 1
        self._picture(TRANSFORMS_TOPIC, foxglove.transforms(moment, stamp), log_ns)
        self._draw_unseen(moment, stamp, log_ns)

    def _draw_unseen(self, moment: Moment, stamp: Timestamp, log_ns: int) -> None:
        unseen = (moment.blocks, moment.seen_by == 0)
        if self._drawn is not None:
            at_ns, (blocks, drawn) = self._drawn
            same = blocks == unseen[0] and np.array_equal(drawn, unseen[1])
            if same or moment.at_ns - at_ns < UNSEEN_PERIOD_NS:
                return
        self._drawn = moment.at_ns, unseen
        self._picture(UNSEEN_TOPIC, foxglove.unseen_scene(moment.blocks, moment.seen_by, stamp), log_ns)

    def _attach(self, moment: Moment, log_ns: int) -> None:
        """The cell and its meshes, each once a file."""
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

    def _picture_channel(self, topic: str, kind: type[Message]) -> int:
        return self._writer.register_channel(topic, MessageEncoding.Protobuf, register_schema(self._writer, kind))

    def _record(self, topic: str, record: BaseModel, log_ns: int) -> None:
        self._message(topic, record.model_dump_json().encode(), log_ns)

    def _picture(self, topic: str, message: Message, log_ns: int) -> None:
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
    """What a cell looks like but for where its objects are; its parts are the same in a cell whose objects moved."""
    box = (*cell.box_min_m.tolist(), *cell.box_max_m.tolist())
    return (box, cell.static, cell.robot, [(body.name, body.mesh.sha256) for body in cell.objects])
