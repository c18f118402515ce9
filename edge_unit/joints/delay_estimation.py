# SPDX-License-Identifier: Apache-2.0
"""Estimation of the joints' delay against the frames, from motion that happens anyway.

For each possible delay, the robot is drawn at the joints of that delay. The true delay is the one at which many frames
with motion fit best. The robot need not move for it. A camera makes near things wider on all sides alike, and this does
not bias the result: the excess ahead of the robot equals the excess behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline import BareRobot
from edge_unit.pipeline.pose_misfit import SCALE_BASE_M, SCALE_NOISE_GAIN
from geometry.kernels.misfit import UNKNOWN_MISFIT
from geometry.rendering import Links
from shared.camera import Intrinsics
from shared.errors import InputError
from shared.kinematics import Robot
from shared.settings import FilterSettings
from shared.transforms import Transform, inverse

Number = TypeVar("Number", np.float32, np.uint16)

DELAYS_S = np.arange(-10, 21) * 0.01
"""The delays that are tried: times may also be too early, if a camera's are late."""

FIT_REACH_S = 0.035
"""A parabola is fitted this far about the best delay: beyond, the robot left its own width and the curve is flat."""

COLUMNS_LOOKED_AT = 212
"""Columns of the image that are used: some thousand pixels lie on the robot's rim in each frame."""

MOTION_SPAN_S = 0.1
MOTION_MIN_M = 0.02
"""A frame counts if some point of the robot may move by so much in that time: at 0.2 m/s."""

LOOKS_MIN = 24
"""With fewer frames of motion there is no estimate."""

GROUPS = 8
"""Groups of frames; each is left out once, and the resulting change gives the estimate's uncertainty."""


@dataclass(frozen=True)
class DelayEstimate:
    """`delay_s` is the right `joint_delay_s`, with one standard deviation `uncertainty_s`, from `looks` frames."""

    delay_s: float
    uncertainty_s: float
    looks: int


class DelayComparison:
    """Compares frames of one camera with the robot drawn at each of `DELAYS_S`."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        T_world_camera: Transform,
        robot: Robot,
        static_depth_m: NDArray[np.float32],
        settings: FilterSettings,
    ) -> None:
        """`static_depth_m` (H, W): depth of the static surfaces, inf where nothing is known: `expected_depth(None)`."""
        self._robot = robot
        self._stride_px = stride_px = max(round(intrinsics.width / COLUMNS_LOOKED_AT), 1)
        self._first_px = stride_px // 2
        self._static_depth_m = self._thinned(static_depth_m)
        height, width = self._static_depth_m.shape
        self._small = Intrinsics(
            width,
            height,
            intrinsics.fx / stride_px,
            intrinsics.fy / stride_px,
            (intrinsics.cx - self._first_px) / stride_px,
            (intrinsics.cy - self._first_px) / stride_px,
        )
        self._links = Links(robot, inverse(T_world_camera))
        self._scale_m = intrinsics.depth_scale_m
        self._noise_per_m = SCALE_NOISE_GAIN * intrinsics.disparity_noise_m(settings.stereo_subpixel_px)

    @cached_property
    def _bare_robot(self) -> BareRobot:
        # Made with the first comparison, in its thread: it prepares the CAD of all links.
        return BareRobot(self._small, self._robot)

    def thinned(self, depth: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the input of `misfits` for a frame (H, W): a few thousand depths in metres, a copy."""
        return np.asarray(self._thinned(depth) * np.float32(self._scale_m), np.float32)

    def moves(self, before: ArrayLike, after: ArrayLike) -> bool:
        """Return True if the robot moves enough; joints (n,) half of `MOTION_SPAN_S` before and after the frame."""
        turned = np.abs(np.subtract(after, before))
        return float(self._robot.displacement_m(turned, before).max(initial=0.0)) >= MOTION_MIN_M

    def misfits(self, thinned_m: NDArray[np.float32], joints: Sequence[ArrayLike]) -> NDArray[np.float64]:
        """Return the misfit of a frame, summed over its pixels, for joints (n,) at each of the delays."""
        measured = thinned_m > 0.0
        depth_m = thinned_m[measured]
        scale_m = SCALE_BASE_M + self._noise_per_m * depth_m**2
        return np.array([self._misfit(measured, depth_m, scale_m, each) for each in joints])

    def _misfit(
        self,
        measured: NDArray[np.bool_],
        depth_m: NDArray[np.float32],
        scale_m: NDArray[np.float32],
        joints: ArrayLike,
    ) -> float:
        expected_m = self._static_depth_m.copy()
        self._bare_robot.lower(self._links.place(joints), expected_m)
        squares = ((depth_m - expected_m[measured]) / scale_m) ** 2
        misfit = np.where(np.isfinite(squares), 1.0 - 1.0 / (1.0 + squares), UNKNOWN_MISFIT)
        return float(misfit.sum(dtype=np.float64))

    def _thinned(self, image: NDArray[Number]) -> NDArray[Number]:
        first, stride = self._first_px, self._stride_px
        return np.ascontiguousarray(image[first::stride, first::stride])


