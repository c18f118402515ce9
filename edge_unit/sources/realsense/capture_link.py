# SPDX-License-Identifier: Apache-2.0
"""What a capture process is asked, and what it tells: a message a packet, over a socket that ends with either side.

Both ends are this program, so a message is trusted; one that cannot be read is a bug. Frames do not pass here: they
lie in shared memory, whose file descriptor travels with `Opened`. Kept free of heavy imports, since the capture
process is begun anew whenever the camera makes trouble.
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, TypeAlias

MAX_PACKET_BYTES = 65536
"""Of one message; a survey of ten cameras with all their profiles takes a quarter of it."""

PhaseName = Literal["booting", "waiting", "resetting", "starting", "streaming", "stopping"]
Stream = Literal["depth", "infrared", "color"]


@dataclass(frozen=True)
class Request:
    """What to capture. `serial` and `recording` are empty when not given; `reset` asks for a hardware reset first.

    A recording goes on after the frame `resume_after`, at the position `resume_at_ns`; what it delivers is numbered
    from `number_base`.
    `lockstep` delivers each frame, and waits until it was taken.
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
    """Asks what is there, instead of capturing: answered by `Found`, and that is all."""


@dataclass(frozen=True)
class Taken:
    """The reader has the frame of this number; in lockstep the next may come."""

    number: int


@dataclass(frozen=True)
class Stop:
    """Leave the camera as it should be left, and end."""


@dataclass(frozen=True)
class Phase:
    """What the process is about to do; each phase has a patience of its own."""

    name: PhaseName
    reason: str = ""


@dataclass(frozen=True)
class Alive:
    """Nothing new, but not stuck."""


@dataclass(frozen=True)
class Delivered:
    """A new frame lies in shared memory."""


@dataclass(frozen=True)
class Opened:
    """The stream runs. The descriptor of the shared memory comes along.

    `distortion` has five numbers, `rotation` nine by rows and `translation_m` three: of this stream's frame into the
    depth camera's. `stereo_baseline_m` is 0 where the camera does not tell.
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
    """The recording has come to its end."""


@dataclass(frozen=True)
class Failed:
    """Capture cannot go on; to begin anew would end the same way when it is `final`, and is no matter of course if not.

    `unplugged` tells that nothing is wrong but the plug.
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
    """The message in a packet."""
    values = json.loads(packet)
    kind = KINDS[values.pop("")]
    assert values.keys() == {field.name for field in fields(kind)}
    message: Message = kind(**values)
    return message


def pair() -> tuple[socket.socket, socket.socket]:
    """Two ends of a link; packets keep their borders, and the death of one end is seen at the other."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def send(end: socket.socket, message: Message, descriptor: int | None = None) -> None:
    """Send a message that must arrive, with an open file if there is one; waits while the other end is behind.

    Raises:
        OSError: the other end is gone.
    """
    packet = encode(message)
    socket.send_fds(end, [packet], [] if descriptor is None else [descriptor])


def offer(end: socket.socket, message: Message) -> bool:
    """Send a message that may as well be lost; never waits. Returns whether it was sent.

    Raises:
        OSError: the other end is gone.
    """
    try:
        end.send(encode(message), socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    return True


def receive(end: socket.socket) -> tuple[Message, int | None] | None:
    """The next message and the open file that came along; None when the other end is gone.

    Raises:
        BlockingIOError: there is none, and `end` does not wait.
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
