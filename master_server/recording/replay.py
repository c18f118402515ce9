# SPDX-License-Identifier: Apache-2.0
"""Answer from a recording as the master did."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from master_server.core import MapView, UnitState
from master_server.recording.recording_reader import Frame
from master_server.recording.timeline import Timeline, duration_s
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import Refusal, SourceError
from shared.lattice import Lattice
from shared.messages import CellReference, RobotAnswer, UnitRow
from shared.settings import Settings

SPEED_MIN, SPEED_MAX = 0.01, 100.0
"""Slow enough to see the robot's single steps; fast enough for a shift in five minutes."""

LOOK_PERIOD_NS = 10 * NS_PER_MS
"""Listeners are woken at most this often, at any speed."""


class ReplayRequest(BaseModel):
    """`PUT /replay`: an absent field stays as it is."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position_s: float | None = Field(default=None, ge=0.0, description="Go to this time of the recording.")
    speed: float | None = Field(default=None, ge=SPEED_MIN, le=SPEED_MAX)
    playing: bool | None = Field(default=None, description="False pauses.")


class ReplayAnswer(BaseModel):
    """The state of the replay."""

    file: str = Field(description="The current file.")
    files: int = Field(description="How many files follow one another.")
    position_s: float
    duration_s: float
    speed: float
    playing: bool
    loop: bool
    recorded_at_ns: int = Field(description="Recording time of the current moment, nanoseconds since 1970.")
    trouble: str = Field(description="The reason if part of the recording may be missing.")


@dataclass(frozen=True, eq=False)
class RecordedCell:
    """A cell as units and readers received it."""

    reference: CellReference
    document: dict[str, Any]
    meshes: Mapping[str, bytes]


class Replay:
    """The answers of a master at a time of its recording, which plays or is paused; see `Readable`.

    Ages, reasons and the robot's clock are those of that time.
    """

    def __init__(
        self,
        recording: Timeline,
        speed: float = 1.0,
        start_s: float = 0.0,
        loop: bool = False,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        """Play from `start_s` at once. `clock` serves calls that receive no time, such as `settings`."""
        self.listeners: list[Callable[[], None]] = []
        self._recording = recording
        self._clock = clock
        self._loop = loop
        self._duration_ns = recording.end_ns - recording.begin_ns
        self._speed = speed
        self._playing = True
        self._from_ns = min(round(start_s * NS_PER_S), self._duration_ns)
        self._since_ns = clock()
        self._cell: RecordedCell | None = None

    # ------------------------------------------------------------------ reads

    def view(self, now_ns: int) -> MapView:
        """Return the merged map."""
        return self._frame(now_ns).view

    def blocks_at(self, now_ns: int) -> Lattice:
        """Return the blocks of `seen_by`."""
        return self._frame(now_ns).blocks

    def seen_by(self, now_ns: int) -> NDArray[np.uint8]:
        """Return the number of live units that saw each block."""
        return self._frame(now_ns).seen_by

    def units(self, now_ns: int) -> list[UnitRow]:
        """Return one row for each unit."""
        return list(self._frame(now_ns).state.units)

    def unit_states(self, now_ns: int) -> list[UnitState]:
        """Return the part of each row that a stream sends."""
        return [
            UnitState(row.id, row.ip, row.state, row.reason, row.cause, row.age_s, row.voxels)
            for row in self.units(now_ns)
        ]

    def robot_answer(self, since_ns: int | None, now_ns: int) -> RobotAnswer:
        """Return the newest joints, or all after `since_ns`, by the clock of the recording."""
        robot = self._frame(now_ns).state.robot
        if since_ns is None:
            joints = robot.joints[-1:]
        else:
            joints = tuple(sample for sample in robot.joints if sample.at_ns > since_ns)
        return robot.model_copy(update={"joints": joints})

    @property
    def settings(self) -> Settings:
        """The settings at this time."""
        return self._frame(self._clock()).settings

    @property
    def published(self) -> RecordedCell:
        """The cell at this time."""
        reference = self._frame(self._clock()).state.cell
        if self._cell is None or self._cell.reference != reference:
            self._cell = RecordedCell(reference, self._document(reference.sha256), _Meshes(self._recording))
        return self._cell

    def next_change_ns(self, now_ns: int) -> int | None:
        """Return the time at which the next recorded moment is due; None while paused or at the end."""
        if not self._is_moving(now_ns):
            return None
        log_ns = self._recording.after(self._log_ns(now_ns))
        if log_ns is None:
            return None
        return now_ns + max(round((log_ns - self._log_ns(now_ns)) / self._speed), LOOK_PERIOD_NS)

    # ------------------------------------------------------------------ the player

    def answer(self, now_ns: int) -> ReplayAnswer:
        """Return the state of the replay."""
        frame = self._frame(now_ns)
        return ReplayAnswer(
            file=self._recording.path.name,
            files=len(self._recording.files),
            position_s=round(self._position_ns(now_ns) / NS_PER_S, 4),
            duration_s=round(duration_s(self._recording), 4),
            speed=self._speed,
            playing=self._is_moving(now_ns),
            loop=self._loop,
            recorded_at_ns=frame.log_ns,
            trouble=self._recording.trouble,
        )

    def change(self, request: ReplayRequest, now_ns: int) -> ReplayAnswer:
        """Seek, pause, or play at another speed; playing on at the end starts anew.

        Raises:
            Refusal: 422, the recording is not that long.
        """
        position_ns = self._position_ns(now_ns)
        if request.position_s is not None:
            position_ns = round(request.position_s * NS_PER_S)
            # The duration in `answer` is rounded, and the end itself is a valid position.
            if position_ns > self._duration_ns + NS_PER_MS:
                length = f"{self._duration_ns / NS_PER_S:.3f} s"
                raise Refusal(422, f"position_s: expected at most {length}, got {request.position_s:g}")
        elif request.playing and position_ns >= self._duration_ns:
            position_ns = 0
        self._from_ns, self._since_ns = min(position_ns, self._duration_ns), now_ns
        self._speed = self._speed if request.speed is None else request.speed
        self._playing = self._playing if request.playing is None else request.playing
        for listener in self.listeners:
            listener()
        return self.answer(now_ns)

    def _position_ns(self, now_ns: int) -> int:
        if not self._playing:
            return self._from_ns
        position_ns = self._from_ns + round((now_ns - self._since_ns) * self._speed)
        if self._loop and self._duration_ns:
            return position_ns % self._duration_ns
        return min(position_ns, self._duration_ns)

    def _is_moving(self, now_ns: int) -> bool:
        return self._playing and (self._loop or self._position_ns(now_ns) < self._duration_ns)

    def _log_ns(self, now_ns: int) -> int:
        return self._recording.begin_ns + self._position_ns(now_ns)

    def _document(self, sha256: str) -> dict[str, Any]:
        try:
            return self._recording.cell(sha256)
        except SourceError as error:
            raise Refusal(500, str(error)) from error

    def _frame(self, now_ns: int) -> Frame:
        try:
            return self._recording.at(self._log_ns(now_ns))
        except SourceError as error:
            raise Refusal(500, str(error)) from error


class _Meshes(Mapping[str, bytes]):
    """The meshes of a recording, each read on demand."""

    def __init__(self, recording: Timeline) -> None:
        self._recording = recording

    def __getitem__(self, sha256: str) -> bytes:
        data = self._recording.mesh(sha256)
        if data is None:
            raise KeyError(sha256)
        return data

    def __iter__(self) -> Iterator[str]:
        return iter(self._recording.meshes)

    def __len__(self) -> int:
        return len(self._recording.meshes)
