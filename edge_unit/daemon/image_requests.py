# SPDX-License-Identifier: Apache-2.0
"""The images that the master requests: drawn between two frames, encoded and sent in the background."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from edge_unit.daemon.joint_lookup import known
from edge_unit.daemon.pipeline_manager import AssignedPipeline
from edge_unit.daemon.task_group import TaskGroup
from edge_unit.joints import JointEstimate
from edge_unit.pipeline import picture_raw, png_of
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.uplink import Uplink
from shared.errors import CellwatchError, InputError
from shared.messages import Command, ImageKind, Outcome

NO_POSE = "the pose of its camera is not known yet"


class ImageRequests:
    """Image requests of one unit."""

    def __init__(self, uplink: Uplink, assigned: AssignedPipeline, tasks: TaskGroup) -> None:
        self._uplink = uplink
        self._assigned = assigned
        self._tasks = tasks

    async def show(self, commands: Iterable[Command], frame: DepthFrame, joints: JointEstimate | None) -> None:
        """Draw the images that `commands` request, from the frame that was processed last."""
        for command in commands:
            if command.image is None:
                continue
            try:
                picture = await asyncio.to_thread(self._draw, command.image, frame, joints)
            except InputError as error:
                self._uplink.finish(command, Outcome("refused", str(error)))
            else:
                self._tasks.start(self._send(command, picture))

    def _draw(self, kind: ImageKind, frame: DepthFrame, joints: JointEstimate | None) -> NDArray[np.uint16]:
        if kind == "depth":
            return frame.depth.copy()
        if self._assigned.pipeline is None:
            raise InputError(NO_POSE)
        positions, uncertainty = known(joints)
        return picture_raw(kind, frame.depth, self._assigned.pipeline, positions, uncertainty)

    async def _send(self, command: Command, picture: NDArray[np.uint16]) -> None:
        assert self._assigned.camera is not None
        scale_m = self._assigned.camera.intrinsics.depth_scale_m
        try:
            png = await asyncio.to_thread(png_of, picture, scale_m, command.raw)
            await self._uplink.send_image(command, png)
        except CellwatchError as error:
            self._uplink.finish(command, Outcome("failed", str(error)))
        else:
            self._uplink.finish(command)
