# SPDX-License-Identifier: Apache-2.0
"""The robot's controller: reports the robot's joints to the master 125 times a second, as a real one does.

It runs in its own process: `python -m simulation.fleet.controller --url URL --token-file FILE --epoch-ns N`.
"""

from __future__ import annotations

import argparse
import http.client
import json
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import FrameType
from urllib.parse import urlsplit

from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from simulation.world.robot_path import RobotPath

RATE_HZ = 125.0
"""Reports a second of a UR robot of the last generation but one; newer ones send 500."""

TIMEOUT_S = 1.0
"""Timeout for one answer of the master."""

RETRY_S = 0.2
"""Time between attempts to reach a master that is gone."""


class Controller:
    """Drives a simulated robot along its path and reports its joints to a master on the same machine."""

    def __init__(self, url: str, token: str, path: RobotPath, epoch_ns: int, late_ns: int = 0) -> None:
        """`epoch_ns` is the CLOCK_MONOTONIC at which the path's time is 0. Each report is `late_ns` old."""
        parts = urlsplit(url)
        self._connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=TIMEOUT_S)
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        self._path = path
        self._epoch_ns = epoch_ns
        self._late_ns = late_ns

    def report(self, now_ns: int) -> None:
        """Report the joints at `now_ns` less `late_ns`.

        Raises:
            OSError: the master cannot be reached.
            http.client.HTTPException: the master refused the report, or sent no valid answer.
        """
        at_ns = now_ns - self._late_ns
        t_s = (at_ns - self._epoch_ns) / NS_PER_S
        body = {
            "positions": self._path.joints_at(t_s).tolist(),
            "velocities": self._path.velocities_at(t_s).tolist(),
            # Both processes run on one machine and share its clock.
            "at_ns": at_ns,
        }
        self._connection.request("PUT", "/robot/joints", json.dumps(body), self._headers)
        answer = self._connection.getresponse()
        text = answer.read()
        if answer.status >= 400:
            raise http.client.HTTPException(f"{answer.status}: {text.decode('utf-8', 'replace')}")

    def run(self, rate_hz: float, stopped: threading.Event) -> None:
        """Report at `rate_hz` until `stopped` is set. A report that was missed is not sent later."""
        period_ns = round(NS_PER_S / rate_hz)
        due_ns = monotonic_ns()
        while not stopped.wait(max(due_ns - monotonic_ns(), 0) / NS_PER_S):
            now_ns = monotonic_ns()
            due_ns = max(due_ns + period_ns, now_ns)
            try:
                self.report(now_ns)
            except (OSError, http.client.HTTPException) as error:
                print(f"controller: {error}", file=sys.stderr, flush=True)
                self._connection.close()
                due_ns = now_ns + round(RETRY_S * NS_PER_S)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until a signal stops the process."""
    options = _parser().parse_args(arguments)
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    token = options.token_file.read_text(encoding="ascii").strip()
    path, late_ns = RobotPath.demo(options.speed), round(options.late_ms * NS_PER_MS)
    with closing(Controller(options.url, token, path, options.epoch_ns, late_ns)) as controller:
        controller.run(options.rate, stopped)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simulation.fleet.controller", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--url", required=True, help="URL of the master, as in http://127.0.0.1:8420")
    parser.add_argument("--token-file", type=Path, required=True, help="file with the operator's token")
    parser.add_argument(
        "--epoch-ns", type=int, default=0, help="CLOCK_MONOTONIC in ns at which the path begins (default: 0)"
    )
    parser.add_argument("--rate", type=float, default=RATE_HZ, help=f"reports a second (default: {RATE_HZ:g})")
    parser.add_argument("--speed", type=float, default=1.0, help="factor on the robot's speed (default: 1)")
    parser.add_argument(
        "--late-ms", type=float, default=0.0, help="age of each report; its `at_ns` says so (default: 0)"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
