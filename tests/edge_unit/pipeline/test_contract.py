# SPDX-License-Identifier: Apache-2.0
"""The Python block of the design's contract runs unchanged, on the demo cell."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from shared.camera import Intrinsics
from shared.cell import Cell
from shared.lattice import Lattice
from shared.meshes import cylinder_mesh
from shared.settings import FilterSettings
from tests.edge_unit.scenes import (
    ABOVE_TABLE,
    CHECKOUT,
    HOME_RAD,
    bodies,
    camera,
    demo_cell,
    measured,
    placed,
    raycast,
)

DESIGN = CHECKOUT.parent / "shared" / "DESIGN.md"

BLOCK = """
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.cell import Cell
from edge_unit.pipeline import DepthPipeline

pipeline = DepthPipeline(intrinsics, T_world_camera, cell, settings)
result = pipeline.process(depth, joints)
voxels = result.voxels
result.seen, result.health, result.times
pipeline.expected_depth(joints)
pipeline.foreground(depth, joints)
reference = pipeline.learn(frames)
pipeline.use(reference)
"""


def blocks() -> list[Any]:
    """Yield the test's copy, and the design's own block if the design lies beside the checkout."""
    found = [pytest.param(BLOCK, id="copy")]
    if DESIGN.is_file():
        contract = DESIGN.read_text().split("## The contract", 1)[1]
        written = re.search(r"```python\n(.*?)```", contract, re.DOTALL)
        assert written is not None
        found.append(pytest.param(written.group(1), id="design"))
    return found


def what_it_is_given(joints: Any) -> dict[str, Any]:
    intrinsics, cell = camera(424, 240), demo_cell()
    person = placed("person", cylinder_mesh("person", 0.15, 1.6), (0.5, -0.7, 0.05))
    seen_m = raycast([*bodies(cell, HOME_RAD), person], ABOVE_TABLE, intrinsics)
    empty = measured(raycast(bodies(cell, HOME_RAD), ABOVE_TABLE, intrinsics), intrinsics)
    return {
        "intrinsics": intrinsics,
        "T_world_camera": ABOVE_TABLE,
        "cell": cell,
        "settings": FilterSettings(),
        "depth": measured(seen_m, intrinsics),
        "joints": joints,
        "frames": ((empty, HOME_RAD) for _ in range(5)),
    }


@pytest.mark.parametrize("joints", [HOME_RAD, HOME_RAD.tolist(), None], ids=["array", "list", "none"])
@pytest.mark.parametrize("block", blocks())
def test_the_block_runs_unchanged(block: str, joints: Any) -> None:
    names = what_it_is_given(joints)
    exec(compile(block, "contract", "exec"), names)
    voxels, pipeline, shape = names["voxels"], names["pipeline"], names["intrinsics"].shape

    assert voxels.indices.dtype == np.int16
    assert voxels.indices.shape == (len(voxels.counts), 3)
    assert len(voxels.counts) > 10
    assert voxels.lattice.centres(voxels.indices).shape == voxels.indices.shape
    inside = (voxels.lattice.centres(voxels.indices) > names["cell"].box_min_m).all()
    assert inside
    assert voxels.lattice == names["cell"].lattice(0.05)

    expected_m = pipeline.expected_depth(names["joints"])
    assert expected_m.dtype == np.float32
    assert expected_m.shape == shape
    foreground = pipeline.foreground(names["depth"], names["joints"])
    assert foreground.dtype == np.bool_
    assert foreground.shape == shape
    assert foreground.any()
    assert pipeline.reference is names["reference"]
    pipeline.use(None)
    for uncertainty_rad in (0.01, np.full(6, 0.01)):
        pipeline.process(names["depth"], names["joints"], joint_uncertainty_rad=uncertainty_rad)
        pipeline.foreground(names["depth"], names["joints"], joint_uncertainty_rad=uncertainty_rad)
        pipeline.expected_depth(names["joints"], joint_uncertainty_rad=uncertainty_rad)


def test_the_names_that_others_build_on() -> None:
    """Check the types and shapes in the block's comments."""
    intrinsics = Intrinsics(424, 240, 213.7, 213.7, 211.5, 119.5)
    assert intrinsics.depth_scale_m == 0.001
    assert Intrinsics(424, 240, 213.7, 213.7, 211.5, 119.5, depth_scale_m=0.0001).depth_scale_m == 0.0001

    lattice = Lattice((-1.0, 0.0, 0.5), 0.05, (3, 4, 5))
    points_m = np.array([[-0.99, 0.01, 0.51], [-0.86, 0.19, 0.74]])
    assert lattice.index(points_m).tolist() == [[0, 0, 0], [2, 3, 4]]
    assert np.allclose(lattice.centres(np.array([[0, 0, 0]])), (-0.975, 0.025, 0.525))
    keys = lattice.keys(np.array([[0, 0, 0], [2, 3, 4]]))
    assert keys.dtype == np.dtype("<u4")
    assert keys.tolist() == [0, (2 * 4 + 3) * 5 + 4]

    assert FilterSettings().voxel_size_m == 0.05
    for size_m in (0.01, 0.1):
        assert FilterSettings(voxel_size_m=size_m).voxel_size_m == size_m

    cell = Cell.load(CHECKOUT / "assets" / "cells" / "demo" / "cell.yaml")
    assert cell.robot is not None
    assert cell.robot.joint_count == 6
    assert cell.board is not None
    assert [body.name for body in cell.objects] == ["tray"]
    assert len(cell.static) >= 3
