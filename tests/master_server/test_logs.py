# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import json
import logging
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from master_server import logs
from master_server.logs import BURST, MAX_SOURCES, LogFormat, Repeats, configure, redacted
from tests.master_server.fakes import MS, START_NS, S, joined, master

TOKEN = "Zk3-example_token.0123456789"
Configure = Callable[[LogFormat], io.StringIO]


@pytest.fixture
def configured(monkeypatch: pytest.MonkeyPatch) -> Iterator[Configure]:
    """Yield a function that configures the log for one test and returns the stream that it writes to."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def begin(form: LogFormat) -> io.StringIO:
        written = io.StringIO()
        monkeypatch.setattr("sys.stderr", written)
        # Remove pytest's own handlers: logging would count as already set up.
        root.handlers.clear()
        configure("INFO", form)
        return written

    yield begin
    root.handlers[:] = handlers
    root.setLevel(level)


def parsed(written: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in written.getvalue().splitlines()]


def test_a_line_of_json_has_source_and_event(configured: Configure) -> None:
    written = configured("json")
    one = master()
    unit = joined(one)
    unit.update(START_NS + S, [1])
    one.tick(START_NS + 3 * S)
    lines = parsed(written)
    assert [(line["event"], line.get("state")) for line in lines] == [
        ("pose", None), ("state", "live"), ("state", "stale"),
    ]  # fmt: skip
    last = lines[-1]
    assert (last["level"], last["logger"], last["unit_id"], last["ip"]) == (
        "WARNING", "master_server.core.units", 1, "10.0.0.1",
    )  # fmt: skip
    assert last["message"] == f"unit 1 (10.0.0.1): live → stale: {last['reason']}"
    assert last["time"].endswith("+00:00")


def test_a_line_of_text_is_for_people(configured: Configure) -> None:
    written = configured("text")
    logging.getLogger("master_server.logs").info("unit %d: it works", 3, extra={"event": "e", "unit_id": 3})
    assert written.getvalue().endswith(" INFO master_server.logs: unit 3: it works\n")


def test_a_traceback_is_one_line_of_json(configured: Configure) -> None:
    written = configured("json")
    try:
        raise RuntimeError(f"Bearer {TOKEN}")
    except RuntimeError:
        logging.getLogger("x").exception("a fault")
    (line,) = parsed(written)
    assert "RuntimeError" in line["traceback"]
    assert TOKEN not in line["traceback"]


@pytest.mark.parametrize("form", ["text", "json"])
@pytest.mark.parametrize(
    "message",
    [
        f"< Authorization: Bearer {TOKEN}",
        f"< authorization: bearer {TOKEN}",
        f"< Sec-WebSocket-Protocol: cellwatch, bearer.{TOKEN}, x",
        f'1.2.3.4:5 - "WebSocket /stream?form=keys&token={TOKEN}&x=1" 400',
        f"GET /stream?token={TOKEN} HTTP/1.1",
        f"{{'authorization': 'Bearer {TOKEN}'}}",
        "GET /stream?token=short HTTP/1.1",
        f"GET /x?a=Bearer%20{TOKEN}",
    ],
)
def test_no_token_is_written(configured: Configure, form: LogFormat, message: str) -> None:
    written = configured(form)
    logging.getLogger("uvicorn.asgi").info("%s", message)
    assert "***" in written.getvalue()
    assert TOKEN not in written.getvalue()
    assert "short" not in written.getvalue()
    if form == "json":
        parsed(written)


def test_other_text_is_not_redacted() -> None:
    line = "no bearer token: expected the header 'Authorization: Bearer <token>'; made the unit token in /var/x"
    assert redacted(line) == line


def test_the_web_servers_lines_on_readers_are_the_streams_own(configured: Configure) -> None:
    written = configured("text")
    logging.getLogger("uvicorn.error").info('%s - "WebSocket %s" [accepted]', "1.2.3.4", "/stream")
    assert written.getvalue() == ""
    logging.getLogger("uvicorn.error").info("started")
    assert "uvicorn.error: started" in written.getvalue()


def record(event: str | None, ip: str = "10.0.0.1", text: str = "%s") -> logging.LogRecord:
    found = logging.LogRecord("x", logging.WARNING, "", 0, text, ("off",), None)
    if event is not None:
        found.event, found.ip = event, ip
    return found


def test_repeated_lines_are_written_a_few_times_and_then_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = START_NS
    monkeypatch.setattr(logs, "monotonic_ns", lambda: now_ns)
    repeats = Repeats()
    passed = sum(repeats.filter(record("state")) for _ in range(BURST + 7))
    assert passed == BURST
    assert repeats.filter(record("state", "10.0.0.2"))
    assert repeats.filter(record("camera"))
    assert all(repeats.filter(record(None)) for _ in range(2 * BURST))
    now_ns += logs.WINDOW_NS + MS
    again = record("state")
    assert repeats.filter(again)
    assert again.getMessage() == "off (7 more of this kind were left out)"
    quiet = record("state")
    assert repeats.filter(quiet)
    assert quiet.getMessage() == "off"


def test_sources_are_bounded() -> None:
    repeats = Repeats()
    for number in range(4 * MAX_SOURCES):
        assert repeats.filter(record("refusal", str(number)))
    assert len(repeats._sources) == MAX_SOURCES


def test_a_unit_that_comes_and_goes_does_not_fill_the_disk(configured: Configure) -> None:
    written = configured("json")
    one = master(stale_after_s=0.1)
    unit = joined(one)
    for step in range(100):
        now_ns = START_NS + S + step * S
        unit.update(now_ns)
        one.tick(now_ns + S // 2)
    states = [line for line in parsed(written) if line["event"] == "state"]
    assert len(states) == BURST
