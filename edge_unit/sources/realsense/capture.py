# SPDX-License-Identifier: Apache-2.0
"""Captures one stream: finds the camera, streams, ends on any failure, and reports all of it over the link.

It runs in a process of its own (`capture_process`). The only recovery from any failure is a new process.
"""

from __future__ import annotations

import os
import socket
import threading
from typing import Any

import numpy as np

from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.devices import Devices, RecordingBroken, Unplugged, survey
from edge_unit.sources.realsense.sdk import LIBUSB_OF, rs
from edge_unit.sources.realsense.shared_frames import SharedFrames
from edge_unit.sources.realsense.stream import Reading, SdkStream
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import SourceEnded, SourceError

READ_S = 0.1
"""Limit of one wait for a frame; then the reader gets a sign of life."""

ALIVE_EVERY_NS = 100 * NS_PER_MS

FIRST_FRAME_S = 6.0
"""Time for the first frame of a stream: cameras settle their exposure first, some for seconds."""

SILENCE_S = 2.0
SILENCE_PERIODS = 4
"""Time without a frame after the first: the stream is stuck, and waiting longer was never seen to help."""

CUT_SHORT_S = 0.5
"""Remaining time at the end of a recording: far more than the gap between its last frame and its end."""


class Capture:
    """One run: from the search for the camera to its end or failure."""

    def __init__(self, end: socket.socket, request: link.Request, context: rs.context) -> None:
        self._end = end
        self._request = request
        self._devices = Devices(context, request)
        self._stop = threading.Event()
        self._taken = threading.Condition()
        self._taken_number = 0
        self._told_ns = 0

    def run(self) -> None:
        """Capture until stopped. Each failure is reported over the link."""
        threading.Thread(target=self._listen, name="link", daemon=True).start()
        try:
            self._send(link.Phase("waiting"))
            device = self._wait_for_device()
            if device is not None:
                if self._request.reset:
                    self._send(link.Phase("resetting"))
                    device = self._devices.reset(device)
                self._send(link.Phase("starting"))
                self._stream(SdkStream(device, self._request))
        except SourceEnded:
            self._send(link.Ended())
        except RecordingBroken as error:
            self._send(link.Failed(str(error), final=True))
        except SourceError as error:
            self._send(link.Failed(str(error), unplugged=isinstance(error, Unplugged)))

    def _wait_for_device(self) -> Any:
        """Return the device, or None if it is no longer needed."""
        logged = ""
        while not self._stop.is_set():
            device, reason = self._devices.find()
            if device is not None:
                return device
            if reason != logged:
                self._send(link.Phase("waiting", reason))
                logged = reason
            self._alive()
            self._devices.wait()
        return None

    def _stream(self, stream: SdkStream) -> None:
        """Pass frames on until the stream ends or the reader stops."""
        opened = stream.start()
        shape: tuple[int, ...] = (opened.height, opened.width)
        shape += (opened.channels,) if opened.channels > 1 else ()
        dtype = np.uint16 if self._request.stream == "depth" else np.uint8
        descriptor = SharedFrames.create(shape, dtype)
        frames = SharedFrames(descriptor, shape, dtype)
        link.send(self._end, opened, descriptor)
        os.close(descriptor)
        base, last = self._request.number_base, self._request.resume_after
        silence_ns = round(max(SILENCE_S, SILENCE_PERIODS / max(opened.fps, 1)) * NS_PER_S)
        deadline_ns = monotonic_ns() + round(FIRST_FRAME_S * NS_PER_S)
        while not self._stop.is_set():
            if self._devices.removed.is_set():
                raise Unplugged(f"camera {opened.serial} was unplugged")
            try:
                reading = stream.read(READ_S)
            except SourceEnded:
                self._check_complete(stream.left_out_s, last)
                if not self._request.loop:
                    raise
                base += last
                stream.rewind()
                continue
            if reading is not None:
                last = reading.camera_number
                self._deliver(frames, reading, base + last)
                deadline_ns = monotonic_ns() + silence_ns
            elif monotonic_ns() > deadline_ns:
                raise SourceError(f"camera {opened.serial} stopped sending frames")
            self._alive()
        stream.stop()

    def _deliver(self, frames: SharedFrames, reading: Reading, number: int) -> None:
        frames.write(reading.pixels, number, reading.camera_number, reading.captured_at_ns, reading.position_ns)
        link.offer(self._end, link.Delivered())
        with self._taken:
            while self._request.lockstep and self._taken_number < number and not self._stop.is_set():
                # The reader may be busy for long, and the earlier message may be lost.
                if not self._taken.wait(READ_S):
                    link.offer(self._end, link.Delivered())

    def _check_complete(self, left_out_s: float, last: int) -> None:
        """Raise SourceError if the recording ended early: the SDK does not report a recording that it cannot read."""
        if left_out_s > CUT_SHORT_S:
            raise RecordingBroken(
                f"{self._request.recording}: cannot be read beyond frame {last}, "
                f"{left_out_s:.1f} s before its end; it may be damaged"
            )

    def _alive(self) -> None:
        if monotonic_ns() - self._told_ns > ALIVE_EVERY_NS:
            self._told_ns = monotonic_ns()
            link.offer(self._end, link.Alive())

    def _send(self, message: link.Message) -> None:
        link.send(self._end, message)

    def _listen(self) -> None:
        """Receive messages, and exit when the other end is gone: this ends even a process with a hung main thread."""
        while (received := link.receive(self._end)) is not None:
            message, _ = received
            with self._taken:
                if isinstance(message, link.Taken):
                    self._taken_number = message.number
                elif isinstance(message, link.Stop):
                    self._stop.set()
                self._taken.notify_all()
        os._exit(0)


def serve(end: socket.socket) -> None:
    """Serve the first message of the link."""
    context = rs.context()
    received = link.receive(end)
    request = received[0] if received is not None else None
    if isinstance(request, link.Survey):
        link.send(end, link.Found(rs.__version__, LIBUSB_OF, survey(context)))
    elif isinstance(request, link.Request):
        Capture(end, request, context).run()
