# SPDX-License-Identifier: Apache-2.0
"""The interface that readers use: a master, or a recording of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from master_server.core.master import MapView
from master_server.core.units import UnitState
from shared.lattice import Lattice
from shared.messages import CellReference, RobotAnswer, UnitRow
from shared.settings import Settings


class ReadableCell(Protocol):
    """The part of `PublishedCell` that units and readers receive."""

    @property
    def reference(self) -> CellReference: ...

    @property
    def document(self) -> dict[str, Any]: ...

    @property
    def meshes(self) -> Mapping[str, bytes]: ...


class Readable(Protocol):
    """The part of `Master` that changes nothing; each member is documented there."""

    listeners: list[Callable[[], None]]

    @property
    def settings(self) -> Settings: ...

    @property
    def published(self) -> ReadableCell: ...

    def view(self, now_ns: int) -> MapView: ...

    def blocks_at(self, now_ns: int) -> Lattice: ...

    def seen_by(self, now_ns: int) -> NDArray[np.uint8]: ...

    def units(self, now_ns: int) -> list[UnitRow]: ...

    def unit_states(self, now_ns: int) -> list[UnitState]: ...

    def robot_answer(self, since_ns: int | None, now_ns: int) -> RobotAnswer: ...

    def next_change_ns(self, now_ns: int) -> int | None: ...
