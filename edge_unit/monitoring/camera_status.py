# SPDX-License-Identifier: Apache-2.0
"""The camera's status, reported to the master at once: the open camera, the missing one, and the reason."""

from __future__ import annotations

import asyncio
import logging

from edge_unit.config import UnitConfig
from edge_unit.monitoring.last_camera import CameraMemory
from edge_unit.sources.frame import CameraInfo
from edge_unit.sources.status import ReportsStatus
from edge_unit.uplink.assignment import Trouble
from edge_unit.uplink.uplink import Uplink
from shared.errors import SourceError
from shared.messages import MAX_TEXT, ReportedOrigin
from shared.transforms import Transform

logger = logging.getLogger(__name__)


class CameraStatus:
    """Reports the status of one unit's camera to the master."""

    def __init__(self, config: UnitConfig, uplink: Uplink) -> None:
        """Raises ConfigError if the configured pose cannot be read."""
        self._uplink = uplink
        self._memory = CameraMemory(config.state_dir)
        self._wanted: str | None = getattr(config.source, "serial", None)
        self._camera: CameraInfo | None = None
        configured = config.T_world_camera
        self.known_pose: tuple[Transform, ReportedOrigin] | None = (
            None if configured is None else (configured.transform(), "configured")
        )

    async def opened(self, camera: CameraInfo) -> None:
        """Register with the camera that was opened, and store it as the last one."""
        if self._camera is not None and camera.serial != self._camera.serial:
            logger.warning("the camera changed from %s to %s", self._camera.serial, camera.serial)
        self._camera = camera
        pose = camera.T_world_camera
        self._uplink.set_camera(camera, self.known_pose or (None if pose is None else (pose, "source")))
        self._uplink.camera_state.trouble = None
        await asyncio.to_thread(self._memory.save, camera)

    async def failed(self, error: SourceError) -> None:
        """Report that the camera delivers no frames."""
        logger.warning("%s", error)
        self._uplink.camera_state.trouble = Trouble("camera", f"camera: {error}")
        await self._register_the_missing()

    async def follow(self, source: ReportsStatus) -> None:
        """Report each change of the source's status at once, as the next frame may take long; never returns."""
        status = source.status
        while True:
            if status.state != "closed":
                trouble = status.trouble
                self._uplink.camera_state.trouble = None if trouble is None else Trouble("camera", trouble)
                self._uplink.camera_state.warning = status.warning[:MAX_TEXT] or None
                if status.state == "absent":
                    await self._register_the_missing()
            status = await source.next_status(status)

    async def _register_the_missing(self) -> None:
        """Register with the missing camera: the last one, if none has delivered yet."""
        if self._camera is None:
            remembered = await asyncio.to_thread(self._memory.load)
            if remembered is not None and self._wanted in (None, remembered.serial):
                self._uplink.set_camera(remembered, self.known_pose)
