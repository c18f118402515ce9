# SPDX-License-Identifier: Apache-2.0
"""The process that captures cameras: only it loads the RealSense SDK.

The SDK may hang forever in any call, or crash its process; a separate process can be killed. Its parent reads its
progress from the link, and the process never outlives the link.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
from collections.abc import Callable
from typing import NoReturn

from edge_unit.sources.realsense import capture_link as link

PR_SET_PDEATHSIG = 1


def serve(end: socket.socket) -> None:
    """Serve the link."""
    from edge_unit.sources.realsense.capture import serve

    serve(end)


def main(descriptor: int, parent: int, serve: Callable[[socket.socket], None] = serve) -> NoReturn:
    """Serve the link behind `descriptor`, for as long as the process `parent` lives."""
    # The parent ends this process by the link; Ctrl-C, or a stop of the whole service, is not handled here.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # A thread detects the end of the link; if the SDK hangs while it holds the GIL, the kernel ends the process.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    end = socket.socket(fileno=descriptor)
    if os.getppid() != parent:
        os._exit(0)
    status = 0
    try:
        link.send(end, link.Phase("booting"))
        serve(end)
    except (BrokenPipeError, ConnectionResetError):
        pass  # the parent is gone
    except ImportError as error:
        text = (
            f"the RealSense SDK cannot be loaded: {error}; install the packages pyrealsense2 and libusb-package "
            "(pip install 'cellwatch[realsense]'; the system's libusb also works: apt-get install libusb-1.0-0)"
        )
        link.send(end, link.Failed(text, final=True))
        status = 1
    except Exception as error:  # a bug, or an error that the SDK was never seen to raise: report it, show it, end
        link.send(end, link.Failed(f"{type(error).__name__}: {error}"))
        sys.excepthook(type(error), error, error.__traceback__)
        status = 1
    sys.stderr.flush()
    # The SDK's destructors are known to hang and to abort; the kernel closes the camera as well.
    os._exit(status)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
