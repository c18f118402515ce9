# SPDX-License-Identifier: Apache-2.0
"""The demo as a person runs it: its output, its end, and no leftovers."""

from __future__ import annotations

import json
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import psutil
import pytest

pytestmark = pytest.mark.slow

START_S = 240.0
"""Time limit to compile all kernels on a busy machine."""

STOP_S = 2.0

BUSY_S = 2.0
"""Additional time on a machine with other load."""

FIGURES = {
    "units", "people", "resolution", "voxel_size_m", "seconds", "fps_per_unit", "frames", "frames_dropped",
    "voxels_mean", "frame_ms_p50", "frame_ms_p99", "capture_to_map_ms_p50", "capture_to_map_ms_p99",
    "frames_with_false_voxels", "false_frame_fraction", "false_voxels", "visible_voxels", "margin_fraction",
    "missed_fraction", "missed_fraction_strict", "missed_definition", "marks_missed", "failures",
}  # fmt: skip


class RunningDemo:
    """A demo in the background and its output."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "simulation.demo", "--no-browser", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.said: list[str] = []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.children: list[psutil.Process] = []

    def until_said(self, text: str) -> str:
        """Wait for a line with this text."""
        deadline = time.monotonic() + START_S
        while True:
            line = self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
            assert line is not None, f"it ended without saying {text!r}: {self.said}"
            if text in line:
                return line

    def find_children(self, count: int) -> None:
        """Wait until that many processes of the fleet run."""
        deadline = time.monotonic() + START_S
        while len(self.children) < count:
            assert self.process.poll() is None, self.said
            assert time.monotonic() < deadline, self.children
            time.sleep(0.05)
            found = psutil.Process(self.process.pid).children(recursive=True)
            self.children = [child for child in found if "simulation.fleet.warm_up" not in child.cmdline()]

    def end(self, number: signal.Signals | None = None) -> tuple[int, float]:
        """Send a signal, if any. Return the exit code and the seconds until the end."""
        began = time.monotonic()
        if number is not None:
            self.process.send_signal(number)
        code = self.process.wait(START_S)
        took = time.monotonic() - began
        self._reader.join()
        return code, took

    def left(self) -> list[str]:
        """Return its children that still run after a moment."""
        _, alive = psutil.wait_procs([child for child in self.children if not _is_over(child)], timeout=1.0)
        return [str(child) for child in alive if not _is_over(child)]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line.rstrip("\n"))
            self._lines.put(line)
        self._lines.put(None)


def _is_over(process: psutil.Process) -> bool:
    """Return True if the process is gone, or a zombie of its new parent."""
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


@contextmanager
def running(*arguments: str) -> Iterator[RunningDemo]:
    demo = RunningDemo(*arguments)
    try:
        yield demo
    finally:
        if demo.process.poll() is None:
            demo.end(signal.SIGKILL)
        assert demo.process.stdout is not None
        demo.process.stdout.close()


def test_it_ends_by_itself_and_prints_a_summary() -> None:
    with running("--seconds", "5", "--json") as demo:
        assert "http://127.0.0.1:" in demo.until_said("Cellwatch demo: ")
        demo.find_children(6)
        code, _ = demo.end()
        assert demo.said[0].startswith("Cellwatch demo: http://127.0.0.1:")
        figures = json.loads(demo.said[-1])
        assert (code, figures["failures"]) == (0, [])
        assert demo.left() == []

    assert set(figures) == FIGURES
    # Two cores with other load may miss limits that quiet ones keep.
    assert len(figures["fps_per_unit"]) == 4
    assert min(figures["fps_per_unit"]) >= 10.0
    assert figures["frames"] >= 4 * 5 * 10
    assert 200 < figures["voxels_mean"] < 5000
    assert 0.0 < figures["frame_ms_p50"] <= figures["frame_ms_p99"]
    assert 0.0 < figures["capture_to_map_ms_p50"] < 250.0
    # These do not depend on the load.
    assert figures["frames_with_false_voxels"] <= 0.01 * figures["frames"]
    assert figures["missed_fraction"] <= 0.02
    assert figures["missed_fraction"] <= figures["missed_fraction_strict"] < 0.25
    assert 0.0 < figures["margin_fraction"] < 0.3


@pytest.mark.parametrize(
    ("number", "line"), [(signal.SIGINT, "2 of 2 units live"), (signal.SIGTERM, "0 of 2 units live")]
)
def test_it_stops_on_a_signal(number: signal.Signals, line: str) -> None:
    with running("--units", "2", "--people", "0") as demo:
        demo.until_said(line)
        demo.find_children(4)
        code, took = demo.end(number)
        assert (code, demo.left()) == (0, [])
        assert took < STOP_S + BUSY_S
        assert not [said for said in demo.said if "Traceback" in said or "ended by itself" in said]


def test_nothing_is_left_when_it_is_killed() -> None:
    with running("--units", "2") as demo:
        demo.find_children(4)
        demo.end(signal.SIGKILL)
        assert demo.left() == []


def test_a_dead_unit_is_reported() -> None:
    with running("--units", "2", "--people", "0") as demo:
        demo.until_said("2 of 2 units live")
        demo.find_children(4)
        victim = next(child for child in demo.children if any("unit-2" in part for part in child.cmdline()))
        victim.kill()
        demo.until_said("1 of 2 units live")
        code, _ = demo.end(signal.SIGINT)
        assert code == 1
        assert any("unit-2 ended by itself, killed by SIGKILL" in line for line in demo.said)
        assert demo.left() == []


def test_a_port_that_is_taken_is_one_clear_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with running("--port", str(port)) as demo:
            code, _ = demo.end()
    assert code == 1
    assert any(f"cannot listen at 127.0.0.1 port {port}" in line for line in demo.said)
    assert not any("Traceback" in line for line in demo.said)
