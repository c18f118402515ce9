# SPDX-License-Identifier: Apache-2.0
"""What the computer itself tells: when it was booted, whether its clock is set, which cameras hang on its USB."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

INTEL = "8086"

STA_UNSYNC = 0x40
TIMEX_BYTES, TIMEX_STATUS_AT = 512, 40
"""See adjtimex(2): more bytes than its structure has, and where the status lies in it on every 64-bit Linux."""


def boot_id() -> str:
    """Changes when the machine's monotonic clock starts anew."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def clock_is_set() -> bool:
    """Whether the kernel knows of anyone who keeps its wall clock right."""
    timex = ctypes.create_string_buffer(TIMEX_BYTES)
    if ctypes.CDLL(None).adjtimex(timex) < 0:
        return False
    status = int.from_bytes(timex.raw[TIMEX_STATUS_AT : TIMEX_STATUS_AT + 4], "little")
    return not status & STA_UNSYNC


def usb_cameras(devices: Path = Path("/sys/bus/usb/devices")) -> list[str]:
    """RealSense cameras that the kernel sees, whether or not the SDK may open them, each with its speed."""
    found = []
    for vendor in sorted(devices.glob("*/idVendor")):
        with suppress(OSError):  # it may go while we look
            product = (vendor.parent / "product").read_text().strip()
            if vendor.read_text().strip() == INTEL and "RealSense" in product:
                found.append(f"{product} at {(vendor.parent / 'speed').read_text().strip()} Mbit/s")
    return found
