# SPDX-License-Identifier: Apache-2.0
"""Keeps one stream running: starts a capture process, watches it, and restarts it after each failure.

All of it runs in the event loop and never blocks it; only the other process can hang.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace

from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.capture_session import CAPTURE_COMMAND, CaptureSession
from edge_unit.sources.realsense.shared_frames import SharedFrame, SharedFrames
from edge_unit.sources.realsense.watchdog import Watchdog
from edge_unit.sources.status import SourceState, StatusBoard
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import SourceError
from shared.waiting import within

logger = logging.getLogger(__name__)

TICK_S = 0.1
"""Time between two checks of the process; its messages are received at once."""

LATE_NS = NS_PER_S
"""If this program itself did not run for so long, no process is called stuck for it."""

LOOKING = "it takes images of the calibration board, and no depth meanwhile"

FRUITLESS_MAX = 2
"""A recording that twice in a row delivered no frame will not deliver any."""


class CaptureSupervisor:
    """One stream of one camera or recording: `begin`, perhaps `pause` and `begin` again, `close`."""

    def __init__(
        self,
        request: link.Request,
        board: StatusBoard,
        flowing: SourceState = "live",
        command: Sequence[str] = CAPTURE_COMMAND,
    ) -> None:
        """`flowing` is the state to post on `board` while frames come."""
        self._request = request
        self._board = board
        self._flowing: SourceState = flowing
        self._command = command
        self._watchdog = Watchdog()
        self._task: asyncio.Task[None] | None = None
        self._session: CaptureSession | None = None
        self._frames: SharedFrames | None = None
        self._taken: SharedFrame | None = None
        self._newest = 0
        self._fruitless = 0
        self._known = asyncio.Event()
        self.news = asyncio.Event()
        """Set on a possible new frame, and at the end."""
        self.opened: link.Opened | None = None
        self.finished = False
        """True if no process will be started any more: closed, the recording ended, or `failure` has the reason."""
        self.failure: Exception | None = None

    def begin(self) -> None:
        """Start in the background, or resume after the last frame that was taken."""
        self._board.post("starting")
        self._task = asyncio.create_task(self._run())

    async def first_opened(self, timeout_s: float) -> link.Opened:
        """Return the camera, once it streams.

        Raises:
            SourceError: it does not stream within `timeout_s`; the text has the reason.
        """
        await within(timeout_s, self._known.wait())
        if self.failure is not None:
            raise self.failure
        if self.opened is None:
            reason = self._board.now.reason or "the camera does not start"
            raise SourceError(f"{reason} (waited {timeout_s:g} s)")
        return self.opened

    def take(self) -> SharedFrame | None:
        """Return the newest frame, if it was not taken yet; this releases the frame taken before."""
        after = self._request.number_base if self._taken is None else self._taken.number
        frame = None if self._frames is None else self._frames.take(after)
        if frame is not None:
            self._taken = frame
            self._acknowledge()
        return frame

    @property
    def last_number(self) -> int:
        """The number of the last frame taken."""
        return self._request.number_base if self._taken is None else self._taken.number

    @property
    def pid(self) -> int | None:
        """The id of the current capture process."""
        return None if self._session is None else self._session.pid

    async def frames(self) -> AsyncIterator[SharedFrame]:
        """Yield frames as they come, each valid until the next is requested; ends with the recording, or on `close`.

        Raises:
            SourceError: there will be no more frames.
        """
        while True:
            self.news.clear()
            if (frame := self.take()) is not None:
                yield frame
            elif self.failure is not None:
                raise self.failure
            elif self.finished:
                return
            else:
                await self.news.wait()

    async def pause(self) -> None:
        """End the process, so that the camera is free for another use; `begin` resumes."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def close(self) -> None:
        """End the process and release all its resources."""
        await self.pause()
        self._finish()
        self._frames = None

    # ------------------------------------------------------------------ one process after the other

    async def _run(self) -> None:
        request = self._continued()
        try:
            while True:
                before = self.last_number
                failed = await self._capture(request)
                if failed is None:
                    break
                self._fruitless = 0 if self.last_number > before else self._fruitless + 1
                if failed.final or (request.recording and self._fruitless >= FRUITLESS_MAX):
                    raise SourceError(failed.reason)
                restart = self._watchdog.end(unplugged=failed.unplugged)
                logger.warning("%s; capture restarts in %g s", failed.reason, restart.delay_s)
                self._board.post("restarting", failed.reason)
                await asyncio.sleep(restart.delay_s)
                request = replace(self._continued(), reset=restart.reset and not request.recording)
        except SourceError as error:
            self._fail(error)
        except Exception as error:  # a bug: the reader of the frames must see it
            self._fail(error)
            raise
        self._finish()

    def _fail(self, error: Exception) -> None:
        self.failure = error
        self._board.post("failed", str(error))
        self._finish()

    def _finish(self) -> None:
        self.finished = True
        self._known.set()
        self.news.set()

    def _continued(self) -> link.Request:
        """Return the request that resumes after the last frame taken."""
        taken = self._taken
        if taken is None:
            return self._request
        if not self._request.recording:
            return replace(self._request, number_base=taken.number)
        return replace(
            self._request,
            resume_after=taken.camera_number,
            resume_at_ns=taken.position_ns,
            number_base=taken.number - taken.camera_number,
        )

    async def _capture(self, request: link.Request) -> link.Failed | None:
        """Run one process to its end; returns the failure, None if nothing is left to do."""
        session = self._session = await CaptureSession.begin(request, self._command)
        looked_ns = monotonic_ns()
        self._watchdog.begin(looked_ns)
        try:
            while True:
                await session.wait(TICK_S)
                now_ns = monotonic_ns()
                late, looked_ns = now_ns - looked_ns > LATE_NS, now_ns
                while (message := session.message()) is not None:
                    if isinstance(message, link.Ended):
                        self._board.post("ended")
                        return None
                    if isinstance(message, link.Failed):
                        return message
                    self._receive(message, session, now_ns)
                self._check_for_frame(now_ns)
                if session.gone:
                    return link.Failed(f"the capture process was ended by {await session.ended()}")
                if not late:
                    self._judge(now_ns)
                    if (stuck_s := self._watchdog.stuck_s(now_ns)) is not None:
                        return link.Failed(f"capture hung for {stuck_s:.1f} s while {self._watchdog.phase}")
        except asyncio.CancelledError:
            await session.stop()
            raise
        finally:
            self._session = None
            await session.kill()

    def _receive(self, message: link.Message, session: CaptureSession, now_ns: int) -> None:
        if isinstance(message, link.Opened):
            self._watchdog.stream(now_ns, message.fps)
            self._accept(message)
            self._frames = session.frames
            self._newest = 0
        elif isinstance(message, link.Phase):
            self._watchdog.note_message(now_ns, message.name)
            if message.name == "waiting" and message.reason:
                self._board.post("absent", message.reason)
            elif message.name == "resetting":
                self._board.post("restarting", "the camera's hardware is being reset")
            elif message.name == "starting":
                self._board.post("starting", "the camera is being started")
        else:
            self._watchdog.note_message(now_ns)

    def _accept(self, opened: link.Opened) -> None:
        """Accept a stream that equals the one opened first, or refuse it.

        Raises:
            SourceError: its camera or lens differs: all that was prepared for the first one is void.
        """
        if self.opened is not None and _identity(opened) != _identity(self.opened):
            raise SourceError(
                f"expected the camera {_named(self.opened)}, got {_named(opened)}: the source must be opened again"
            )
        self.opened = opened
        self._known.set()

    def _check_for_frame(self, now_ns: int) -> None:
        """Check for a new frame; its message may have been lost."""
        frames, opened = self._frames, self.opened
        if frames is None or opened is None or self._watchdog.phase != "streaming":
            return
        newest = frames.newest_number
        if newest > self._newest:
            self._newest = newest
            self._watchdog.frame(now_ns)
            self._board.post(self._flowing, LOOKING if self._flowing == "looking" else "", opened.warning)
            self.news.set()
        elif self._request.lockstep:
            # It waits for the reader, or the permission to continue was lost.
            if newest > self.last_number:
                self._watchdog.frame(now_ns)
            else:
                self._acknowledge()

    def _judge(self, now_ns: int) -> None:
        silent_s = self._watchdog.silent_s(now_ns)
        if silent_s is not None and self._watchdog.phase == "streaming":
            self._board.post("silent", "the camera sends no frames")

    def _acknowledge(self) -> None:
        if self._request.lockstep and self._session is not None:
            self._session.send(link.Taken(self.last_number))


def _identity(opened: link.Opened) -> link.Opened:
    """Return the properties that must not change while a source is open."""
    return replace(opened, firmware="", usb="", warning="", fps=0)


def _named(opened: link.Opened) -> str:
    return f"{opened.serial} ({opened.width}x{opened.height})"
