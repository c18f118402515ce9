# SPDX-License-Identifier: Apache-2.0
"""How the camera is doing, told to the master at once: which one is here, which is missing, and why."""

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
from shared.messages import MAX_TEXT, ToldOrigin
from shared.transforms import Transform

logger = logging.getLogger(__name__)


class CameraStatus:
    """One unit's camera, as the master is told of it."""

    def __init__(self, config: UnitConfig, uplink: Uplink) -> None:
        """Raises ConfigError when the configured pose cannot be read."""
        self._uplink = uplink
        self._memory = CameraMemory(config.state_dir)
        self._wanted: str | None = getattr(config.source, "serial", None)
        self._camera: CameraInfo | None = None
        configured = config.T_world_camera
        self.known_pose: tuple[Transform, ToldOrigin] | None = (
            None if configured is None else (configured.transform(), "configured")
        )

    async def opened(self, camera: CameraInfo) -> None:
        """This one is here: register with it, and remember it."""
        if self._camera is not None and camera.serial != self._camera.serial:
            logger.warning("the camera changed from %s to %s", self._camera.serial, camera.serial)
        self._camera = camera
        pose = camera.T_world_camera
        self._uplink.set_camera(camera, self.known_pose or (None if pose is None else (pose, "source")))
        self._uplink.camera_state.trouble = None
        await asyncio.to_thread(self._memory.save, camera)

    async def failed(self, error: SourceError) -> None:
        """It does not deliver."""
        logger.warning("%s", error)
        self._uplink.camera_state.trouble = Trouble("camera", f"camera: {error}")
        await self._register_the_missing()

    async def follow(self, source: ReportsStatus) -> None:
        """Tell each change of the source's status, for the next frame may be long in coming; never returns."""
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
        """Have the master know of a camera that should be here: the one that was, if none delivered yet."""
        if self._camera is None:
            remembered = await asyncio.to_thread(self._memory.load)
            if remembered is not None and self._wanted in (None, remembered.serial):
                self._uplink.set_camera(remembered, self.known_pose)
