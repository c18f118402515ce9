# SPDX-License-Identifier: Apache-2.0
"""`python -m qualification.fault_site.unit CONFIG.YAML`: the edge unit with a camera whose image can be exchanged.

All but the source is the installed daemon. A recording is read ahead of its time; this image is read at the moment of
its capture, so a unit that was stopped never shows an old image.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncGenerator

import numpy as np

from edge_unit.__main__ import main
from edge_unit.sources.frame import DepthFrame
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from qualification.fault_site.scene import FPS, IMAGE
from shared.clock import NS_PER_S, monotonic_ns


class PictureSource(RecordedSource):
    """A camera that returns the current image in its folder."""

    def __init__(self, config: RecordedSourceConfig) -> None:
        super().__init__(config)
        self._image = config.folder / IMAGE

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`."""
        period_ns = round(NS_PER_S / FPS)
        number, due_ns = 0, monotonic_ns()
        while True:
            await asyncio.sleep(max(due_ns - monotonic_ns(), 0) / NS_PER_S)
            captured_at_ns = monotonic_ns()
            yield DepthFrame(await asyncio.to_thread(np.load, self._image), captured_at_ns, number)
            number += 1
            due_ns = max(due_ns + period_ns, captured_at_ns)


if __name__ == "__main__":
    sys.exit(main(["run", *sys.argv[1:]], {RecordedSourceConfig: PictureSource}))
