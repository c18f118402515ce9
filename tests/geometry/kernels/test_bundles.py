# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import pytest
from numba import types

from edge_unit.pipeline import DepthPipeline
from geometry.kernels import agreement, density, forward, limits, misfit, motion, points, rasterize, reference, seen
from geometry.kernels.bundles import plain
from tests.edge_unit.scenes import ABOVE_TABLE, HOME_RAD, camera, demo_cell

FROM_PYTHON_ONLY = {
    "agreement": agreement.compare,
    "background model": reference.observe,
    "density": density.keep_dense,
    "drawing": rasterize.draw_meshes,
    "misfit": misfit.misfit_there,
    "links": forward.place_links,
    "moved links": motion.settle,
    "points": points.count_foreground,
    "robot": limits.robot_band_raw,
    "seen": seen.seen_blocks,
    "static": limits.static_limit_raw,
    "uncertainty": forward.displace_links,
    "views": seen.block_views,
}
"""Kernels that no other kernel calls."""


class Pair(NamedTuple):
    one: int
    other: float


def test_a_plain_bundle_has_the_values_and_no_names() -> None:
    bundle = plain(Pair(1, 2.5))
    assert type(bundle) is tuple
    assert bundle == (1, 2.5)


@pytest.fixture(scope="module")
def call_all_kernels() -> None:
    pipeline = DepthPipeline(camera(), ABOVE_TABLE, demo_cell())
    depth = np.full(pipeline.intrinsics.shape, 700, np.uint16)
    pipeline.process(depth, HOME_RAD, joint_uncertainty_rad=0.01, with_misfit=True)
    pipeline.learn([(depth, HOME_RAD)])


# With an empty cache, one test compiles all kernels.
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("call_all_kernels")
@pytest.mark.parametrize("name", sorted(FROM_PYTHON_ONLY))
def test_no_caller_passes_a_named_tuple(name: str) -> None:
    """A named tuple would be compiled separately, and each call would take a microsecond a bundle longer."""
    signatures = cast(Any, FROM_PYTHON_ONLY[name]).signatures
    assert signatures
    assert any(isinstance(each, types.BaseTuple) for signature in signatures for each in signature)
    assert not any(isinstance(each, types.BaseNamedTuple) for signature in signatures for each in signature)
