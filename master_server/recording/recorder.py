# SPDX-License-Identifier: Apache-2.0
"""Record the master's state to files of bounded size, in a thread that nothing waits for."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

from pydantic import BaseModel, ConfigDict, Field, model_validator

from master_server.core import Master
from master_server.recording.moment import Moment, moment_of
from master_server.recording.recording_file import RecordingFile
from shared.clock import NS_PER_S, monotonic_ns, wall_ns
from shared.errors import Refusal

logger = logging.getLogger(__name__)

WAITING_MAX = 4
"""Queue of moments for a slow disk, each a whole map; a newer one replaces the oldest."""

PATTERN = "cellwatch-*.mcap"
"""Names of recordings; only such files are ever deleted."""


class RecordingConfig(BaseModel):
    """Recording: on or off, folder, rate, and bounds of the files."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(default=False, description="If true, the master records from its start.")
    folder: Path | None = Field(default=None, description="Folder; by default `recordings` below `state_dir`.")
    maps_per_s: float = Field(default=10.0, ge=0.1, le=30.0, description="Recorded moments per second.")
    file_bytes_max: int = Field(default=2**28, ge=2**16, le=2**36, description="Beyond this size a new file starts.")
    file_s_max: float = Field(default=600.0, ge=1.0, le=86400.0, description="Beyond this duration a new file starts.")
    total_bytes_max: int = Field(default=2**33, ge=2**17, description="Size of all recordings; the oldest are deleted.")
    free_bytes_min: int = Field(default=2**30, ge=0, description="Recording stops if the disk has less free space.")

    @model_validator(mode="after")
    def _room_for_two(self) -> RecordingConfig:
        if self.total_bytes_max < 2 * self.file_bytes_max:
            raise ValueError(f"total_bytes_max: expected twice file_bytes_max at least, got {self.total_bytes_max}")
        return self


class RecordingStatus(BaseModel):
    """`GET /recording`: the state of the recording, and its counts."""

    recording: bool
    folder: str
    file: str | None = Field(default=None, description="The newest file.")
    bytes: int = Field(default=0, description="Size of that file.")
    since_ns: int | None = Field(default=None, description="Time when recording started, by the master's clock.")
    moments: int = Field(default=0, description="Moments written since then.")
    maps: int = Field(default=0, description="Moments with a map that had changed.")
    dropped: int = Field(default=0, description="Moments dropped because the disk was too slow.")
    reason: str = Field(default="", description="The reason if recording stopped by itself.")


class _Stopped(Exception):
    """Recording cannot go on; the text gives the reason."""


@dataclass
class _Run:
    """One recording from start to stop. Only the thread writes the fields of `GET /recording`, except `dropped`."""

    began_ns: int
    waiting: SimpleQueue[Moment | None] = field(default_factory=SimpleQueue)
    path: Path | None = None
    bytes: int = 0
    moments: int = 0
    maps: int = 0
    dropped: int = 0
    reason: str = ""

    def offer(self, moment: Moment) -> None:
        """Queue a moment for the thread; drop the oldest if the queue is full; never blocks."""
        if self.waiting.qsize() >= WAITING_MAX:
            with contextlib.suppress(Empty):
                self.waiting.get_nowait()
                self.dropped += 1
        self.waiting.put(moment)


class Recorder:
    """Sample the master at a rate and record it. A failure here ends the recording only."""

    def __init__(self, master: Master, config: RecordingConfig, folder: Path) -> None:
        self._master = master
        self._config = config
        self._folder = config.folder or folder
        self._run: _Run | None = None
        self._thread: Thread | None = None
        self._sampling: asyncio.Task[None] | None = None
        self._changing = asyncio.Lock()

    @property
    def enabled(self) -> bool:
        """True if recording starts with the master."""
        return self._config.enabled

    def status(self) -> RecordingStatus:
        """Return the state of the recording."""
        run = self._run
        if run is None:
            return RecordingStatus(recording=False, folder=str(self._folder))
        return RecordingStatus(
            recording=self._sampling is not None and not run.reason,
            folder=str(self._folder),
            file=None if run.path is None else str(run.path),
            bytes=run.bytes,
            since_ns=run.began_ns,
            moments=run.moments,
            maps=run.maps,
            dropped=run.dropped,
            reason=run.reason,
        )

    async def start(self) -> RecordingStatus:
        """Start a new file; does nothing if it records already.

        Raises:
            Refusal: 507, the disk is full, or the folder cannot be written.
        """
        async with self._changing:
            if self.status().recording:
                return self.status()
            await self._end()
            run = self._run = _Run(monotonic_ns())
            try:
                folder = await asyncio.to_thread(_Folder, self._folder, self._config, run)
            except _Stopped as stopped:
                run.reason = str(stopped)
                raise Refusal(507, f"recording: {stopped}") from stopped
            run.offer(moment_of(self._master, monotonic_ns()))
            self._thread = Thread(target=_write, args=(folder, run), name="recording")
            self._thread.start()
            self._sampling = asyncio.create_task(self._sample(run), name="recording")
            return self.status()

    async def begin(self) -> None:
        """As `start`, but the master starts even if it cannot record: `status` has the reason."""
        try:
            await self.start()
        except Refusal as refusal:
            logger.error("%s", refusal)

    async def stop(self) -> RecordingStatus:
        """Finish the file; does nothing if it does not record."""
        async with self._changing:
            await self._end()
            return self.status()

    async def _end(self) -> None:
        sampling, thread, run = self._sampling, self._thread, self._run
        self._sampling = self._thread = None
        if sampling is None or thread is None or run is None:
            return
        sampling.cancel()
        run.waiting.put(None)
        await asyncio.to_thread(thread.join)

    async def _sample(self, run: _Run) -> None:
        period_ns = round(NS_PER_S / self._config.maps_per_s)
        due_ns = monotonic_ns()
        while not run.reason:
            # After a stall, sampling continues from now; missed moments are left out.
            due_ns = max(due_ns + period_ns, monotonic_ns())
            await asyncio.sleep((due_ns - monotonic_ns()) / NS_PER_S)
            run.offer(moment_of(self._master, monotonic_ns()))


