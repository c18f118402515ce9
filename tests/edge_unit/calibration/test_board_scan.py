# SPDX-License-Identifier: Apache-2.0
"""The scan for the board: by the simulated camera, and through a source with given images."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.board_scan import EMPTY_FRAMES, FRAMES, GOOD_FRAMES, RETRY_MIN_S, BoardSearch
from edge_unit.sources.image import ImageFrame, ImageInfo, ImageStream
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.camera import Intrinsics
from shared.cell import Board, Cell
from shared.clock import monotonic_ns
from shared.errors import BoardError, SourceError
from shared.transforms import angle_rad, from_rotation_translation, identity, inverse, rotation_about
from simulation.cameras.board_picture import BoardCamera, BoardPicture
from simulation.cameras.camera import rig
from simulation.world.world import DEMO_CELL, World
from tests.set_clock import S, SetClock

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
BOARD = Board("grid", 3, 4, 0.08, 0.06, "DICT_4X4_50", 0, identity())
T_CAMERA_BOARD = from_rotation_translation(rotation_about((1.0, 0.5, 0.0), 0.5), (-0.1, -0.1, 0.9))
EMPTY = np.full(CAMERA.shape, 90, np.uint8)


class Pictures:
    """A source that delivers these images, over and over."""

    def __init__(self, *pictures: NDArray[np.uint8]) -> None:
        self.info = ImageInfo("infrared", CAMERA, (0.0,) * 5, "brown_conrady", identity())
        self.pictures = pictures
        self.taken = 0
        self.looking = False

    @asynccontextmanager
    async def open_images(self, stream: ImageStream) -> AsyncIterator[Pictures]:
        self.looking = True
        try:
            yield self
        finally:
            self.looking = False

    async def images(self) -> AsyncGenerator[ImageFrame, None]:
        while self.pictures:
            yield ImageFrame(self.pictures[self.taken % len(self.pictures)], monotonic_ns(), self.taken)
            self.taken += 1


@pytest.fixture(scope="module")
def demo() -> Cell:
    return Cell.load(DEMO_CELL)


def board_picture() -> NDArray[np.uint8]:
    picture = BoardPicture(BoardLayout.of(BOARD), CAMERA)
    return picture.develop(picture.expose(T_CAMERA_BOARD), np.random.default_rng(0))


async def test_it_scans_until_it_has_enough_images() -> None:
    source, reported = Pictures(board_picture(), EMPTY), list[tuple[str, int]]()
    search = BoardSearch(source, "infrared")
    found = await search.scan(BOARD, lambda *progress: reported.append(progress))
    assert np.abs(found.T_world_camera - inverse(T_CAMERA_BOARD)).max() < 2e-3
    assert found.frames_used == GOOD_FRAMES
    assert reported[:2] == [
        ("searching for the board: 12 of 12 markers", 1),
        ("searching for the board: 0 of 12 markers", 1),
    ]
    assert not source.looking
    assert search.outcome == ""


async def test_an_uncertain_pose_takes_more_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_unit.calibration.board_scan.GOOD_MM", 0.0)
    found = await BoardSearch(Pictures(board_picture()), "infrared").scan(BOARD, lambda *progress: None)
    assert found.frames_used == FRAMES


async def test_without_a_board_it_scans_with_growing_pauses() -> None:
    source, clock = Pictures(EMPTY), SetClock()
    search = BoardSearch(source, "infrared", clock)
    assert search.due
    with pytest.raises(BoardError, match="none of the board's 12 markers"):
        await search.scan(BOARD, lambda *progress: None)
    assert source.taken == EMPTY_FRAMES - 1
    first_ns = clock.now + round(RETRY_MIN_S * S)
    clock.go_to(first_ns - 1)
    assert not search.due
    clock.go_to(first_ns)
    assert search.due
    with pytest.raises(BoardError):
        await search.scan(BOARD, lambda *progress: None)
    clock.go_to(first_ns + 2 * round(RETRY_MIN_S * S) - 1)
    assert not search.due
    assert "none of the board's" in search.outcome
    search.begin_anew()
    assert search.due


async def test_a_source_without_images() -> None:
    search = BoardSearch(object(), "infrared")
    assert not search.due
    with pytest.raises(BoardError, match="no images"):
        await search.scan(BOARD, lambda *progress: None)
    with pytest.raises(SourceError, match="delivered no image"):
        await BoardSearch(Pictures(), "infrared").scan(BOARD, lambda *progress: None)


@pytest.mark.parametrize("stream", ["infrared", "color"])
async def test_a_simulated_camera_finds_its_pose_by_the_demo_cells_board(stream: ImageStream, demo: Cell) -> None:
    source = SimulatedSource(SimulatedSourceConfig(camera=1, people=0, knows_pose=False))
    try:
        camera = await source.open()
        assert camera.T_world_camera is None
        assert demo.board is not None
        found = await BoardSearch(source, stream).scan(demo.board, lambda *progress: None)
    finally:
        await source.close()
    off = inverse(rig(demo, 4)[1]) @ found.T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.015
    assert np.degrees(angle_rad(off)) < 0.3


def test_an_object_before_the_board_hides_it() -> None:
    world = World.demo(people=0)
    camera = BoardCamera(world, rig(world.cell, 4)[3], "infrared", 0)
    assert camera.intrinsics.shape == camera.take(0.0).shape
    board = world.cell.board
    assert board is not None
    picture = BoardPicture(BoardLayout.of(board), camera.intrinsics)
    assert camera._T_image_board is not None
    clear = picture.expose(camera._T_image_board)
    hidden = np.abs(camera.take(0.0) - clear) > 40.0
    # The tray and the arm hide a good part of it, but not all.
    board_px = np.abs(clear - clear[0, 0]) > 40.0
    assert 0.2 < hidden[board_px].mean() < 0.9
