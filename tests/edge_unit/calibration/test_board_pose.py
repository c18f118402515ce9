# SPDX-License-Identifier: Apache-2.0
"""The camera's pose from simulated images of a board, in good and in poor views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.calibration.board_detection import refined_corners
from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.board_pose import MIN_FRAMES, BoardLocaliser, Localisation
from edge_unit.calibration.pose_average import mean_pose
from shared.camera import Intrinsics
from shared.cell import Board
from shared.errors import BoardError, CellError, InputError
from shared.transforms import (
    Transform,
    angle_rad,
    apply,
    from_rotation_translation,
    from_xyz_rpy,
    inverse,
    rotation_about,
)
from simulation.cameras.board_picture import BoardPicture, PictureQuality

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 322.0, 241.0)
GRID = Board("grid", 3, 4, 0.08, 0.06, "DICT_4X4_50", 7, from_xyz_rpy((1.0, 0.2, 0.7), (3.0, 0.1, 0.4)))
CHARUCO = replace(GRID, kind="charuco", columns=4, rows=5)
TILTED = rotation_about((1.0, 0.5, 0.0), 0.5)


def before(rotation: NDArray[np.float64], distance_m: float, board: Board = GRID) -> Transform:
    """`T_camera_board` with the board's middle near the optical axis."""
    middle_m = np.array((*(0.5 * np.array(BoardLayout.of(board).size_m)), 0.0))
    return from_rotation_translation(rotation, np.array((0.02, -0.01, distance_m)) - rotation @ middle_m)


def pictures(
    T_camera_board: Transform, shown: Board = GRID, count: int = 6, **quality: float
) -> list[NDArray[np.uint8]]:
    picture = BoardPicture(BoardLayout.of(shown), CAMERA, PictureQuality(**quality))
    exposed, rng = picture.expose(T_camera_board), np.random.default_rng(1)
    return [picture.develop(exposed, rng) for _ in range(count)]


def found(images: list[NDArray[np.uint8]], board: Board = GRID) -> Localisation:
    localiser = BoardLocaliser(board, CAMERA)
    for image in images:
        localiser.add(image)
    return localiser.result()


def off_mm_deg(result: Localisation, T_camera_board: Transform, board: Board = GRID) -> tuple[float, float]:
    off = inverse(board.T_world_board @ inverse(T_camera_board)) @ result.T_world_camera
    return 1e3 * float(np.linalg.norm(off[:3, 3])), float(np.degrees(angle_rad(off)))


@pytest.mark.parametrize("board", [GRID, CHARUCO], ids=["grid", "charuco"])
def test_the_pose_is_found_with_its_uncertainty(board: Board) -> None:
    T_camera_board = before(TILTED, 1.0, board)
    result = found(pictures(T_camera_board, board), board)
    error_mm, error_deg = off_mm_deg(result, T_camera_board, board)
    assert error_mm < 1.0
    assert error_deg < 0.05
    assert error_mm < 3.0 * result.uncertainty_mm
    assert error_deg < 3.0 * result.uncertainty_deg
    assert result.uncertainty_mm < 1.5
    assert 0.0 < result.reprojection_px < 0.2
    assert (result.frames_used, result.frames_seen) == (6, 6)
    assert result.markers == result.markers_total == len(BoardLayout.of(board).ids)


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.2])
def test_blur_does_not_move_corners(blur_px: float) -> None:
    T_camera_board = before(np.eye(3), 0.6)
    layout = BoardLayout.of(GRID)
    corners_m = np.concatenate((layout.marker_corners_m, np.zeros((12, 4, 1))), axis=2)
    true = CAMERA.project(apply(T_camera_board, corners_m))
    image = pictures(T_camera_board, blur_px=blur_px, noise=0.0, count=1)[0]
    refined = refined_corners(image, true + np.random.default_rng(2).uniform(-0.8, 0.8, true.shape), 0.13)
    assert np.abs(refined - true).max() < 0.05


def test_the_stream_may_be_beside_the_depth_camera_and_distorted() -> None:
    T_camera_board = before(TILTED, 0.8)
    T_depth_image = from_xyz_rpy((0.015, 0.001, -0.002), (0.01, -0.02, 0.005))
    images = pictures(T_camera_board)
    localiser = BoardLocaliser(GRID, CAMERA, T_depth_image=T_depth_image)
    for image in images:
        localiser.add(image)
    expected = GRID.T_world_board @ inverse(T_camera_board) @ inverse(T_depth_image)
    off = inverse(expected) @ localiser.result().T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 1e-3
    plain = found(images).T_world_camera
    for model in ("brown_conrady", "inverse_brown_conrady"):
        bent = BoardLocaliser(GRID, CAMERA, (0.1, -0.05, 0.001, -0.001, 0.0), None, model)
        for image in images:
            bent.add(image)
        assert np.linalg.norm(bent.result().T_world_camera[:3, 3] - plain[:3, 3]) > 1e-3


