# SPDX-License-Identifier: Apache-2.0
"""Handle of one capture process in the unit: starts it, receives its messages, and makes sure that it ends."""

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
"""Takes the descriptor of its end of the link and the id of its parent, which it must not outlive."""

STOP_S = 1.0
"""Time for a stopped process to leave the camera in its proper state."""

KILL_S = 2.0
"""Time for the kernel to end a killed process; one that hangs in a driver is left behind."""

MAX_MESSAGES = 1000
"""Unread messages; a process sends some twenty a second, and the unit reads ten times a second."""


class CaptureSession:
    """A running capture process. `heard` is set at each new message, and at its end."""

    def __init__(self, process: asyncio.subprocess.Process, end: socket.socket) -> None:
        self._process = process
        self._end = end
        self._messages: deque[link.Message] = deque(maxlen=MAX_MESSAGES)
        self.heard = asyncio.Event()
        self.gone = False
        self.frames: SharedFrames | None = None
        """Its shared frames, after `Opened`."""
        asyncio.get_running_loop().add_reader(end, self._read)

    @classmethod
    async def begin(
        cls, request: link.Request | link.Survey, command: Sequence[str] = CAPTURE_COMMAND
    ) -> CaptureSession:
        """Start a process, and send it the request.

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
                    # A process group of its own: the unit itself passes on the terminal's signals.
                    start_new_session=True,
                    stdin=asyncio.subprocess.DEVNULL,
                    # It computes nothing; thread pools would only slow down its start.
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                )
            except BaseException as error:
                ours.close()
                if isinstance(error, OSError):
                    raise SourceError(f"the capture process cannot be started: {error}") from error
                raise
        session = cls(process, ours)
        session.send(request)
        return session

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    def send(self, message: link.Message) -> None:
        """Send it a message; a process that cannot receive is gone."""
        with suppress(OSError):
            link.offer(self._end, message)

    def message(self) -> link.Message | None:
        """Return its next message; None if there is none."""
        return self._messages.popleft() if self._messages else None

    async def wait(self, timeout_s: float) -> None:
        """Wait for a new message, at most `timeout_s`."""
        await within(timeout_s, self.heard.wait())
        self.heard.clear()

    async def stop(self) -> None:
        """Stop it in good order, and make sure that it ends."""
        self.send(link.Stop())
        await within(STOP_S, self._process.wait())
        await self.kill()

    async def kill(self) -> str:
        """Kill it in any state; returns a text on how it ended, for a person."""
        self._close()
        if self._process.returncode is None:
            # Not by the process object, which would reap the process before asyncio does.
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        await within(KILL_S, self._process.wait())
        status = self._process.returncode
        if status is None:
            return f"nothing: process {self.pid} is held in the kernel; unplug the camera"
        return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"

    async def ended(self) -> str:
        """Return a text on how a process ended that has closed its link."""
        await within(STOP_S, self._process.wait())
        return await self.kill()

    def _read(self) -> None:
        """Receive all waiting messages."""
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
