# SPDX-License-Identifier: Apache-2.0
"""`make demo`: a master, several units and a robot's controller as real processes, with walking people.

Cameras, robot and people are simulated; everything else is the software of a real cell.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

from simulation.fleet.processes import die_with_parent, raise_when_stopped

EXIT_STOPPED = 130
"""Exit code of shells after Ctrl-C."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; exit code 1 when something failed, 130 when stopped before its time."""
    if "MAKELEVEL" in os.environ:
        # If make is killed, nobody else stops this process.
        die_with_parent(signal.SIGTERM)
    raise_when_stopped()
    try:
        # The import takes a second or two; a Ctrl-C during it must end the process as quietly as later.
        from simulation.demo.show import run

        return run(arguments)
    except KeyboardInterrupt:
        return EXIT_STOPPED


if __name__ == "__main__":
    sys.exit(main())
