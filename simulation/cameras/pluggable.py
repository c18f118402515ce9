# SPDX-License-Identifier: Apache-2.0
"""RealSense cameras that can be plugged in and out, as file devices on the SDK's context.

A file lists the recordings that are plugged in, one path a line. Everything except the sockets is the unit's real
capture process, so a unit's reaction to cameras that come and go is tested for real.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.capture import Capture
from edge_unit.sources.realsense.capture_process import main
from edge_unit.sources.realsense.sdk import rs
from shared.files import write_whole

POLL_S = 0.02


def command(sockets: Path) -> tuple[str, ...]:
    """Return the capture command of a `RealsenseSource` whose cameras are those of the file `sockets`."""
    return sys.executable, "-m", "simulation.cameras.pluggable", str(sockets)


def plug(sockets: Path, recordings: Iterable[Path]) -> None:
    """Plug in these recordings, and unplug all others."""
    write_whole(sockets, "".join(f"{recording}\n" for recording in recordings).encode(), synced=False)


class Sockets:
    """The plugged-in devices of a context."""

    def __init__(self, sockets: Path, context: rs.context) -> None:
        self._sockets = sockets
        self._context = context
        self._plugged: dict[str, object] = {}

    def look(self) -> None:
        """Plug and unplug devices according to the file."""
        wanted = self._sockets.read_text().split() if self._sockets.is_file() else []
        for path in self._plugged.keys() - set(wanted):
            self._context.unload_device(path)
            del self._plugged[path]
        for path in set(wanted) - self._plugged.keys():
            # The SDK drops a device that has no reference.
            self._plugged[path] = self._context.load_device(path)

    def follow(self) -> None:
        """Poll the file for ever."""
        pause = threading.Event()
        while not pause.wait(POLL_S):
            self.look()


def serve(end: socket.socket) -> None:
    """Capture from the plugged-in cameras; a recording starts again at its end, since a camera does not end."""
    received = link.receive(end)
    if received is None or not isinstance(received[0], link.Request):
        return
    context = rs.context()
    sockets = Sockets(Path(sys.argv[1]), context)
    sockets.look()
    capture = Capture(end, replace(received[0], loop=True), context)
    threading.Thread(target=sockets.follow, name="sockets", daemon=True).start()
    capture.run()


if __name__ == "__main__":
    main(int(sys.argv[2]), int(sys.argv[3]), serve)
