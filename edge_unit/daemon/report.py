# SPDX-License-Identifier: Apache-2.0
"""A frame's report: obstacle voxels, seen blocks, and the health of the camera."""

from __future__ import annotations

from edge_unit.monitoring import Verdict
from edge_unit.pipeline import FrameResult, SeenBlocks, StageTimes, Voxels
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.assignment import Assignment, Report, Trouble
from shared.clock import NS_PER_MS
from shared.messages import MAX_VOXELS, Health
from shared.transforms import Transform


def within_bounds(result: FrameResult, T_world_camera: Transform) -> tuple[Voxels, SeenBlocks, str | None]:
    """Return a frame's voxels and seen blocks, and a warning if the limits leave some out."""
    voxels, seen = result.voxels, result.seen
    if len(voxels) <= MAX_VOXELS:
        return voxels, seen, None
    crowd = f"{len(voxels)} obstacle voxels: the {MAX_VOXELS} nearest are reported, the rest counts as not seen"
    nearest, beyond = voxels.nearest(T_world_camera[:3, 3], MAX_VOXELS)
    return nearest, seen.without(beyond), crowd


def parts_of(times: StageTimes) -> dict[str, int]:
    """Return the method's stages as the parts of a unit's frame, ns."""
    return {
        "robot": times.expected_ns,
        "filter": times.foreground_ns,
        "density": times.density_ns,
        "seen": times.seen_ns,
        "health": times.health_ns + times.misfit_ns,
    }


def health_of(result: FrameResult, frame: DepthFrame, verdict: Verdict, warning: str | None) -> Health:
    """Return the health of the camera after a frame."""
    fit = result.health
    return Health(
        valid_share=fit.valid_share,
        agreeing_share=fit.agreeing_share,
        residual_share=fit.residual_share,
        static_share=fit.static_share,
        process_ms=round(result.times.total_ns / NS_PER_MS, 3),
        frame=frame.frame_number,
        moved=verdict.moved or None,
        blind=verdict.blind or None,
        warning=warning,
    )


def troubled(assignment: Assignment, frame: DepthFrame, trouble: Trouble | None) -> Report:
    """Return a report without voxels and seen blocks, with the trouble as its reason."""
    health = Health(frame=frame.frame_number)
    if trouble is not None:
        health = health.model_copy(update=trouble.facts())
    return Report(assignment, frame.captured_at_ns, health=health)
