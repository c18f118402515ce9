# SPDX-License-Identifier: Apache-2.0
"""The RealSense SDK, for the capture process only: no other module imports `pyrealsense2`; libusb is loaded before it.

Its wheel contains all its needs except libusb. The system's libusb is preferred: it learns of a camera from udev, after
udev has set the camera's permissions. The libusb of the package `libusb-package` learns of it from the kernel.
"""

from __future__ import annotations

import ctypes
import importlib.util
from pathlib import Path

SYSTEM = "libusb-1.0.so.0"
"""The library name that the SDK requests; it gets the library that was loaded under this name before."""

PACKAGE, CARRIED = "libusb_package", "libusb-1.0.so"


def load_libusb() -> str:
    """Load libusb, and return its origin: the system, or the package `libusb-package`.

    Raises:
        ImportError: neither has it.
    """
    try:
        ctypes.CDLL(SYSTEM, mode=ctypes.RTLD_GLOBAL)
        return "the system"
    except OSError as error:
        reason = str(error)
    # Found, not imported: the import would load modules that are not needed.
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        try:
            ctypes.CDLL(str(Path(folder) / CARRIED), mode=ctypes.RTLD_GLOBAL)
            return "libusb-package"
        except OSError as error:
            reason = str(error)
    raise ImportError(f"libusb-1.0 is neither in the system nor in the package libusb-package ({reason})")


LIBUSB_OF = load_libusb()

import pyrealsense2 as rs  # noqa: E402  its library must be loaded before

__all__ = ["LIBUSB_OF", "rs"]
