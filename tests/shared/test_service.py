# SPDX-License-Identifier: Apache-2.0
"""What a service manager hears, over a socket of its own."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from shared.service import MAX_STATUS, ServiceManager

pytestmark = pytest.mark.alone


class Manager:
    """A service manager's end of the socket."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.settimeout(5.0)
        self.environment = {"NOTIFY_SOCKET": address}

    def hear(self) -> dict[str, str]:
        lines = self.socket.recv(4096).decode().split("\n")
        return dict(line.split("=", 1) for line in lines)


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    found = Manager(str(tmp_path / "notify") if request.param == "path" else f"@cellwatch-test-{os.getpid()}")
    yield found
    found.socket.close()


def test_what_is_told(manager: Manager) -> None:
    service = ServiceManager(manager.environment)
    assert service.listens
    service.ready("camera: none\nREADY=0; no master")
    assert manager.hear() == {"READY": "1", "STATUS": "camera: none READY=0; no master"}
    service.alive("x" * 9000)
    assert manager.hear() == {"WATCHDOG": "1", "STATUS": "x" * MAX_STATUS}
    service.hangs("frame 3 hangs")
    assert manager.hear() == {"STATUS": "frame 3 hangs", "WATCHDOG": "trigger"}
    service.stopping()
    assert manager.hear() == {"STOPPING": "1", "STATUS": "stopping"}


def test_without_a_manager_nobody_is_told() -> None:
    service = ServiceManager({})
    assert not service.listens
    assert service.watchdog_s is None
    service.ready("here")


def test_a_manager_that_is_gone_or_reads_nothing_holds_nobody_up(tmp_path: Path) -> None:
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "nobody")}).alive("here")
    manager = Manager(str(tmp_path / "notify"))
    service = ServiceManager(manager.environment)
    for _ in range(2000):
        service.alive("here")
    assert manager.hear()["WATCHDOG"] == "1"
    manager.socket.close()


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "10000000"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "7"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "8"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_whether_it_watches(variables: dict[str, str], expected: float | None) -> None:
    assert ServiceManager({"NOTIFY_SOCKET": "/nowhere", **variables}, pid=7).watchdog_s == expected
    assert ServiceManager(variables, pid=7).watchdog_s is None


async def test_what_hangs_at_two_looks_is_not_fed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    manager = Manager(str(tmp_path / "notify"))
    looks = iter([None, "frame 1 hangs", None, "frame 2 hangs", "frame 2 hangs", None])
    service = ServiceManager({**manager.environment, "WATCHDOG_USEC": "40000"})
    task = asyncio.create_task(service.follow(lambda: "live", lambda: next(looks)))
    with caplog.at_level(logging.ERROR), suppress(StopIteration, RuntimeError):
        await task
    heard = [manager.hear()["WATCHDOG"] for _ in range(4)]
    assert heard == ["1", "1", "trigger", "1"]
    assert [record.message for record in caplog.records] == ["frame 2 hangs"]
    manager.socket.close()


async def test_it_is_silent_once_cancelled(tmp_path: Path) -> None:
    manager = Manager(str(tmp_path / "notify"))
    service = ServiceManager({**manager.environment, "WATCHDOG_USEC": "40000"})
    task = asyncio.create_task(service.follow(lambda: "live"))
    await asyncio.sleep(0)
    assert (await asyncio.to_thread(manager.hear))["WATCHDOG"] == "1"
    assert (await asyncio.to_thread(manager.hear))["STATUS"] == "live"
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
    manager.socket.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            manager.hear()
    with pytest.raises(BlockingIOError):
        manager.hear()
    manager.socket.close()
