# SPDX-License-Identifier: Apache-2.0
"""Log lines as text or JSON, without secrets and without endless repetition.

Lines about a unit or a reader carry `event`, `ip` and, if there is a unit, `unit_id` besides their text.
"""

from __future__ import annotations

import logging
import re
from collections import OrderedDict
from typing import Literal

from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

from shared.clock import NS_PER_S, monotonic_ns

LogFormat = Literal["text", "json"]
LogLevel = Literal["DEBUG", "INFO", "WARNING", "ERROR"]

BURST = 10
"""Lines of one event and one source in a window: some reconnects of a unit are logged, not all of an unstable one."""

WINDOW_NS = 60 * NS_PER_S

MAX_SOURCES = 256
"""Events of all units and of the strangers in a network; beyond, the one that was silent longest is dropped."""

# A token has at least 16 characters; a parameter named token in an address is redacted at any length.
SECRET = re.compile(r"(bearer(?:[ .]|%20))[^\s\"'&,\\]{16,}|(token=)[^\s\"'&\\]+", re.IGNORECASE)

ACCESS_LINE = '"WebSocket %s"'
"""Marks the web server's own line about a reader, with the whole address; the stream logs the same without it."""


def configure(level: LogLevel, form: LogFormat) -> None:
    """Send all lines, including the web server's, to standard error, unless the host program has set up logging."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Redacted(_JSON if form == "json" else _TEXT))
    handler.addFilter(_without_access_lines)
    handler.addFilter(Repeats())
    logging.basicConfig(level=level, handlers=[handler])


def redacted(line: str) -> str:
    """Return the line with every token in it replaced."""
    return SECRET.sub(lambda found: f"{found[1] or found[2]}***", line)


class Repeats(logging.Filter):
    """Pass `BURST` lines of one event and source in each window; the next window reports how many were left out."""

    def __init__(self) -> None:
        super().__init__()
        self._sources: OrderedDict[tuple[object, ...], _Window] = OrderedDict()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the line is to be written."""
        event = getattr(record, "event", None)
        if event is None:
            return True
        source = (event, *(getattr(record, name, None) for name in ("unit_id", "ip", "status")))
        now_ns = monotonic_ns()
        window = self._sources.pop(source, None)
        if window is None:
            window = _Window(now_ns)
            if len(self._sources) >= MAX_SOURCES:
                self._sources.popitem(last=False)
        self._sources[source] = window
        left_out = window.begin_anew(now_ns)
        if left_out:
            record.msg = f"{record.getMessage()} ({left_out} more of this kind were left out)"
            record.args = ()
        return window.take()


class _Window:
    def __init__(self, began_ns: int) -> None:
        self._began_ns = began_ns
        self._count = 0

    def begin_anew(self, now_ns: int) -> int:
        """Start another window when this one is over; return how many lines it left out."""
        if now_ns - self._began_ns < WINDOW_NS:
            return 0
        left_out = max(self._count - BURST, 0)
        self._began_ns, self._count = now_ns, 0
        return left_out

    def take(self) -> bool:
        self._count += 1
        return self._count <= BURST


class _Redacted(logging.Formatter):
    """Redact the whole line of another formatter: messages, arguments and tracebacks."""

    def __init__(self, inner: logging.Formatter) -> None:
        super().__init__()
        self._inner = inner

    def format(self, record: logging.LogRecord) -> str:
        return redacted(self._inner.format(record))


def _without_access_lines(record: logging.LogRecord) -> bool:
    return not (record.name == "uvicorn.error" and isinstance(record.msg, str) and ACCESS_LINE in record.msg)


_TEXT = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
_JSON = JsonFormatter(
    ("levelname", "name", "message"),
    rename_fields={"levelname": "level", "name": "logger", "exc_info": "traceback"},
    timestamp="time",
    json_ensure_ascii=False,
    reserved_attrs=[*RESERVED_ATTRS, "color_message", "websocket"],
)
