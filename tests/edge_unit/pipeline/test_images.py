# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np

from edge_unit.pipeline import DepthPipeline, picture_raw, png_of
from shared.meshes import cylinder_mesh
from shared.messages import PICTURE_RANGE_M
from tests.edge_unit.scenes import OVERHEAD, bodies, camera, measured, placed, raycast, small_cell

CAMERA = camera(160, 90)


def test_expected_depth_and_foreground() -> None:
    cell = small_cell()
    person = placed("person", cylinder_mesh("person", 0.1, 1.0), (-0.5, 0.3, 0.5))
    depth = measured(raycast([*bodies(cell, [0.3]), person], OVERHEAD, CAMERA), CAMERA)
    watched = DepthPipeline(CAMERA, OVERHEAD, cell)
    before = watched.process(depth, [0.3]).voxels.keys
    expected = picture_raw("expected", depth, watched, [0.3], 0.0)
    known_m = watched.expected_depth([0.3])
    assert (expected == measured(known_m, CAMERA)).all()
    left = picture_raw("foreground", depth, watched, [0.3], 0.0)
    mask = watched.foreground(depth, [0.3])
    assert mask.sum() > 50
    assert (left[mask] == depth[mask]).all()
    assert not left[~mask].any()
    # An image request changes nothing.
    assert (watched.process(depth, [0.3]).voxels.keys == before).all()


def test_a_raw_image_survives_the_round_trip() -> None:
    picture = np.arange(160 * 90, dtype=np.uint16).reshape(90, 160) * np.uint16(4)
    png = png_of(picture, 0.00025, raw=True)
    again = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert again.dtype == np.uint16
    assert (again == picture).all()
    assert b"tEXtdepth_scale_m\x000.00025" in png


def test_colours_go_from_red_nearby_to_blue_far_away_on_one_scale() -> None:
    near_m, far_m = PICTURE_RANGE_M
    picture = np.array([[0, 1, round(near_m * 1000), round(far_m * 1000), 65535]], np.uint16)
    png = png_of(picture, 0.001, raw=False)
    assert b"tEXtX-Depth-Range-M\x000.3 6" in png
    blue, _, red = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)[0].astype(int).T
    assert (red[0], blue[0]) == (0, 0)
    assert (red[1:3] > blue[1:3] + 50).all()
    assert (blue[3:] > red[3:]).all()
    assert (red[1], blue[1]) == (red[2], blue[2])
    # Other parts of the frame change no colour.
    alone = cv2.imdecode(np.frombuffer(png_of(picture[:, 2:3], 0.001, raw=False), np.uint8), cv2.IMREAD_UNCHANGED)
    assert alone[0, 0, 2] == red[2]
