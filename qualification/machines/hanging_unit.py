# SPDX-License-Identifier: Apache-2.0
"""The unit of a machine, except that its filter never returns while a certain file exists.

It is copied onto the machine as it is, so it imports only what a board has.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from edge_unit import __main__
from edge_unit.daemon.frame_processor import FrameProcessor
from edge_unit.uplink.assignment import Report

HANG = Path("/run/hang")

CHECK_S = 0.1

process = FrameProcessor.process


def hanging(self: FrameProcessor, *arguments: object) -> Report:
    """Run `FrameProcessor.process` some time after `HANG` is gone."""
    never = threading.Event()
    while HANG.exists():
        never.wait(CHECK_S)
    return process(self, *arguments)  # type: ignore[arg-type]  # handed on as they come


if __name__ == "__main__":
    FrameProcessor.process = hanging  # type: ignore[method-assign, assignment]  # that is the fault
    sys.exit(__main__.main(["run", "/etc/cellwatch/unit.yaml"]))
