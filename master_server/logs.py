# SPDX-License-Identifier: Apache-2.0
"""Lines of the log, as text or as JSON: no secret in any, and none repeated without end.

Lines about a unit or a reader carry `event`, `ip` and, where there is one, `unit_id` besides their text.
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
"""Lines of one event and one source in a window: a unit that comes and goes is told, its every turn is not."""

WINDOW_NS = 60 * NS_PER_S

MAX_SOURCES = 256
"""Events of the units and of a network's worth of strangers; the longest silent one is forgotten first."""

# A token is no shorter than 16 characters; what calls itself one in an address is one whatever its length.
SECRET = re.compile(r"(bearer(?:[ .]|%20))[^\s\"'&,\\]{16,}|(token=)[^\s\"'&\\]+", re.IGNORECASE)

ACCESS_LINE = '"WebSocket %s"'
"""In what the web server says of each reader, with the whole address; the stream's own lines say it without."""


def configure(level: LogLevel, form: LogFormat) -> None:
    """Send all lines, the web server's too, to standard error; not where something else has taken them over."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Redacted(_JSON if form == "json" else _TEXT))
    handler.addFilter(_without_access_lines)
    handler.addFilter(Repeats())
    logging.basicConfig(level=level, handlers=[handler])


def redacted(line: str) -> str:
    """The line with every token in it blotted out."""
    return SECRET.sub(lambda found: f"{found[1] or found[2]}***", line)


class Repeats(logging.Filter):
    """Passes `BURST` lines of one event and source in each window, and tells in the next how many it left out."""

    def __init__(self) -> None:
        super().__init__()
        self._sources: OrderedDict[tuple[object, ...], _Window] = OrderedDict()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is written."""
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
        """Begin another when this one is over; returns how many lines were left out of it."""
        if now_ns - self._began_ns < WINDOW_NS:
            return 0
        left_out = max(self._count - BURST, 0)
        self._began_ns, self._count = now_ns, 0
        return left_out

    def take(self) -> bool:
        self._count += 1
        return self._count <= BURST


class _Redacted(logging.Formatter):
    """Any formatter's line, looked through as a whole: messages, arguments and tracebacks alike."""

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
