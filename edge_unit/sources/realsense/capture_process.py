# SPDX-License-Identifier: Apache-2.0
"""The process in which cameras are captured: it alone loads the RealSense SDK.

The SDK may hang for good in any call, or take its process down; here it can be killed. Whoever began the process reads
from the link what it does, and it never outlives the link.
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
    """Do what the link asks for."""
    from edge_unit.sources.realsense.capture import serve

    serve(end)


def main(descriptor: int, parent: int, serve: Callable[[socket.socket], None] = serve) -> NoReturn:
    """Serve the link behind `descriptor`, for as long as the process `parent` lives."""
    # Whoever began this ends it, by the link; a Ctrl-C or a stop of the whole service is not for us to act on.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # The link's end is seen by a thread; should the SDK hang with Python's lock in its hands, the kernel does it.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    end = socket.socket(fileno=descriptor)
    if os.getppid() != parent:
        os._exit(0)
    status = 0
    try:
        link.send(end, link.Phase("booting"))
        serve(end)
    except (BrokenPipeError, ConnectionResetError):
        pass  # whoever began this is gone
    except ImportError as error:
        text = (
            f"the RealSense SDK cannot be loaded: {error}; it takes the packages pyrealsense2 and libusb-package "
            "(pip install 'cellwatch[realsense]'; the system's libusb will do as well: apt-get install libusb-1.0-0)"
        )
        link.send(end, link.Failed(text, final=True))
        status = 1
    except Exception as error:  # a bug, or an error that the SDK was never seen to raise: tell it, show it, go
        link.send(end, link.Failed(f"{type(error).__name__}: {error}"))
        sys.excepthook(type(error), error, error.__traceback__)
        status = 1
    sys.stderr.flush()
    # The SDK's destructors are known to hang and to abort; the kernel closes the camera as well.
    os._exit(status)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
