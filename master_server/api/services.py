# SPDX-License-Identifier: Apache-2.0
"""The objects that the routes of one application use, as typed attributes."""

from __future__ import annotations

from dataclasses import dataclass

from master_server.api.history import History
from master_server.api.image_requests import ImageRequests
from master_server.api.map_stream import Stream
from master_server.api.metrics import Metrics
from master_server.cells.cell_loading import CellLoader
from master_server.core import Master, Readable
from master_server.recording.recorder import Recorder
from master_server.security import Access, Limits


@dataclass(frozen=True, eq=False, kw_only=True)
class Services:
    """Services of a master, or of a replay."""

    master: Readable
    access: Access
    limits: Limits
    stream: Stream
    history: History
    recorder: Recorder | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class MasterServices(Services):
    """Services of a master: changes, and requests to units."""

    master: Master
    loader: CellLoader
    image_requests: ImageRequests
    metrics: Metrics
    started_at_ns: int
