# SPDX-License-Identifier: Apache-2.0
"""`python -m qualification.soak_site.unit CONFIG.YAML FOLDER`: the edge unit with a camera that may be unplugged.

All but the source is the installed daemon. The camera delivers the image that lies in `FOLDER` at the time of capture.
It is unplugged while the folder holds no image. The configuration names a simulated camera, not a recording: the source
of a recording that fails is not opened again.
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from functools import partial
from pathlib import Path

from edge_unit.__main__ import main
from edge_unit.sources.frame import CameraInfo, DepthFrame, DepthSource
from edge_unit.sources.recorded import RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSourceConfig
from qualification.fault_site.scene import FPS
from qualification.fault_site.unit import PictureSource
from shared.errors import SourceError


class PluggedSource(PictureSource):
    """A camera that is plugged in while its image exists."""

    async def open(self) -> CameraInfo:
        """See `DepthSource`."""
        if not self._image.exists():
            raise SourceError(f"{self._image.parent.name}: expected a camera that is plugged in, got none")
        return await super().open()

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`."""
        frames = super().frames()
        try:
            async for frame in frames:
                yield frame
        except FileNotFoundError as error:
            raise SourceError(f"{self._image.parent.name}: the camera was unplugged") from error
        finally:
            await frames.aclose()


def plugged_source(config: SimulatedSourceConfig, folder: Path) -> DepthSource:
    """Return the camera whose image lies in `folder`."""
    return PluggedSource(RecordedSourceConfig(folder=folder, serial=config.serial, fps=FPS))


if __name__ == "__main__":
    config_path, image_folder = sys.argv[1:]
    sys.exit(main(["run", config_path], {SimulatedSourceConfig: partial(plugged_source, folder=Path(image_folder))}))
