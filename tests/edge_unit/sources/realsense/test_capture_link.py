# SPDX-License-Identifier: Apache-2.0
"""The link to a capture process, and the handle of the process."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator

import pytest

from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.capture_session import CaptureSession
from shared.errors import SourceError

MESSAGES = [
    link.Request(stream="color", serial="1", recording="a b.db3", resume_after=7, lockstep=True),
    link.Survey(),
    link.Taken(2**40),
    link.Stop(),
    link.Phase("waiting", "no camera – none"),
    link.Alive(),
    link.Delivered(),
    link.Opened(
        "depth", "1", "D435", "5.16", "3.2", "", 848, 480, 1, 15, 424.0, 424.0, 423.5, 239.5, "brown_conrady",
        [0.0] * 5, [1.0] * 9, [0.0] * 3, 0.001, 0.05,
    ),
    link.Ended(),
    link.Failed("unplugged", unplugged=True),
    link.Found("2.59.1", "the system", [{"serial": "1", "usb": "2.1"}]),
]  # fmt: skip


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = link.pair()
    with ours, theirs:
        yield ours, theirs


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_every_message_arrives_as_it_was(ends: tuple[socket.socket, socket.socket], message: link.Message) -> None:
    link.send(ends[0], message)
    assert link.receive(ends[1]) == (message, None)


def test_every_kind_of_message_is_tested() -> None:
    assert {type(message).__name__ for message in MESSAGES} == set(link.KINDS)


def test_an_open_file_comes_along(ends: tuple[socket.socket, socket.socket]) -> None:
    read_end, write_end = os.pipe()
    link.send(ends[0], link.Alive(), write_end)
    os.close(write_end)
    received = link.receive(ends[1])
    assert received is not None
    assert received[1] is not None
    os.write(received[1], b"through")
    assert os.read(read_end, 10) == b"through"
    os.close(received[1])
    os.close(read_end)


def test_optional_messages_are_dropped_without_a_reader_and_packets_keep_their_borders(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    sent = 0
    while link.offer(ends[0], link.Taken(sent)):
        sent += 1
    assert 50 < sent < 100_000
    for number in range(sent):
        assert link.receive(ends[1]) == (link.Taken(number), None)


def test_the_death_of_one_end_is_seen_at_the_other(ends: tuple[socket.socket, socket.socket]) -> None:
    link.send(ends[0], link.Ended())
    ends[0].close()
    assert link.receive(ends[1]) == (link.Ended(), None)
    assert link.receive(ends[1]) is None
    with pytest.raises(OSError, match="Broken pipe"):
        link.offer(ends[1], link.Stop())


async def test_a_process_that_cannot_be_started_is_an_error() -> None:
    with pytest.raises(SourceError, match=r"the capture process cannot be started: .*nowhere"):
        await CaptureSession.begin(link.Survey(), ("/nowhere/python",))


@pytest.mark.parametrize(
    ("script", "how"), [("raise SystemExit(3)", "exit status 3"), ("import os; os.kill(os.getpid(), 11)", "SIGSEGV")]
)
async def test_the_end_of_a_process_is_described(script: str, how: str) -> None:
    session = await CaptureSession.begin(link.Survey(), (sys.executable, "-c", script))
    for _ in range(100):
        await session.wait(0.1)
        if session.gone:
            break
    assert how in await session.ended()
    # There is no receiver, and that is not an error.
    session.send(link.Stop())


async def test_a_process_that_does_not_stop_is_killed() -> None:
    session = await CaptureSession.begin(link.Survey(), (sys.executable, "-c", "import time; time.sleep(60)"))
    await session.stop()
    assert "SIGKILL" in await session.kill()
