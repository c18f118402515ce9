# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from edge_unit.monitoring import Trace, TraceRecord, read_trace
from edge_unit.monitoring import trace as module
from shared.errors import ConfigError


def record(number: int, sent: bool = True) -> TraceRecord:
    return TraceRecord(number, 10**15 + number, 1.5, b"\1\0\0\0", (4, 5, 6), 0.05, sent, 10**15 if sent else None)


def test_records_come_back(tmp_path: Path) -> None:
    trace = Trace(tmp_path / "new" / "trace")
    trace.add(record(1))
    trace.flush()
    trace.add(record(2, sent=False))
    trace.close()
    assert read_trace(tmp_path / "new" / "trace") == [record(1), record(2, sent=False)]


def test_a_trace_that_was_cut_short_ends_before_its_last_record(tmp_path: Path) -> None:
    trace = Trace(tmp_path / "trace")
    for number in range(3):
        trace.add(record(number))
    trace.close()
    content = (tmp_path / "trace").read_bytes()
    (tmp_path / "trace").write_bytes(content[:-5])
    assert read_trace(tmp_path / "trace") == [record(0), record(1)]


def test_file_and_memory_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "MAX_TRACE_BYTES", 1000)
    trace = Trace(tmp_path / "trace")
    for number in range(2 * module.MAX_PENDING):
        trace.add(record(number))
    trace.close()
    assert (tmp_path / "trace").stat().st_size <= 1000
    assert read_trace(tmp_path / "trace")[0].frame_number == module.MAX_PENDING
    assert caplog.text.count("the trace ends here") == 1


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"trace_path .*file/trace"):
        Trace(tmp_path / "file" / "trace")


@pytest.mark.parametrize("content", [b"\xc1", b"\x01", b"\x81\xa1a\x01"])
def test_a_file_that_is_not_a_trace_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "trace").write_bytes(content)
    with pytest.raises(ConfigError, match="expected a trace"):
        read_trace(tmp_path / "trace")
    with pytest.raises(ConfigError, match="gone"):
        read_trace(tmp_path / "gone")
