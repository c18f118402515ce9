# SPDX-License-Identifier: Apache-2.0
"""One capture process in the hands of the unit: begun, listened to, and gone for certain afterwards."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.shared_frames import SharedFrames
from shared.errors import SourceError
from shared.waiting import within

CAPTURE_COMMAND = (sys.executable, "-m", "edge_unit.sources.realsense.capture_process")
"""Takes the descriptor of its end of the link and the id of the process that it must not outlive."""

STOP_S = 1.0
"""For a process that was asked to leave the camera as it should be left."""

KILL_S = 2.0
"""For the kernel to let go of a killed process; one that it holds in a driver is left to it."""

MAX_MESSAGES = 1000
"""Unread; a process tells some twenty a second, and whoever listens does so ten times a second."""


class CaptureSession:
    """A running capture process. `heard` is set whenever something new was heard of it, its end included."""

    def __init__(self, process: asyncio.subprocess.Process, end: socket.socket) -> None:
        self._process = process
        self._end = end
        self._messages: deque[link.Message] = deque(maxlen=MAX_MESSAGES)
        self.heard = asyncio.Event()
        self.gone = False
        self.frames: SharedFrames | None = None
        """Where its frames lie, once `Opened` was heard."""
        asyncio.get_running_loop().add_reader(end, self._read)

    @classmethod
    async def begin(
        cls, request: link.Request | link.Survey, command: Sequence[str] = CAPTURE_COMMAND
    ) -> CaptureSession:
        """Start a process, and ask it.

        Raises:
            SourceError: it cannot be started.
        """
        ours, theirs = link.pair()
        ours.setblocking(False)
        with theirs:
            try:
                process = await asyncio.create_subprocess_exec(
                    *command,
                    str(theirs.fileno()),
                    str(os.getpid()),
                    pass_fds=(theirs.fileno(),),
                    # A process of its own group: what the terminal sends to us is ours to pass on.
                    start_new_session=True,
                    stdin=asyncio.subprocess.DEVNULL,
                    # It computes nothing; a pool of threads would only make it slow to start.
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                )
            except BaseException as error:
                ours.close()
                if isinstance(error, OSError):
                    raise SourceError(f"the capture process cannot be started: {error}") from error
                raise
        session = cls(process, ours)
        session.tell(request)
        return session

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    def tell(self, message: link.Message) -> None:
        """Say something to it; it is gone if it does not hear."""
        with suppress(OSError):
            link.offer(self._end, message)

    def message(self) -> link.Message | None:
        """What it said next; None when there is nothing new."""
        return self._messages.popleft() if self._messages else None

    async def wait(self, timeout_s: float) -> None:
        """Until something new is heard, but no longer than `timeout_s`."""
        await within(timeout_s, self.heard.wait())
        self.heard.clear()

    async def stop(self) -> None:
        """Ask it to end in good order, and see that it does."""
        self.tell(link.Stop())
        await within(STOP_S, self._process.wait())
        await self.kill()

    async def kill(self) -> str:
        """End it whatever it does; returns how it ended, for a person."""
        self._close()
        if self._process.returncode is None:
            # Not by the process object: it would reap the process under asyncio's hands.
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        await within(KILL_S, self._process.wait())
        status = self._process.returncode
        if status is None:
            return f"nothing: process {self.pid} is held in the kernel; unplug the camera"
        return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    async def ended(self) -> str:
        """How a process that has closed its link ended."""
        await within(STOP_S, self._process.wait())
        return await self.kill()

    def _read(self) -> None:
        """Take in all that has come."""
        while True:
            try:
                received = link.receive(self._end)
            except BlockingIOError:
                break
            if received is None:
                self.gone = True
                self._close()
                break
            message, descriptor = received
            if isinstance(message, link.Opened) and descriptor is not None:
                self.frames = _frames(message, descriptor)
            self._messages.append(message)
        self.heard.set()

    def _close(self) -> None:
        if self._end.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self._end)
            self._end.close()


def _frames(opened: link.Opened, descriptor: int) -> SharedFrames:
    shape: tuple[int, ...] = (opened.height, opened.width)
    try:
        if opened.stream == "depth":
            return SharedFrames(descriptor, shape, np.uint16)
        return SharedFrames(descriptor, shape if opened.channels == 1 else (*shape, opened.channels), np.uint8)
    finally:
        os.close(descriptor)
