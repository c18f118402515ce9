# SPDX-License-Identifier: Apache-2.0
"""Read any moment of a recording, in the memory of one chunk.

The file is scanned once from its start to find its chunks. So a file whose writer was killed can be read as any other,
up to its end.
"""

from __future__ import annotations

import json
import logging
import mmap
import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar, cast

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, MessageIndex, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from master_server.core import MapView
from master_server.recording.moment import (
    FORMAT_MAJOR,
    FORMAT_MINOR,
    MAP_TOPIC,
    METADATA,
    SEEN_TOPIC,
    SETTINGS_TOPIC,
    STATE_TOPIC,
    MapRecord,
    SeenRecord,
    StateRecord,
    cell_attachment,
    mesh_attachment,
)
from shared.configuration import sentence
from shared.errors import InputError, SourceError
from shared.lattice import Lattice
from shared.settings import Settings

logger = logging.getLogger(__name__)

MAX_RECORD_BYTES = 2**30
"""Chunks have a few MiB, meshes some hundred at most; a longer record means damage."""

CHUNKS_KEPT = 4
"""Unpacked chunks in memory: a replay needs one, seeking back and forth a few."""

PROGRESS_STEP_BYTES = 2**24
"""Bytes between two calls of `progress`."""

UNREADABLE = (McapError, struct.error, ValueError, OverflowError, zstandard.ZstdError)
"""All errors of the library for damaged bytes."""

UNKNOWN_REASON = "the recording says that the map was not complete, and not why"
"""Reason of a moment that is not complete and has none: absence of a reason must not make it complete."""

Progress = Callable[[int, int], None]
Model = TypeVar("Model", bound=BaseModel)


class Frame(NamedTuple):
    """One recorded moment; `log_ns` since 1970."""

    log_ns: int
    state: StateRecord
    view: MapView
    blocks: Lattice
    seen_by: NDArray[np.uint8]
    settings: Settings


class _Place(NamedTuple):
    """The position of a record, and the time of its first message."""

    offset: int
    length: int
    begin_ns: int = 0


class _RawFrame(NamedTuple):
    log_ns: int
    state: bytes
    map: bytes
    seen: bytes
    settings: bytes


@dataclass
class _Index:
    chunks: list[_Place] = field(default_factory=list)
    attachments: dict[str, _Place] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    channels: dict[int, Channel] = field(default_factory=dict)
    format: str | None = None
    end_ns: int = 0
    trouble: str = "its writer was stopped before it could finish it"


