# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import numpy as np
import pytest

from shared.clock import NS_PER_S, monotonic_ns
from simulation.fleet.controller import Controller
from simulation.world.robot_path import RobotPath

Received = list[tuple[str, str, dict[str, Any]]]


@pytest.fixture
def master() -> Iterator[tuple[str, Received, list[int]]]:
    """Address of a server that takes joints, what it got, and the status of its next answers."""
    received: Received = []
    status = [204]

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_PUT(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            received.append((self.path, self.headers["Authorization"], json.loads(body)))
            self.send_response(status[0])
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", received, status
        server.shutdown()
        thread.join()


def test_it_tells_where_the_robot_is_at_the_time_it_names(master: tuple[str, Received, list[int]]) -> None:
    url, received, _ = master
    path, epoch_ns = RobotPath.demo(), 7 * NS_PER_S
    with closing(Controller(url, "secret", path, epoch_ns)) as controller:
        controller.report(epoch_ns + 1_250_000_000)
    ((where, authorization, body),) = received
    assert (where, authorization) == ("/robot/joints", "Bearer secret")
    assert body["at_ns"] == epoch_ns + 1_250_000_000
    np.testing.assert_allclose(body["positions"], path.joints_at(1.25))
    np.testing.assert_allclose(body["velocities"], path.velocities_at(1.25))


def test_what_comes_late_has_its_own_time(master: tuple[str, Received, list[int]]) -> None:
    url, received, _ = master
    path = RobotPath.demo()
    with closing(Controller(url, "secret", path, 0, late_ns=40_000_000)) as controller:
        controller.report(1_000_000_000)
    ((_, _, body),) = received
    assert body["at_ns"] == 960_000_000
    np.testing.assert_allclose(body["positions"], path.joints_at(0.96))


def test_a_refusal_is_an_error(master: tuple[str, Received, list[int]]) -> None:
    url, _, status = master
    status[0] = 409
    with (
        closing(Controller(url, "secret", RobotPath.demo(), 0)) as controller,
        pytest.raises(http.client.HTTPException, match="409"),
    ):
        controller.report(1)


def test_it_keeps_its_rate_and_goes_on_after_a_refusal(master: tuple[str, Received, list[int]]) -> None:
    url, received, status = master
    status[0] = 503
    stopped = threading.Event()
    began_ns = monotonic_ns()
    with closing(Controller(url, "secret", RobotPath.demo(), began_ns)) as controller:
        thread = threading.Thread(target=controller.run, args=(100.0, stopped))
        thread.start()
        try:
            while not received:
                stopped.wait(0.01)
            status[0] = 204
            while len(received) < 20:
                stopped.wait(0.01)
        finally:
            stopped.set()
            thread.join()
    times_ns = [body["at_ns"] for _, _, body in received[1:]]
    assert (np.diff(times_ns) > 0).all()
    # Not faster than asked for; how much slower depends on the machine.
    assert (times_ns[-1] - times_ns[0]) / NS_PER_S > 0.9 * (len(times_ns) - 1) / 100.0
