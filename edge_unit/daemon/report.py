# SPDX-License-Identifier: Apache-2.0
"""A frame as a report: what it shows, what it looks through, and whether its camera can be trusted."""

from __future__ import annotations

from edge_unit.monitoring import Verdict
from edge_unit.pipeline import DepthPipeline, SeenBlocks, Voxels
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.uplink import Assignment, Report, Trouble
from shared.clock import NS_PER_MS
from shared.messages import MAX_VOXELS, Health


def within_bounds(pipeline: DepthPipeline, voxels: Voxels) -> tuple[Voxels, SeenBlocks, str | None]:
    """Voxels and seen blocks of the frame that was processed last, and a warning where not all can be reported."""
    seen = pipeline.seen()
    if len(voxels) <= MAX_VOXELS:
        return voxels, seen, None
    crowd = f"{len(voxels)} obstacle voxels: the {MAX_VOXELS} nearest are reported, the rest counts as not seen"
    nearest, beyond = voxels.nearest(pipeline.T_world_camera[:3, 3], MAX_VOXELS)
    return nearest, seen.without(beyond), crowd


def health_of(pipeline: DepthPipeline, frame: DepthFrame, stance: Verdict, warning: str | None) -> Health:
    """Whether the camera can be trusted, by the frame that the pipeline processed last."""
    fit = pipeline.health()
    return Health(
        valid_share=fit.valid_share,
        agreeing_share=fit.agreeing_share,
        residual_share=fit.residual_share,
        static_share=fit.static_share,
        process_ms=round(pipeline.last.total_ns / NS_PER_MS, 3),
        frame=frame.frame_number,
        moved=stance.moved or None,
        blind=stance.blind or None,
        warning=warning,
    )


def troubled(assignment: Assignment, frame: DepthFrame, trouble: Trouble | None) -> Report:
    """A report that only says what is wrong: no voxels, nothing seen."""
    health = Health(frame=frame.frame_number)
    if trouble is not None:
        health = health.model_copy(update=trouble.facts())
    return Report(assignment, frame.captured_at_ns, health=health)
