# SPDX-License-Identifier: Apache-2.0
"""What the board tells of itself."""

from __future__ import annotations

from pathlib import Path

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


def test_the_kernel_knows_whether_its_clock_is_set() -> None:
    assert clock_is_set() in (True, False)
