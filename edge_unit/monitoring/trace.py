# SPDX-License-Identifier: Apache-2.0
"""A file of all reports, frame by frame, for evaluation.

A file of msgpack maps, one after the other: `frame_number, captured_at_ns` (the unit's clock), `process_ms`, `keys`
(ascending little-endian uint32), `shape` and `voxel_size_m` of their lattice, and `sent` (false: a newer frame replaced
it before it was sent). A sent frame also has `sent_at_ns`, `received_at_ns` (the master had all of it) and
`merged_at_ns` (the master had merged it), by the unit's clock. `stages_ns` are the nanoseconds that the frame spent in
each stage from its capture on; it is empty if the frame did not pass all stages.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack

from edge_unit.uplink.assignment import Delivery, Report
from shared.errors import ConfigError

logger = logging.getLogger(__name__)

MAX_TRACE_BYTES = 2**30
"""Days of an ordinary cell; a trace that nobody stops must not fill the disk."""

MAX_PENDING = 256
"""Records kept in memory until the next frame writes them."""


@dataclass(frozen=True)
class TraceRecord:
    """One frame."""

    frame_number: int
    captured_at_ns: int
    process_ms: float
    keys: bytes
    shape: tuple[int, int, int]
    voxel_size_m: float
    sent: bool
    merged_at_ns: int | None
    sent_at_ns: int | None = None
    received_at_ns: int | None = None
    stages_ns: dict[str, int] = field(default_factory=dict)


class Trace:
    """Collects records on the event loop; `flush` writes them from a thread."""

    def __init__(self, path: Path) -> None:
        """Raises ConfigError if the file cannot be written."""
        self._path = path
        self._pending: deque[TraceRecord] = deque(maxlen=MAX_PENDING)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise ConfigError(f"trace_path {path}: cannot be written: {error.strerror}") from error
        self._left = MAX_TRACE_BYTES

    def add(self, record: TraceRecord) -> None:
        """Keep a record for the next `flush`."""
        self._pending.append(record)

    def note(self, report: Report, delivery: Delivery | None) -> None:
        """Keep the record of a report; without a `delivery` it was never sent."""
        if report.captured_at_ns is None:
            return
        lattice = report.assignment.lattice
        self.add(
            TraceRecord(
                report.health.frame,
                report.captured_at_ns,
                report.health.process_ms,
                report.keys,
                lattice.shape,
                lattice.voxel_size_m,
                delivery is not None,
                None if delivery is None else delivery.merged_at_ns,
                None if delivery is None else delivery.sent_at_ns,
                None if delivery is None else delivery.received_at_ns,
                report.stages_ns,
            )
        )

    def flush(self) -> None:
        """Write the collected records; the trace ends at the file's size limit."""
        while self._pending:
            packed: bytes = msgpack.packb(vars(self._pending.popleft()))
            if len(packed) > self._left:
                if self._left:
                    logger.warning("%s: the trace ends here, it has reached %d bytes", self._path, MAX_TRACE_BYTES)
                self._left = 0
                continue
            self._left -= len(packed)
            self._file.write(packed)
        self._file.flush()

    def close(self) -> None:
        """Write the rest and close the file."""
        self.flush()
        self._file.close()


def read_trace(path: Path) -> list[TraceRecord]:
    """Read the records of a trace; a truncated file yields all complete records.

    Raises:
        ConfigError: the file cannot be read, or is not a trace.
    """
    records = []
    try:
        with path.open("rb") as file:
            for fields in msgpack.Unpacker(file, use_list=False):
                records.append(_record(fields))
    except (OSError, ValueError, TypeError, msgpack.UnpackException) as error:
        raise ConfigError(f"{path}: expected a trace of a unit (trace_path): {error}") from error
    return records


def _record(fields: dict[str, Any]) -> TraceRecord:
    return TraceRecord(**fields)
