# SPDX-License-Identifier: Apache-2.0
"""What the routes of one application work with, by names that the type checker proves."""

from __future__ import annotations

from dataclasses import dataclass

from master_server.api.history import History
from master_server.api.image_requests import Pictures
from master_server.api.map_stream import Stream
from master_server.api.metrics import Metrics
from master_server.cells.cell_loading import CellLoader
from master_server.core import Master, Readable
from master_server.recording.recorder import Recorder
from master_server.security import Access, Limits


@dataclass(frozen=True, eq=False, kw_only=True)
class Services:
    """Of a master, or of a replay of one."""

    master: Readable
    access: Access
    limits: Limits
    stream: Stream
    history: History
    recorder: Recorder | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class MasterServices(Services):
    """Of a master: what changes it, and what units are asked for."""

    master: Master
    loader: CellLoader
    pictures: Pictures
    metrics: Metrics
    started_at_ns: int
