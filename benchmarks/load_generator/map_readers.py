# SPDX-License-Identifier: Apache-2.0
"""Two robots that read the map: one polls it, one subscribes to the stream. Both record the time of each map.

`python -m benchmarks.load_generator.map_readers URL TOKEN_FILE POLL_S RESULT` reads until terminated, then writes
RESULT (JSON): a list of `Reading` by reader. It runs on the master's machine and shares its clock. The file
RESULT with the suffix BEGUN appears as soon as both readers have a map.
"""

from __future__ import annotations

import http.client
import json
import signal
import sys
import threading
from abc import abstractmethod
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
import ormsgpack
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from shared.clock import NS_PER_S, monotonic_ns
from shared.files import write_whole
from shared.wire import MEDIA_TYPE

ASKING, LISTENING = "GET /voxels", "WS /stream"

BEGUN = ".begun"

TIMEOUT_S = 2.0
"""Timeout of one answer. A stream that is silent for twice its heartbeat counts as broken."""

RETRY_S = 0.05


class Reading(NamedTuple):
    """Times of one map in ns: requested (for the stream: the end of the message before), made, received, decoded."""

    asked_ns: int
    made_ns: int
    had_ns: int
    decoded_ns: int
    size_bytes: int
    voxels: int
    complete: bool
    oldest_view_age_s: float | None


class Reader(threading.Thread):
    """Reads until stopped, and retries if the master does not answer."""

    def __init__(self, url: str, token: str) -> None:
        super().__init__(daemon=True)
        self._netloc = urlsplit(url).netloc
        self._headers = {"Authorization": f"Bearer {token}"}
        self.stopped, self.begun = threading.Event(), threading.Event()
        self.readings: list[Reading] = []

    def run(self) -> None:
        """See `threading.Thread`."""
        while not self.stopped.is_set():
            try:
                self._read()
            except (OSError, TimeoutError, http.client.HTTPException, WebSocketException) as error:
                print(f"{self.name}: {error}", file=sys.stderr, flush=True)
                self.stopped.wait(RETRY_S)

    @abstractmethod
    def _read(self) -> None:
        """Read over one connection until stopped, or until it fails."""

    def _take(self, asked_ns: int, body: bytes) -> None:
        """Decode a map into what a robot needs: an array of voxels."""
        had_ns = monotonic_ns()
        answer: dict[str, Any] = ormsgpack.unpackb(body)
        voxels = np.array(answer["voxels"], np.int32).reshape(-1, 3)
        decoded_ns = monotonic_ns()
        age_s = answer["oldest_view_age_s"]
        self.readings.append(
            Reading(asked_ns, answer["now_ns"], had_ns, decoded_ns, len(body), len(voxels), answer["complete"], age_s)
        )
        self.begun.set()


class Poller(Reader):
    """Polls every `poll_s`, or as soon as the answer has arrived if that takes longer."""

    def __init__(self, url: str, token: str, poll_s: float) -> None:
        super().__init__(url, token)
        self.name, self._period_ns = ASKING, round(poll_s * NS_PER_S)

    def _read(self) -> None:
        host, _, port = self._netloc.partition(":")
        headers = {**self._headers, "Accept": MEDIA_TYPE}
        with closing(http.client.HTTPConnection(host, int(port), timeout=TIMEOUT_S)) as connection:
            due_ns = monotonic_ns()
            while not self.stopped.wait(max(due_ns - monotonic_ns(), 0) / NS_PER_S):
                asked_ns = monotonic_ns()
                due_ns = max(due_ns + self._period_ns, asked_ns)
                connection.request("GET", "/voxels", headers=headers)
                response = connection.getresponse()
                body = response.read()
                if response.status != http.client.OK:
                    raise http.client.HTTPException(f"{response.status}: {body!r}")
                self._take(asked_ns, body)


class Subscriber(Reader):
    """Receives each message of the stream."""

    def __init__(self, url: str, token: str) -> None:
        super().__init__(url, token)
        self.name = LISTENING

    def _read(self) -> None:
        address = f"ws://{self._netloc}/stream"
        with connect(address, additional_headers=self._headers, proxy=None, compression=None, max_size=None) as stream:
            ready_ns = monotonic_ns()
            while not self.stopped.is_set():
                body = stream.recv(TIMEOUT_S)
                if isinstance(body, bytes):
                    self._take(ready_ns, body)
                ready_ns = monotonic_ns()


def read(path: Path) -> dict[str, list[Reading]]:
    """Return the readings in a result file."""
    return {name: [Reading(*row) for row in rows] for name, rows in json.loads(path.read_text()).items()}


def main() -> None:
    """Read until terminated."""
    url, token, poll_s, result = sys.argv[1], Path(sys.argv[2]).read_text().strip(), float(sys.argv[3]), sys.argv[4]
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    signal.signal(signal.SIGTERM, stop)
    readers = (Poller(url, token, poll_s), Subscriber(url, token))
    for reader in readers:
        reader.start()
    for reader in readers:
        while not stopped.is_set() and not reader.begun.wait(RETRY_S):
            continue
    Path(result + BEGUN).touch()
    stopped.wait()
    for reader in readers:
        reader.stopped.set()
    for reader in readers:
        reader.join()
    readings = json.dumps({reader.name: reader.readings for reader in readers})
    write_whole(Path(result), readings.encode(), synced=False)


if __name__ == "__main__":
    main()
