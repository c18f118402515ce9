# SPDX-License-Identifier: Apache-2.0
"""`python -m qualification.soak_site.unit CONFIG.YAML`: the edge unit before a camera that may be unplugged.

All but the source is the daemon as it is installed. It takes whatever picture lies beside the `handling` of a simulated
camera; where there is none, the camera is gone.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator

from edge_unit.__main__ import main
from edge_unit.sources.frame import CameraInfo, DepthFrame, DepthSource
from edge_unit.sources.recorded import RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSourceConfig
from qualification.fault_site.scene import FPS
from qualification.fault_site.unit import PictureSource
from shared.errors import SourceError


class PluggedSource(PictureSource):
    """A camera that is there while its picture is."""

    async def open(self) -> CameraInfo:
        """See `DepthSource`."""
        if not self._image.exists():
            raise SourceError(f"{self._image.parent.name}: it is not plugged in")
        return await super().open()

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`."""
        frames = super().frames()
        try:
            async for frame in frames:
                yield frame
        except FileNotFoundError as error:
            raise SourceError(f"{self._image.parent.name}: it was unplugged") from error
        finally:
            await frames.aclose()


def plugged_source(config: SimulatedSourceConfig) -> DepthSource:
    """Make the camera whose picture lies beside its `handling`."""
    assert config.handling is not None
    return PluggedSource(RecordedSourceConfig(folder=config.handling.parent, serial=config.serial, fps=FPS))


if __name__ == "__main__":
    sys.exit(main(["run", *sys.argv[1:]], {SimulatedSourceConfig: plugged_source}))
