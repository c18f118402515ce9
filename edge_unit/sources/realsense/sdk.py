# SPDX-License-Identifier: Apache-2.0
"""The RealSense SDK, for the capture process alone: the one place that imports `pyrealsense2`, after its libusb.

Its wheel carries all that it needs but libusb. The system's is taken where there is one, since it hears of a camera
from udev, which by then has given it its rights; that of the package `libusb-package` hears of it from the kernel.
"""

from __future__ import annotations

import ctypes
import importlib.util
from pathlib import Path

SYSTEM = "libusb-1.0.so.0"
"""The name by which the SDK asks for it; whichever library of this name was loaded before is what it gets."""

PACKAGE, CARRIED = "libusb_package", "libusb-1.0.so"


def load_libusb() -> str:
    """Load libusb, and tell whose it is: the system's, or that of `libusb-package`.

    Raises:
        ImportError: there is neither.
    """
    try:
        ctypes.CDLL(SYSTEM, mode=ctypes.RTLD_GLOBAL)
        return "the system"
    except OSError as error:
        reason = str(error)
    # Found, not imported: it brings modules along that nobody here needs.
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        try:
            ctypes.CDLL(str(Path(folder) / CARRIED), mode=ctypes.RTLD_GLOBAL)
            return "libusb-package"
        except OSError as error:
            reason = str(error)
    raise ImportError(f"libusb-1.0 is neither in the system nor in the package libusb-package ({reason})")


LIBUSB_OF = load_libusb()

import pyrealsense2 as rs  # noqa: E402  its library has to be there before

__all__ = ["LIBUSB_OF", "rs"]
