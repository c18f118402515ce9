# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from edge_unit.sources.camera_info_file import DISTORTION_MAX_PX, Pinhole, distortion_px, read_camera_info
from shared.errors import SourceError

K = [10.0, 0.0, 3.5, 0.0, 11.0, 2.5, 0.0, 0.0, 1.0]
P = [10.0, 0.0, 3.5, 0.0, 0.0, 11.0, 2.5, 0.0, 0.0, 0.0, 1.0, 0.0]
EYE = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
PLAIN: dict[str, Any] = {"width": 8, "height": 6, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": K}
SHAPE = (6, 8)
RIGHT = Pinhole(8, 6, 10.0, 11.0, 3.5, 2.5)
FULL = {**PLAIN, "width": 16, "height": 12}


def written(tmp_path: Path, content: Any) -> Path:
    file = tmp_path / "camera_info.yaml"
    file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return file


CALIBRATOR = {
    "image_width": 8,
    "image_height": 6,
    "camera_name": "depth",
    "camera_matrix": {"rows": 3, "cols": 3, "data": K},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": EYE},
    "projection_matrix": {"rows": 3, "cols": 4, "data": P},
}
TAKEN: dict[str, Any] = {
    "ROS 2": {**PLAIN, "r": EYE, "p": P, "binning_x": 0, "binning_y": 0, "header": {"frame_id": "x"}},
    "ROS 1": {"width": 8, "height": 6, "distortion_model": "plumb_bob", "D": [0.0] * 5, "K": K, "R": EYE, "P": P},
    "calibrator": CALIBRATOR,
    "echo": f"{yaml.safe_dump(PLAIN)}---\n",
    "echo, twice": f"{yaml.safe_dump(PLAIN)}---\n{yaml.safe_dump(PLAIN)}---\n",
    "JSON": json.dumps(PLAIN),
    "no rectification": {**PLAIN, "r": [0.0] * 9, "p": [0.0] * 12},
    "baseline in p": {**PLAIN, "p": [*P[:3], -0.5, *P[4:]]},
    "binning of 1": {**PLAIN, "binning_x": 1, "binning_y": 1},
    "whole region": {**PLAIN, "roi": {"x_offset": 0, "y_offset": 0, "width": 8, "height": 6}},
    "empty region": {**PLAIN, "roi": {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0, "do_rectify": False}},
    "denormal": {**PLAIN, "d": [4.6e-41, 0.0, -1.2e-38, 0.0, 0.0]},
    "no distortion told": {"width": 8, "height": 6, "k": K},
    "rational": {**PLAIN, "distortion_model": "rational_polynomial", "d": [0.0] * 8},
    "binned": {**FULL, "k": [20.0, 0.0, 7.5, 0.0, 22.0, 5.5, 0.0, 0.0, 1.0], "binning_x": 2, "binning_y": 2},
    "region": {
        **FULL,
        "k": [10.0, 0.0, 7.5, 0.0, 11.0, 5.5, 0.0, 0.0, 1.0],
        "roi": {"x_offset": 4, "y_offset": 3, "width": 8, "height": 6},
    },
    "region, binned": {
        **PLAIN,
        "width": 32,
        "height": 24,
        "k": [20.0, 0.0, 15.5, 0.0, 22.0, 11.5, 0.0, 0.0, 1.0],
        "roi": {"x_offset": 8, "y_offset": 6, "width": 16, "height": 12},
        "binning_x": 2,
        "binning_y": 2,
    },
}


@pytest.mark.parametrize("form", TAKEN)
def test_every_form_gives_the_intrinsics_of_the_images(tmp_path: Path, form: str) -> None:
    found = read_camera_info(written(tmp_path, TAKEN[form]), SHAPE)
    np.testing.assert_allclose(tuple(vars(found).values()), tuple(vars(RIGHT).values()), rtol=1e-12)


REFUSED: dict[str, tuple[Any, str]] = {
    "two that differ": (f"{yaml.safe_dump(PLAIN)}---\n{yaml.safe_dump({**PLAIN, 'k': P[:9]})}", "expected one"),
    "a list": ("[1, 2]", "expected a camera_info as keys and values"),
    "nothing": ("", "expected a camera_info as keys and values"),
    "two names": ({**PLAIN, "K": K}, "expected k once"),
    "no k": ({"width": 8, "height": 6}, "k: "),
    "two words of k": ({**PLAIN, "k": [1.0, 2.0]}, "k: "),
    "by columns": ({**PLAIN, "k": np.reshape(K, (3, 3)).T.ravel().tolist()}, "k: expected fx 0 cx"),
    "skew": ({**PLAIN, "k": [10.0, 0.5, *K[2:]]}, "k: expected fx 0 cx"),
    "no focal length": ({**PLAIN, "k": [0.0, 0.0, 3.5, 0.0, 11.0, 2.5, 0.0, 0.0, 1.0]}, "k: expected focal lengths"),
    "another size": (FULL, "width, height: expected those of the images, 8 x 6, got 16 x 12"),
    "k of another size": ({**PLAIN, "k": [20.0, 0.0, 15.5, 0.0, 22.0, 11.5, 0.0, 0.0, 1.0]}, "principal point"),
    "a lens": ({**PLAIN, "d": [-0.05, 0.06, -0.001, 0.001, -0.02]}, "d: expected images without distortion"),
    "a fish-eye": ({**PLAIN, "distortion_model": "equidistant", "d": [0.0] * 4}, "distortion_model: "),
    "p of a rectified image": ({**PLAIN, "p": [8.0, *P[1:]]}, "p differs from k"),
    "r of a rectified image": (
        {**PLAIN, "r": [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0], "p": P},
        "r is no identity",
    ),
    "binned, size edited": (
        {**PLAIN, "binning_x": 2, "binning_y": 2},
        "binning_x, binning_y: expected images of 4 x 3",
    ),
    "region, size edited": ({**PLAIN, "roi": {"x_offset": 4, "y_offset": 3, "width": 8, "height": 6}}, "roi: "),
    "no YAML": ("a: [", "expected YAML"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_sure_is_refused_and_named(tmp_path: Path, case: str) -> None:
    content, words = REFUSED[case]
    file = written(tmp_path, content)
    with pytest.raises(SourceError) as caught:
        read_camera_info(file, SHAPE)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_distortion_is_told_in_pixels() -> None:
    camera = Pinhole(848, 480, 425.0, 425.0, 423.5, 239.5)
    assert distortion_px(camera, np.zeros(5)) == 0.0
    # At the corner the ray is 1.145 off the axis: k1 moves it by k1 * r**3 * f, of which x has its share.
    x = 423.5 / 425.0
    square = x**2 + (239.5 / 425.0) ** 2
    assert distortion_px(camera, np.array([1e-3, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(1e-3 * square * 423.5)
    assert distortion_px(camera, np.array([0.0] * 8 + [1e-38])) < DISTORTION_MAX_PX
    assert distortion_px(camera, np.array([0.0] * 8 + [0.01])) > DISTORTION_MAX_PX
    assert distortion_px(camera, np.array([0.0] * 5 + [-1e300, 1e300, 1e300])) > DISTORTION_MAX_PX
