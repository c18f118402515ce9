# SPDX-License-Identifier: Apache-2.0
"""The result of one frame as one value: it holds no memory of the source, and no later frame changes it."""

from __future__ import annotations

from dataclasses import dataclass

from edge_unit.pipeline.fit_check import Health
from edge_unit.pipeline.pose_misfit import Misfit
from edge_unit.pipeline.stage_times import StageTimes
from edge_unit.pipeline.visibility import SeenBlocks
from edge_unit.pipeline.voxelizer import Voxels


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The result of one frame.

    Attributes:
        voxels: the obstacle voxels, which no known surface explains.
        seen: the blocks of the cell that the frame looks through.
        health: the fit of the frame to the known surfaces.
        times: the time that each stage took.
        misfit: misfit of the frame at the camera's pose and at neighbouring poses; None if not requested.
    """

    voxels: Voxels
    seen: SeenBlocks
    health: Health
    times: StageTimes
    misfit: Misfit | None = None
