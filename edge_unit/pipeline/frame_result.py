# SPDX-License-Identifier: Apache-2.0
"""All that one frame tells, as one value: it holds no memory of the frame's source, and no later frame changes it."""

from __future__ import annotations

from dataclasses import dataclass

from edge_unit.pipeline.fit_check import Health
from edge_unit.pipeline.pose_misfit import Misfit
from edge_unit.pipeline.stage_times import StageTimes
from edge_unit.pipeline.visibility import SeenBlocks
from edge_unit.pipeline.voxelizer import Voxels


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What one frame tells.

    Attributes:
        voxels: where something stands that nothing known explains.
        seen: the blocks of the cell that the frame looks through.
        health: how well the frame fits what is known.
        times: how long each stage took.
        misfit: how badly the frame fits from the camera's pose and from places close by; None where not asked for.
    """

    voxels: Voxels
    seen: SeenBlocks
    health: Health
    times: StageTimes
    misfit: Misfit | None = None
