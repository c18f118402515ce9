# SPDX-License-Identifier: Apache-2.0
"""The camera's pose from the board: found in the source's own images, and reported to the master."""

from __future__ import annotations

import logging

from edge_unit.calibration.board_layout import require_board
from edge_unit.calibration.board_scan import FRAMES, BoardSearch
from edge_unit.daemon.report import troubled
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.assignment import Assignment, Trouble
from edge_unit.uplink.uplink import Uplink
from shared.errors import CellwatchError
from shared.messages import DONE, Outcome, PoseQuality, Progress

logger = logging.getLogger(__name__)


async def localise(search: BoardSearch, uplink: Uplink, assignment: Assignment, frame: DepthFrame) -> Outcome:
    """Search for the board while depth is paused, and report the pose to the master; returns the outcome.

    `frame` is the last one before the search; the progress of the search is reported as its trouble.
    """

    def tell(seen: str, images: int) -> None:
        progress = Progress(task="calibration", done=min(images, FRAMES), total=FRAMES)
        uplink.offer(troubled(assignment, frame, Trouble("board", seen, progress)))

    first = not search.outcome
    try:
        found = await search.scan(require_board(assignment.cell.board), tell)
        quality = PoseQuality(
            uncertainty_mm=round(found.uncertainty_mm, 3),
            uncertainty_deg=round(found.uncertainty_deg, 4),
            reprojection_px=round(found.reprojection_px, 4),
        )
        await uplink.report_pose(found.T_world_camera, "board", quality)
    except CellwatchError as error:
        # It retries without end, but warns once.
        logger.log(logging.WARNING if first else logging.DEBUG, "%s", error)
        uplink.offer(troubled(assignment, frame, Trouble("board", f"searching for the board: {error}")))
        return Outcome("failed", str(error))
    logger.info(
        "found the board in %d of %d images: the pose is known to %.1f mm and %.2f degrees",
        found.frames_used,
        found.frames_seen,
        found.uncertainty_mm,
        found.uncertainty_deg,
    )
    return DONE
