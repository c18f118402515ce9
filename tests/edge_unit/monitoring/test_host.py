# SPDX-License-Identifier: Apache-2.0
"""Facts of the computer."""

from __future__ import annotations

import ctypes
import struct
from pathlib import Path
from types import SimpleNamespace

import pytest

from edge_unit.monitoring import clock_is_set, usb_cameras


def plug(devices: Path, name: str, **files: str) -> None:
    (devices / name).mkdir(parents=True)
    for file, text in files.items():
        (devices / name / file).write_text(f"{text}\n")


def test_cameras_on_usb_with_their_speed(tmp_path: Path) -> None:
    assert usb_cameras(tmp_path / "none") == []
    camera = "Intel(R) RealSense(TM) Depth Camera 435i"
    plug(tmp_path, "2-1", idVendor="8086", product=camera, speed="5000")
    plug(tmp_path, "1-4", idVendor="8086", product=camera, speed="480")
    plug(tmp_path, "1-2", idVendor="8086", product="Bluetooth", speed="12")
    plug(tmp_path, "1-3", idVendor="046d", product="RealSense of another maker", speed="480")
    plug(tmp_path, "1-5", idVendor="8086")
    assert usb_cameras(tmp_path) == [f"{camera} at 480 Mbit/s", f"{camera} at 5000 Mbit/s"]


TIME_ERROR = 5
"""Return value of adjtimex(2) for a clock that nothing synchronises; smaller values mean a synchronised clock."""


def test_the_kernel_reports_the_state_of_its_clock() -> None:
    told = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))
    assert clock_is_set() == (0 <= told < TIME_ERROR)


@pytest.mark.parametrize(
    ("returned", "status", "expected"),
    [(0, 0x0001, True), (0, 0x2001, True), (5, 0x0040, False), (5, 0x2041, False), (-1, 0, False)],
)
def test_a_clock_is_set_unless_it_is_unsynchronised(
    returned: int, status: int, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def adjtimex(timex: ctypes.Array[ctypes.c_char]) -> int:
        # modes, offset, freq, maxerror, esterror and status, as 64-bit Linux aligns them.
        struct.pack_into("=I4xqqqqi", timex, 0, 0, 0, 0, 0, 0, status)
        return returned

    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(adjtimex=adjtimex))
    assert clock_is_set() == expected
