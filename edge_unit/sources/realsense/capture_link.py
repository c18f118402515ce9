# SPDX-License-Identifier: Apache-2.0
"""Messages to and from a capture process: one message a packet, over a socket that closes with either side.

Both ends are this program, so messages are trusted; an unreadable one is a bug. Frames do not pass here: they lie in
shared memory, whose file descriptor travels with `Opened`. Heavy imports are avoided, as the capture process restarts
at each failure of the camera.
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, TypeAlias

MAX_PACKET_BYTES = 65536
"""Size limit of one message; a survey of ten cameras with all their profiles takes a quarter of it."""

PhaseName = Literal["booting", "waiting", "resetting", "starting", "streaming", "stopping"]
Stream = Literal["depth", "infrared", "color"]


@dataclass(frozen=True)
class Request:
    """The stream to capture. `serial` and `recording` are empty if not given; `reset` requests a hardware reset first.

    A recording resumes after the frame `resume_after`, at the position `resume_at_ns`; its frames are numbered from
    `number_base`.
    `lockstep` delivers each frame, and waits until the reader has taken it.
    """

    stream: Stream = "depth"
    serial: str = ""
    recording: str = ""
    width: int = 848
    height: int = 480
    fps: int = 15
    latency_ns: int = 0
    lockstep: bool = False
    loop: bool = False
    reset: bool = False
    resume_after: int = 0
    resume_at_ns: int = 0
    number_base: int = 0


@dataclass(frozen=True)
class Survey:
    """Request a list of the cameras, without capture; the only answer is `Found`."""


@dataclass(frozen=True)
class Taken:
    """The reader took the frame of this number; in lockstep the next may follow."""

    number: int


@dataclass(frozen=True)
class Stop:
    """Leave the camera in its proper state, and end."""


@dataclass(frozen=True)
class Phase:
    """The next step of the process; each phase has its own time limit."""

    name: PhaseName
    reason: str = ""


@dataclass(frozen=True)
class Alive:
    """A sign of life without news."""


@dataclass(frozen=True)
class Delivered:
    """A new frame in shared memory."""


@dataclass(frozen=True)
class Opened:
    """The stream runs. The descriptor of the shared memory travels with this message.

    `distortion` has five numbers. `rotation` (nine, by rows) and `translation_m` (three) map this stream's frame to the
    depth camera's. `stereo_baseline_m` is 0 if the camera does not report it.
    """

    stream: Stream
    serial: str
    model: str
    firmware: str
    usb: str
    warning: str
    width: int
    height: int
    channels: int
    fps: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str
    distortion: list[float]
    rotation: list[float]
    translation_m: list[float]
    depth_scale_m: float
    stereo_baseline_m: float


@dataclass(frozen=True)
class Ended:
    """The end of the recording."""


@dataclass(frozen=True)
class Failed:
    """Capture failed; a new process would fail in the same way if `final`.

    `unplugged` means that only the plug is the cause.
    """

    reason: str
    final: bool = False
    unplugged: bool = False


@dataclass(frozen=True)
class Found:
    """The SDK, whose libusb it uses, and the cameras that it sees; `devices` are dictionaries of plain values."""

    sdk: str
    libusb: str
    devices: list[dict[str, Any]]


Message: TypeAlias = Request | Survey | Taken | Stop | Phase | Alive | Delivered | Opened | Ended | Failed | Found
KINDS: dict[str, type[Any]] = {
    kind.__name__: kind
    for kind in (Request, Survey, Taken, Stop, Phase, Alive, Delivered, Opened, Ended, Failed, Found)
}


def encode(message: Message) -> bytes:
    """One packet."""
    return json.dumps({"": type(message).__name__, **asdict(message)}).encode()


def decode(packet: bytes) -> Message:
    """Decode the message in a packet."""
    values = json.loads(packet)
    kind = KINDS[values.pop("")]
    assert values.keys() == {field.name for field in fields(kind)}
    message: Message = kind(**values)
    return message


def pair() -> tuple[socket.socket, socket.socket]:
    """Return two ends of a link; packets keep their borders, and each end detects the death of the other."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def send(end: socket.socket, message: Message, descriptor: int | None = None) -> None:
    """Send a message that must arrive, with an open file if given; waits while the other end is slow.

    Raises:
        OSError: the other end is gone.
    """
    packet = encode(message)
    socket.send_fds(end, [packet], [] if descriptor is None else [descriptor])


def offer(end: socket.socket, message: Message) -> bool:
    """Send a message that may be lost; never waits. Returns True if it was sent.

    Raises:
        OSError: the other end is gone.
    """
    try:
        end.send(encode(message), socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    return True


def receive(end: socket.socket) -> tuple[Message, int | None] | None:
    """Receive the next message and its open file; None if the other end is gone.

    Raises:
        BlockingIOError: there is no message, and `end` does not block.
    """
    try:
        packet, descriptors, _, _ = socket.recv_fds(end, MAX_PACKET_BYTES, 1)
    except ConnectionResetError:
        return None
    if not packet:
        return None
    for descriptor in descriptors[1:]:
        os.close(descriptor)
    return decode(packet), descriptors[0] if descriptors else None