class Recording:
    """An open recording; a context manager, which closes it.

    Attributes:
        begin_ns, end_ns: of the first and the last moment, since 1970.
        trouble: the reason if something may be missing; empty otherwise.
        counts: messages by topic.
    """

    def __init__(self, path: Path, progress: Progress | None = None) -> None:
        """Index a file. `progress` is called with the bytes read and their total.

        Raises:
            SourceError: there is no such file, or it holds no moment of a master.
        """
        self.path = path
        self._data = _map(path)
        try:
            self._index = _index(path, self._data, progress)
            self._unpacked = lru_cache(CHUNKS_KEPT)(self._unpack)
            self._parsed = lru_cache(CHUNKS_KEPT)(self._parse)
            self._begin()
        except BaseException:
            self._data.close()
            raise
        channels = self._index.channels
        self.counts = {channels[key].topic: n for key, n in self._index.counts.items() if key in channels}

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self._data.close()

    @property
    def trouble(self) -> str:
        """The reason if something may be missing; empty otherwise."""
        return self._index.trouble

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self._data)

    @property
    def cells(self) -> list[dict[str, Any]]:
        """The documents of all watched cells."""
        return [self.cell(sha256) for sha256 in self._attached(cell_attachment(""))]

    @property
    def meshes(self) -> list[str]:
        """The sha256 of all meshes."""
        return self._attached(mesh_attachment(""))

    @property
    def cell_names(self) -> list[str]:
        """The sha256 of all cells."""
        return self._attached(cell_attachment(""))

    def at(self, log_ns: int) -> Frame:
        """Return the last moment at or before `log_ns`; the first moment, if that is later."""
        number = max(bisect_right(self._index.chunks, log_ns, key=_begin_of) - 1, 0)
        # A damaged chunk, or one whose state messages come after its first message: the earlier state holds.
        for place in reversed(self._index.chunks[: number + 1]):
            frames = self._unpacked(place)
            index = bisect_right(frames, log_ns, key=_log_of)
            if index:
                return self._parsed(frames[index - 1])
        return self._parsed(self._first)

    def after(self, log_ns: int) -> int | None:
        """Return the time of the first moment after `log_ns`."""
        number = max(bisect_right(self._index.chunks, log_ns, key=_begin_of) - 1, 0)
        for place in self._index.chunks[number:]:
            frames = self._unpacked(place)
            index = bisect_right(frames, log_ns, key=_log_of)
            if index < len(frames):
                return frames[index].log_ns
        return None

    def cell(self, sha256: str) -> dict[str, Any]:
        """Return the document of a cell.

        Raises:
            SourceError: it is missing or damaged.
        """
        data = self._attachment(cell_attachment(sha256))
        if data is None:
            raise SourceError(f"{self.path}: the cell {sha256} is missing")
        document: dict[str, Any] = json.loads(data)
        return document

    def mesh(self, sha256: str) -> bytes | None:
        """Return a mesh in its canonical bytes; None if it is missing."""
        return self._attachment(mesh_attachment(sha256))

    def forget(self) -> None:
        """Drop the unpacked chunks from memory; they are unpacked again on demand."""
        self._unpacked.cache_clear()
        self._parsed.cache_clear()

    def _attached(self, prefix: str) -> list[str]:
        names = self._index.attachments
        return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]

    def _begin(self) -> None:
        index = self._index
        major, minor = _version(index.format)
        if major != FORMAT_MAJOR:
            raise SourceError(
                f"{self.path}: expected a master's recording of format {FORMAT_MAJOR}.x, got {index.format or 'none'}; "
                "replay it with the version of Cellwatch that wrote it"
            )
        if minor > FORMAT_MINOR:
            logger.warning(
                "%s: its format %s is newer than %d.%d; what this version does not know of the status is ignored",
                self.path,
                index.format,
                FORMAT_MAJOR,
                FORMAT_MINOR,
            )
        first = next(filter(None, map(self._unpacked, index.chunks)), None)
        last = next(filter(None, map(self._unpacked, reversed(index.chunks))), None)
        if first is None or last is None:
            raise SourceError(f"{self.path}: there is no whole chunk in it: {self.trouble}")
        self._first = first[0]
        # Reports what this version cannot read when the file is opened, not at the first request.
        self._parsed(self._first)
        self.begin_ns, self.end_ns = first[0].log_ns, last[-1].log_ns

    def _attachment(self, name: str) -> bytes | None:
        place = self._index.attachments.get(name)
        return None if place is None else Attachment.read(self._stream(place)).data

    def _stream(self, place: _Place) -> ReadDataStream:
        """Return a record's content, without its opcode and length."""
        return ReadDataStream(BytesIO(self._data[place.offset + 9 : place.offset + place.length]))

    def _unpack(self, place: _Place) -> tuple[_RawFrame, ...]:
        """Return the moments of a chunk; none if it is damaged."""
        try:
            records = breakup_chunk(Chunk.read(self._stream(place)), validate_crc=True)
        except UNREADABLE as error:
            logger.warning("%s: the chunk at byte %d is damaged and skipped: %s", self.path, place.offset, error)
            return ()
        return tuple(_frames(records, self._index.channels))

    def _parse(self, raw: _RawFrame) -> Frame:
        try:
            state, merged = _checked(StateRecord, raw.state), _checked(MapRecord, raw.map)
            seen = _checked(SeenRecord, raw.seen)
            keys, witnesses = merged.arrays()
            view = MapView(
                merged.lattice.lattice(),
                merged.lattice_version,
                keys,
                witnesses,
                state.reasons if state.complete or state.reasons else (UNKNOWN_REASON,),
                state.oldest_view_age_s,
                state.units_live,
                merged.reported(),
                state.causes,
            )
            settings = _settings(raw.settings)
            return Frame(raw.log_ns, state, view, seen.blocks.lattice(), seen.counts(), settings)
        except InputError as error:
            raise SourceError(f"{self.path}: {error}") from error


