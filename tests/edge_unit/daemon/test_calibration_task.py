# SPDX-License-Identifier: Apache-2.0
"""The calibration of a unit's camera by the board, as the uplink receives it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from edge_unit.calibration.board_scan import FRAMES, GOOD_FRAMES, BoardSearch
from edge_unit.daemon.calibration_task import localise
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.assignment import Assignment, Report
from edge_unit.uplink.uplink import Uplink
from shared.cell import Cell
from shared.messages import DONE, Progress, Versions
from shared.settings import Settings
from shared.transforms import inverse
from tests.edge_unit.calibration.test_board_scan import BOARD, EMPTY, T_CAMERA_BOARD, Pictures, board_picture

CELL = Cell("cell", np.zeros(3), np.ones(3), board=BOARD)
ASSIGNMENT = Assignment(1, Versions(), Settings(), CELL.lattice(0.05), CELL, None)
FRAME = DepthFrame(np.zeros((6, 8), np.uint16), 1, 7)


@dataclass
class FakeUplink:
    """Keeps what it should send."""

    reports: list[Report] = field(default_factory=list)
    poses: list[Any] = field(default_factory=list)

    def offer(self, report: Report) -> None:
        self.reports.append(report)

    async def report_pose(self, T_world_camera: Any, origin: str, quality: Any) -> None:
        self.poses.append((T_world_camera, origin, quality))


async def test_each_image_that_gives_a_pose_is_progress() -> None:
    uplink = FakeUplink()
    search = BoardSearch(Pictures(board_picture(), EMPTY), "infrared")
    assert await localise(search, cast(Uplink, uplink), ASSIGNMENT, FRAME) == DONE
    ((pose, origin, _),) = uplink.poses
    assert origin == "board"
    assert np.abs(pose - inverse(T_CAMERA_BOARD)).max() < 2e-3
    progress = [report.health.progress for report in uplink.reports]
    assert progress[:3] == [Progress(task="calibration", done=n, total=FRAMES) for n in (1, 1, 2)]
    assert progress[-1] is not None
    assert progress[-1].done == GOOD_FRAMES
    assert {report.health.trouble_code for report in uplink.reports} == {"board"}


async def test_a_search_that_failed_has_no_progress() -> None:
    uplink = FakeUplink()
    outcome = await localise(BoardSearch(Pictures(EMPTY), "infrared"), cast(Uplink, uplink), ASSIGNMENT, FRAME)
    assert (outcome.code, uplink.poses) == ("failed", [])
    assert (uplink.reports[-1].health.trouble_code, uplink.reports[-1].health.progress) == ("board", None)