def estimate_delay(misfits: Collection[NDArray[np.float64]]) -> DelayEstimate:
    """Estimate the delay from results of `DelayComparison.misfits`.

    Raises:
        InputError: there are too few frames, as the robot hardly moved; or no delay fits better than all others.
    """
    if len(misfits) < LOOKS_MIN:
        raise InputError(
            f"joint delay: the robot hardly moved: {len(misfits)} frames with motion of {MOTION_MIN_M / MOTION_SPAN_S} "
            f"m/s and more in view, expected at least {LOOKS_MIN}"
        )
    frames = np.array(misfits)
    sums = np.array([frames[group::GROUPS].sum(axis=0) for group in range(GROUPS)])
    whole = sums.sum(axis=0)
    delay_s = _best(whole)
    without_s = np.array([_best(whole - part) for part in sums])
    uncertainty_s = float(np.sqrt((GROUPS - 1) / GROUPS * ((without_s - without_s.mean()) ** 2).sum()))
    return DelayEstimate(delay_s, uncertainty_s, len(misfits))


def _best(curve: NDArray[np.float64]) -> float:
    """Return the position of the lowest point of a parabola about the least of the misfits (D,)."""
    lowest = float(DELAYS_S[int(np.argmin(curve))])
    near = np.abs(DELAYS_S - lowest) <= FIT_REACH_S
    if np.count_nonzero(near) < round(2.0 * FIT_REACH_S / (DELAYS_S[1] - DELAYS_S[0])):
        raise InputError(
            f"joint delay: the robot fits best at {1e3 * lowest:.0f} ms, at the end of the tried range: "
            "check that the times of frames and joints are of the same clock"
        )
    square, slope, _ = np.polyfit(DELAYS_S[near] - lowest, curve[near], 2)
    if not square > 0.0:
        raise InputError("joint delay: no delay fits better than others: check that the camera sees the robot move")
    return lowest - 0.5 * float(slope / square)


def compare_frame(
    comparison: DelayComparison,
    depth: NDArray[np.uint16],
    captured_s: float,
    joints_at: Callable[[float], NDArray[np.float64] | None],
) -> NDArray[np.float64] | None:
    """Return the misfits of a frame (H, W) of this time in s, for joints by their own times; None if it is useless.

    A frame is useful if the robot moved, and all joints about that time are known.
    """
    offsets_s = (-0.5 * MOTION_SPAN_S, 0.5 * MOTION_SPAN_S, *DELAYS_S.tolist())
    joints = [each for offset_s in offsets_s if (each := joints_at(captured_s + offset_s)) is not None]
    if len(joints) < len(offsets_s) or not comparison.moves(joints[0], joints[1]):
        return None
    return comparison.misfits(comparison.thinned(depth), joints[2:])