def test_part_of_the_board_is_enough_and_other_markers_are_left() -> None:
    T_camera_board = before(TILTED, 0.8)
    other = replace(GRID, columns=2, rows=1, first_marker=30)
    own_again = replace(GRID, columns=1, rows=1, first_marker=9)
    picture = BoardPicture(BoardLayout.of(other), CAMERA)
    again = BoardPicture(BoardLayout.of(own_again), CAMERA)
    beside = picture.expose(from_rotation_translation(np.eye(3), (-0.38, -0.3, 0.8)))
    twice = again.expose(from_rotation_translation(np.eye(3), (0.3, -0.3, 0.8)))
    images = pictures(T_camera_board)
    for image in images:
        image[:100, :250] = beside[:100, :250]
        image[:100, 480:] = twice[:100, 480:]
        image[260:] = 90
    result = found(images)
    assert 3 <= result.markers < 12
    assert off_mm_deg(result, T_camera_board)[0] < 2.0


def test_frames_that_lie_far_off_are_dropped() -> None:
    good, bad = before(TILTED, 1.0), before(rotation_about((1.0, 0.0, 0.0), -0.5), 1.3)
    result = found([*pictures(good, count=9), *pictures(bad, count=2)])
    assert (result.frames_used, result.frames_seen) == (9, 11)
    assert off_mm_deg(result, good)[0] < 1.0


OTHER_GAP = replace(GRID, square_m=0.07)
REFUSED: dict[str, tuple[Callable[[], list[NDArray[np.uint8]]], str]] = {
    "nothing": (lambda: [np.full(CAMERA.shape, 90, np.uint8)] * 6, "none of the board's 12 markers"),
    "too far": (lambda: pictures(before(TILTED, 5.0)), "pixels wide|none of the board"),
    "oblique": (
        lambda: pictures(before(rotation_about((1.0, 0.0, 0.0), 1.31), 0.45)),
        "7[0-9] degrees from straight on",
    ),
    "another board": (lambda: pictures(before(TILTED, 0.7, OTHER_GAP), OTHER_GAP), "this cell's board"),
    "other markers": (lambda: pictures(before(TILTED, 0.7), replace(GRID, first_marker=30)), "none of the board"),
    "a mirror": (
        lambda: [image[:, ::-1] for image in pictures(before(TILTED, 0.7))],
        "none of the board|this cell's board",
    ),
    "moved": (
        lambda: [image for z in (0.8, 0.9, 1.0, 1.1) for image in pictures(before(TILTED, z), count=3)],
        "agree on a pose|from image to image",
    ),
    "few frames": (
        lambda: pictures(before(TILTED, 0.8), count=MIN_FRAMES - 1),
        f"in 4 of 4 images.* in {MIN_FRAMES} images",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_poor_view_is_refused_with_its_reason(case: str) -> None:
    images, reason = REFUSED[case]
    with pytest.raises(BoardError, match=reason):
        found(images())


def test_the_last_image_is_described() -> None:
    localiser = BoardLocaliser(GRID, CAMERA)
    assert localiser.now == "0 of 12 markers"
    assert localiser.add(pictures(before(TILTED, 0.8), count=1)[0]).T_board_image is not None
    assert localiser.now == "12 of 12 markers"
    assert localiser.frames_with_pose == 1
    localiser.clear()
    assert localiser.frames_with_pose == 0


def test_boards_that_cannot_be() -> None:
    with pytest.raises(CellError, match="DICT_7X9"):
        BoardLayout.of(replace(GRID, dictionary="DICT_7X9"))
    with pytest.raises(CellError, match="which has 50"):
        BoardLayout.of(replace(GRID, first_marker=45))


def test_black_rectangles_do_not_overlap_and_fill_the_markers() -> None:
    layout = BoardLayout.of(GRID)
    black_m = layout.black_m
    assert black_m.min() > -1e-12
    assert (black_m[:, 2:] > black_m[:, :2]).all()
    cell_m = GRID.marker_m / 6
    code = layout.dictionary.generateImageMarker(7, 6)
    area_m2 = np.prod(black_m[:, 2:] - black_m[:, :2], axis=1)
    first = (black_m[:, 2] <= GRID.marker_m + 1e-9) & (black_m[:, 3] <= GRID.marker_m + 1e-9)
    assert area_m2[first].sum() == pytest.approx((code == 0).sum() * cell_m**2)


def test_the_mean_of_poses_and_its_covariance() -> None:
    rng = np.random.default_rng(3)
    true = from_xyz_rpy((0.3, -1.0, 2.0), (3.1, 0.2, -3.1))
    noise = rng.normal(0.0, (2e-3, 1e-3, 4e-3, 1e-3, 2e-3, 5e-4), (400, 6))
    poses = np.array([
        from_rotation_translation(true[:3, :3] @ rotation_about(turn, float(np.linalg.norm(turn))), true[:3, 3] + shift)
        for shift, turn in zip(noise[:, :3], noise[:, 3:], strict=True)
    ])  # fmt: skip
    poses[::50] = from_xyz_rpy((0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    mean = mean_pose(poses)
    assert not mean.used[::50].any()
    assert mean.used.sum() >= 380
    off = inverse(true) @ mean.pose
    assert np.linalg.norm(off[:3, 3]) < 5e-4
    assert angle_rad(off) < 3e-4
    assert np.sqrt(np.diag(mean.spread)) == pytest.approx((2e-3, 1e-3, 4e-3, 1e-3, 2e-3, 5e-4), rel=0.15)
    assert np.sqrt(mean.covariance[0, 0]) == pytest.approx(1e-4, rel=0.15)
    with pytest.raises(InputError):
        mean_pose(np.empty((0, 4, 4)))
