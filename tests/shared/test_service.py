# SPDX-License-Identifier: Apache-2.0
"""Messages to a service manager, received on a socket of the test."""

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

    def receive(self) -> dict[str, str]:
        lines = self.socket.recv(4096).decode().split("\n")
        return dict(line.split("=", 1) for line in lines)


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    found = Manager(str(tmp_path / "notify") if request.param == "path" else f"@cellwatch-test-{os.getpid()}")
    yield found
    found.socket.close()


def test_messages_to_the_manager(manager: Manager) -> None:
    service = ServiceManager(manager.environment)
    assert service.is_present
    service.ready("camera: none\nREADY=0; no master")
    assert manager.receive() == {"READY": "1", "STATUS": "camera: none READY=0; no master"}
    service.alive("x" * 9000)
    assert manager.receive() == {"WATCHDOG": "1", "STATUS": "x" * MAX_STATUS}
    service.trigger_watchdog("frame 3 hangs")
    assert manager.receive() == {"STATUS": "frame 3 hangs", "WATCHDOG": "trigger"}
    service.stopping()
    assert manager.receive() == {"STOPPING": "1", "STATUS": "stopping"}


def test_no_message_without_a_manager() -> None:
    service = ServiceManager({})
    assert not service.is_present
    assert service.watchdog_s is None
    service.ready("here")


def test_a_manager_that_is_gone_or_does_not_read_never_blocks(tmp_path: Path) -> None:
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "nobody")}).alive("here")
    manager = Manager(str(tmp_path / "notify"))
    service = ServiceManager(manager.environment)
    for _ in range(2000):
        service.alive("here")
    assert manager.receive()["WATCHDOG"] == "1"
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
def test_watchdog_limit(variables: dict[str, str], expected: float | None) -> None:
    assert ServiceManager({"NOTIFY_SOCKET": "/nowhere", **variables}, pid=7).watchdog_s == expected
    assert ServiceManager(variables, pid=7).watchdog_s is None


async def test_the_watchdog_is_triggered_when_two_checks_in_a_row_fail(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    manager = Manager(str(tmp_path / "notify"))
    checks = iter([None, "frame 1 hangs", None, "frame 2 hangs", "frame 2 hangs", None])
    service = ServiceManager({**manager.environment, "WATCHDOG_USEC": "40000"})
    task = asyncio.create_task(service.follow(lambda: "live", lambda: next(checks)))
    with caplog.at_level(logging.ERROR), suppress(StopIteration, RuntimeError):
        await task
    heard = [manager.receive()["WATCHDOG"] for _ in range(4)]
    assert heard == ["1", "1", "trigger", "1"]
    assert [record.message for record in caplog.records] == ["frame 2 hangs"]
    manager.socket.close()


async def test_no_message_after_cancellation(tmp_path: Path) -> None:
    manager = Manager(str(tmp_path / "notify"))
    service = ServiceManager({**manager.environment, "WATCHDOG_USEC": "40000"})
    task = asyncio.create_task(service.follow(lambda: "live"))
    await asyncio.sleep(0)
    assert (await asyncio.to_thread(manager.receive))["WATCHDOG"] == "1"
    assert (await asyncio.to_thread(manager.receive))["STATUS"] == "live"
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
    manager.socket.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            manager.receive()
    with pytest.raises(BlockingIOError):
        manager.receive()
    manager.socket.close()
