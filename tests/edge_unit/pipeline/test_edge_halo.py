# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline
from edge_unit.pipeline.edge_halo import runs_of
from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.meshes import box_mesh
from shared.settings import FilterSettings
from shared.transforms import from_rotation_translation

CAMERA = Intrinsics(320, 240, 200.0, 200.0, 159.5, 119.5)
BLOCK_TOP_M, FLOOR_M = 1.0, 2.0
HALF_M = 0.16
LEFT_PX, RIGHT_PX = 128, 192  # the block's top at 1 m; its halo of 5 cm is 10 px wide


def pipeline(static_padding_m: float = 0.05) -> DepthPipeline:
    """Straight down on a block of 0.4 m at 1 m, which stands on a floor at 2 m; depth is -z of the world."""
    pose = from_rotation_translation(np.diag((1.0, -1.0, -1.0)), (0.0, 0.0, 0.0))
    block = box_mesh("block", (2 * HALF_M, 2 * HALF_M, FLOOR_M - BLOCK_TOP_M))
    middle = from_rotation_translation(np.eye(3), (0.0, 0.0, -0.5 * (BLOCK_TOP_M + FLOOR_M)))
    floor = from_rotation_translation(np.eye(3), (0.0, 0.0, -FLOOR_M - 0.01))
    static = (PlacedMesh("block", block, middle), PlacedMesh("floor", box_mesh("floor", (6.0, 6.0, 0.02)), floor))
    cell = Cell("halo", np.array((-1.0, -1.0, -2.0)), np.array((1.0, 1.0, 0.0)), static)
    return DepthPipeline(CAMERA, pose, cell, FilterSettings(static_padding_m=static_padding_m))


def scene(grown_px: int = 0) -> NDArray[np.uint16]:
    """Block and floor, the block's top `grown_px` wider on all sides."""
    depth = np.full(CAMERA.shape, round(1000 * FLOOR_M), np.uint16)
    depth[88 - grown_px : 152 + grown_px, LEFT_PX - grown_px : RIGHT_PX + grown_px] = round(1000 * BLOCK_TOP_M)
    return depth


def test_the_halo_of_a_known_edge_is_not_reported() -> None:
    """A frame 35 mm wide, at the block's own depth, all around it."""
    grown = scene(grown_px=7)
    assert len(pipeline(static_padding_m=0.0).process(grown, None).voxels) > 0
    assert len(pipeline().process(grown, None).voxels) == 0
    assert not pipeline().foreground(grown, None).any()


def test_an_object_beside_an_edge_deeper_or_nearer_is_seen() -> None:
    for depth_mm in (800, 1150, 1400):
        depth = scene()
        beside = np.zeros(CAMERA.shape, bool)
        beside[105:135, RIGHT_PX + 4 : RIGHT_PX + 30] = True
        depth[beside] = depth_mm
        watched = pipeline()
        assert watched.foreground(depth, None)[beside].all()
        assert len(watched.process(depth, None).voxels) > 0


def test_depths_that_a_halo_could_hide_are_not_called_seen() -> None:
    """Blocks beside the block's top, at its depth, are unseen, those above its edge are not, nor any without halo."""
    heights = (-0.65, -1.05)
    seen = []
    for watched in (pipeline(), pipeline(static_padding_m=0.0)):
        blocks = watched.process(scene(), None).seen
        at = blocks.lattice.index(np.array([(0.25, 0.05, z) for z in heights]))
        seen.append(blocks.seen[blocks.lattice.keys(at)].tolist())
    assert seen == [[1, 0], [1, 1]]


def test_the_halo_follows_the_cell_and_the_settings() -> None:
    watched = pipeline(static_padding_m=0.0)
    grown = scene(grown_px=7)
    assert watched.foreground(grown, None).any()
    watched.apply(FilterSettings())
    assert not watched.foreground(grown, None).any()
    watched.apply(FilterSettings(static_padding_m=0.0))
    assert watched.foreground(grown, None).any()


def test_runs_are_the_pixels_that_they_came_from() -> None:
    """At a row's end a run ends, too."""
    rng = np.random.default_rng(0)
    for share in (0.0, 0.3, 0.9, 1.0):
        marked = rng.random((13, 17)) < share
        pixels = np.flatnonzero(marked).astype(np.int32)
        runs = runs_of(pixels, 17)
        found = [17 * y + x + k for y, x, start, end in runs.tolist() for k in range(end - start)]
        assert found == pixels.tolist()
        assert all(x + end - start <= 17 for _, x, start, end in runs.tolist())
        assert [start for _, _, start, _ in runs.tolist()][1:] == [end for *_, end in runs.tolist()][:-1]
        assert len(runs) == (np.diff(marked, axis=1, prepend=False) & marked).sum()
