# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from shared.camera import Intrinsics
from shared.errors import InputError

D435 = Intrinsics(848, 480, 421.5, 420.9, 424.2, 239.8)

sizes = st.integers(1, 24)
focal_lengths = st.floats(1.0, 2000.0)
centres = st.floats(-100.0, 100.0)
cameras = st.builds(Intrinsics, sizes, sizes, focal_lengths, focal_lengths, centres, centres, st.floats(1e-4, 1e-2))


@given(cameras, st.data())
def test_projection_undoes_deprojection(camera: Intrinsics, data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, 2**32 - 1))
    depth = np.random.default_rng(seed).integers(1, 2**16, camera.shape, dtype=np.uint16)
    points = camera.deproject(depth)
    assert points.shape == (camera.height, camera.width, 3)
    np.testing.assert_allclose(points[..., 2], depth * camera.depth_scale_m)
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    np.testing.assert_allclose(camera.project(points), np.stack((columns, rows), axis=-1), atol=1e-6)


def test_axes_are_optical_and_pixel_centres_are_integers() -> None:
    camera = Intrinsics(5, 3, 2.0, 2.0, 2.0, 1.0)
    points = camera.deproject(np.full((3, 5), 2000, dtype=np.uint16))
    np.testing.assert_allclose(points[1, 2], [0.0, 0.0, 2.0])
    np.testing.assert_allclose(points[1, 4], [2.0, 0.0, 2.0])
    np.testing.assert_allclose(points[2, 2], [0.0, 1.0, 2.0])


def test_pixels_without_measurement_deproject_to_the_origin() -> None:
    np.testing.assert_array_equal(D435.deproject(np.zeros(D435.shape, dtype=np.uint16)), 0.0)


def test_stereo_noise_uses_the_focal_length_of_the_imagers() -> None:
    # At 2 m, 0.1 px of disparity of a 50 mm baseline at 420 px is 19 mm.
    assert D435.disparity_noise_m(0.1) * 2.0**2 == pytest.approx(0.019, rel=0.01)
    assert D435.stereo_focal_px == D435.fx
    aligned = Intrinsics(1280, 720, 908.3, 908.3, 643.0, 372.7, fx_stereo=640.0)
    assert aligned.stereo_focal_px == 640.0
    assert aligned.disparity_noise_m(0.1) == pytest.approx(0.1 / (640.0 * 0.05))


def test_depth_images_are_checked() -> None:
    good = np.zeros((480, 848), dtype=np.uint16)
    assert D435.check_depth(good) is good
    turned = D435.check_depth(np.asfortranarray(good))
    assert turned.flags.c_contiguous
    for wrong, words in (
        (None, "expected a numpy array, got NoneType"),
        (good.astype(np.float32), r"expected dtype uint16 \(units of depth_scale_m\), got float32"),
        (good.astype(">u2"), "expected dtype uint16"),
        (good.T, r"expected shape \(480, 848\) \(height, width\), got \(848, 480\)"),
        (good[None], "expected shape"),
    ):
        with pytest.raises(InputError, match=f"^depth: {words}"):
            D435.check_depth(wrong)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"width": 5000},
        {"height": -1},
        {"fx": 0.0},
        {"fy": float("nan")},
        {"cx": float("inf")},
        {"depth_scale_m": 0.0},
        {"depth_scale_m": 1.0},
        {"stereo_baseline_m": 0.0},
        {"fx_stereo": -1.0},
        {"skew": 0.0},
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(change))):
        Intrinsics.model_validate({**D435.model_dump(), **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cx": float("nan")}, "intrinsics: cx: input should be a finite number, got nan"),
        ({"width": 0}, "intrinsics: width: input should be greater than 0, got 0"),
        (
            {"fx": "wide"},
            "intrinsics: fx: input should be a valid number, unable to parse string as a number, got 'wide'",
        ),
        ({"fy": None}, "intrinsics: fy: input should be a valid number, got None"),
        ({"skew": 0.0}, "intrinsics: skew: extra inputs are not permitted, got 0.0"),
    ],
)
def test_invalid_numbers_raise_one_clear_error(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        Intrinsics(**(D435.model_dump() | change))
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"height": 1}, "expected width, fx, fy, cx, cy, got none"),
        (dict[Any, Any](D435.model_dump()) | {1: 2}, "expected field names as text"),
        ({**D435.model_dump(), "fx": -1.0}, "intrinsics: fx: input should be greater than 0, got -1.0"),
        (None, "instance of Intrinsics"),
    ],
)
def test_a_model_reports_its_invalid_camera(document: Any, words: str) -> None:
    with pytest.raises(ValidationError, match=words) as caught:
        TypeAdapter(dict[str, Intrinsics]).validate_python({"camera": document})
    assert caught.value.errors()[0]["loc"][0] == "camera"


def test_camera_survives_json_and_is_frozen() -> None:
    assert Intrinsics.model_validate_json(D435.model_dump_json()) == D435
    with pytest.raises(ValidationError, match="frozen"):
        D435.fx = 1.0  # type: ignore[misc]  # what must fail