class _Folder:
    """The files of one recording: one after another; the oldest are deleted."""

    def __init__(self, folder: Path, config: RecordingConfig, run: _Run) -> None:
        self._folder = folder
        self._config = config
        self._run = run
        self._is_done = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._next()
        except OSError as error:
            raise _Stopped(_sentence(folder, error)) from error

    def add(self, moment: Moment) -> None:
        """Write a moment; raises _Stopped."""
        try:
            if self._is_done:
                # Open the file only now, so that it never stays empty.
                self._finish()
                self._file = self._next()
            finished_chunk = self._file.add(moment)
            self._update_counts()
            self._run.moments += 1
            if not finished_chunk:
                return
            if full := self._full():
                self._finish()
                raise _Stopped(full)
            long = moment.at_ns - self._began_ns >= self._config.file_s_max * NS_PER_S
            self._is_done = long or self._file.bytes_written >= self._config.file_bytes_max
        except OSError as error:
            self._file.abandon()
            raise _Stopped(_sentence(self._file.path, error)) from error

    def close(self) -> None:
        """Finish the file; raises _Stopped."""
        try:
            self._finish()
        except OSError as error:
            raise _Stopped(_sentence(self._file.path, error)) from error

    def _next(self) -> RecordingFile:
        self._make_room()
        if full := self._full():
            raise _Stopped(full)
        self._began_ns = monotonic_ns()
        self._is_done = False
        now_ns = wall_ns()
        self._maps_before = self._run.maps
        when = datetime.fromtimestamp(now_ns / NS_PER_S, timezone.utc).strftime("%Y%m%dT%H%M%S.%fZ")
        file = RecordingFile(self._folder / PATTERN.replace("*", when), now_ns - self._began_ns)
        logger.info("recording to %s", file.path)
        self._run.path = file.path
        return file

    def _finish(self) -> None:
        self._file.close()
        self._run.bytes = self._file.path.stat().st_size

    def _update_counts(self) -> None:
        self._run.bytes = self._file.bytes_written
        self._run.maps = self._maps_before + self._file.maps

    def _full(self) -> str:
        """Return the reason why the disk must not be filled further; empty if there is room."""
        free, least = shutil.disk_usage(self._folder).free, self._config.free_bytes_min
        return "" if free >= least else f"{self._folder}: {free} bytes are left on the disk, at least {least} must stay"

    def _make_room(self) -> None:
        """Delete the oldest files until the next one fits into the bound."""
        files = sorted(self._folder.glob(PATTERN), key=lambda path: path.stat().st_mtime_ns)
        sizes = [path.stat().st_size for path in files]
        kept = sum(sizes)
        for path, size in zip(files, sizes, strict=True):
            if kept <= self._config.total_bytes_max - self._config.file_bytes_max:
                break
            path.unlink()
            kept -= size
            logger.info("deleted %s, the oldest recording", path)


def _write(folder: _Folder, run: _Run) -> None:
    """Run the thread: write queued moments until the recording ends."""
    try:
        while (moment := run.waiting.get()) is not None:
            folder.add(moment)
        folder.close()
    except _Stopped as stopped:
        run.reason = str(stopped)
        logger.error("recording has stopped: %s", run.reason)
    except Exception as error:
        # A bug here must not stop the master, so it is logged with its traceback.
        run.reason = f"{type(error).__name__}: {error}"
        logger.exception("recording has stopped")


def _sentence(path: Path, error: OSError) -> str:
    return f"{path}: {error.strerror or error}"
