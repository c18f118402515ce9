# SPDX-License-Identifier: Apache-2.0
"""Facts of the computer: its boot, the state of its clock, the cameras on its USB."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

INTEL = "8086"

STA_UNSYNC = 0x40
TIMEX_BYTES, TIMEX_STATUS_AT = 512, 40
"""See adjtimex(2): more bytes than its structure has, and the offset of the status on every 64-bit Linux."""


def boot_id() -> str:
    """Return an id that changes when the machine's monotonic clock restarts."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def clock_is_set() -> bool:
    """Return True if the kernel says that a time service keeps its wall clock right."""
    timex = ctypes.create_string_buffer(TIMEX_BYTES)
    if ctypes.CDLL(None).adjtimex(timex) < 0:
        return False
    status = int.from_bytes(timex.raw[TIMEX_STATUS_AT : TIMEX_STATUS_AT + 4], "little")
    return not status & STA_UNSYNC


def usb_cameras(devices: Path = Path("/sys/bus/usb/devices")) -> list[str]:
    """Return the RealSense cameras that the kernel lists, each with its speed; the SDK may be unable to open them."""
    found = []
    for vendor in sorted(devices.glob("*/idVendor")):
        with suppress(OSError):  # a camera may be unplugged meanwhile
            product = (vendor.parent / "product").read_text().strip()
            if vendor.read_text().strip() == INTEL and "RealSense" in product:
                found.append(f"{product} at {(vendor.parent / 'speed').read_text().strip()} Mbit/s")
    return found