def _map(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: it is empty") from error


def _index(path: Path, data: mmap.mmap, progress: Progress | None) -> _Index:
    """Index all records, as far as the file can be read."""
    index = _Index()
    began, reported = 0, 0
    try:
        for record in StreamReader(cast(IO[bytes], data), emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records:
            ended = data.tell()
            began = max(began, 8)
            _note(index, record, _Place(began, ended - began))
            began = ended
            if progress is not None and ended - reported >= PROGRESS_STEP_BYTES:
                progress(ended, len(data))
                reported = ended
            if isinstance(record, Footer):
                index.trouble = ""
    except UNREADABLE as error:
        if not began:
            raise SourceError(f"{path}: it is no MCAP file") from error
        if data.tell() < len(data):
            index.trouble = f"it is damaged at byte {began}: {type(error).__name__}: {error}"
    if progress is not None:
        progress(len(data), len(data))
    return index


def _note(index: _Index, record: McapRecord, place: _Place) -> None:
    if isinstance(record, Chunk):
        index.chunks.append(place._replace(begin_ns=record.message_start_time))
        if not index.channels:
            # Channels are made with the file, so they are in its first chunk.
            channels = breakup_chunk(record, validate_crc=True)
            index.channels = {channel.id: channel for channel in channels if isinstance(channel, Channel)}
    elif isinstance(record, MessageIndex):
        index.counts[record.channel_id] += len(record.records)
    elif isinstance(record, Attachment):
        index.attachments[record.name] = place
    elif isinstance(record, Metadata) and record.name == METADATA:
        index.format = record.metadata.get("format")


def _frames(records: list[McapRecord], channels: dict[int, Channel]) -> Iterator[_RawFrame]:
    """Yield moments. A state is the last message of its moment; the other messages of the moment precede it."""
    latest: dict[str, bytes] = {}
    for record in records:
        if not isinstance(record, Message) or record.channel_id not in channels:
            continue
        topic = channels[record.channel_id].topic
        latest[topic] = record.data
        if topic == STATE_TOPIC and {MAP_TOPIC, SEEN_TOPIC, SETTINGS_TOPIC} <= latest.keys():
            yield _RawFrame(record.log_time, record.data, latest[MAP_TOPIC], latest[SEEN_TOPIC], latest[SETTINGS_TOPIC])


def _version(text: str | None) -> tuple[int, int]:
    """Major and minor of a recording's format; (0, 0) if it has none that can be read."""
    major, _, minor = (text or "").partition(".")
    numbers = [int(part) if part.isascii() and part.isdigit() else 0 for part in (major, minor or "0")]
    return numbers[0], numbers[1]


def _settings(data: bytes) -> Settings:
    """The recorded settings, without those of a later minor.

    Raises:
        InputError: a value that this version knows is wrong.
    """
    try:
        fields = json.loads(data)
        if isinstance(fields, dict):
            fields = {name: fields[name] for name in Settings.model_fields if name in fields}
        return Settings.model_validate(fields)
    except ValidationError as error:
        raise InputError(f"Settings: {sentence(error)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"Settings: expected JSON: {error}") from error


def _checked(model: type[Model], data: bytes) -> Model:
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        raise InputError(f"{model.__name__}: {sentence(error)}") from error


def _begin_of(place: _Place) -> int:
    return place.begin_ns


def _log_of(frame: _RawFrame) -> int:
    return frame.log_ns
