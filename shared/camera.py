# SPDX-License-Identifier: Apache-2.0
"""Pinhole intrinsics of a depth camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, core_schema

from shared.configuration import sentence
from shared.errors import InputError

MAX_SIDE_PX = 4096
"""Larger than the image side of any known depth camera; keeps a pixel index well inside int32."""

D435_BASELINE_M = 0.050
"""Baseline of the two infrared imagers of a RealSense D435/D435i (data sheet: 50 mm)."""


def _complete(fields: object) -> object:
    """Reject a document with a missing field; pydantic would call `__init__` with it, and Python raises TypeError."""
    if isinstance(fields, dict):
        missing = [name for name in ("width", "height", "fx", "fy", "cx", "cy") if name not in fields]
        if missing:
            raise ValueError(f"expected {', '.join(missing)}, got none")
        if not all(isinstance(name, str) for name in fields):
            raise ValueError("expected field names as text, got another type")
    return fields


class Intrinsics(BaseModel):
    """A pinhole camera without distortion; pixel centres are at integer coordinates.

    `fx, fy, cx, cy` are in pixels. A raw depth of 1 is `depth_scale_m` metres.

    The camera measures depth by stereo. With the focal length `f` in pixels at which the imagers match (`fx_stereo`),
    their baseline `b` in metres and the disparity `d` in pixels, depth is `z = f * b / d`. A disparity error of
    `subpixel` pixels therefore gives the depth error

        sigma(z) = |dz/dd| * subpixel = subpixel * z**2 / (fx_stereo * baseline),

    in metres: it grows with the square of the depth. `disparity_noise_m` returns the constant factor. `fx_stereo`
    differs from `fx` when the depth image was aligned to another camera; None means that they are equal.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int = Field(gt=0, le=MAX_SIDE_PX)
    height: int = Field(gt=0, le=MAX_SIDE_PX)
    fx: float = Field(gt=0.0, allow_inf_nan=False)
    fy: float = Field(gt=0.0, allow_inf_nan=False)
    cx: float = Field(allow_inf_nan=False)
    cy: float = Field(allow_inf_nan=False)
    depth_scale_m: float = Field(default=0.001, ge=1e-6, le=0.1)
    stereo_baseline_m: float = Field(default=D435_BASELINE_M, ge=0.005, le=1.0)
    fx_stereo: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)

    def __init__(
        self,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        depth_scale_m: float = 0.001,
        stereo_baseline_m: float = D435_BASELINE_M,
        fx_stereo: float | None = None,
        **unknown: object,
    ) -> None:
        """Check all fields.

        Raises:
            InputError: a field is out of range or unknown; the text names it. Inside a model, the model reports it.
        """
        try:
            super().__init__(
                width=width,
                height=height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                depth_scale_m=depth_scale_m,
                stereo_baseline_m=stereo_baseline_m,
                fx_stereo=fx_stereo,
                **unknown,
            )
        except ValidationError as error:
            raise InputError(f"intrinsics: {sentence(error)}") from error

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Check a document before it is passed as arguments: pydantic's own hooks run only inside `__init__`."""
        return core_schema.no_info_before_validator_function(_complete, handler(source))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image."""
        return self.height, self.width

    @property
    def stereo_focal_px(self) -> float:
        """Focal length in pixels at which the imagers match: `fx_stereo`, or `fx` when that is None."""
        return self.fx if self.fx_stereo is None else self.fx_stereo

    def disparity_noise_m(self, subpixel_px: float) -> float:
        """Return the factor `c` of the stereo depth error `sigma(z) = c * z**2`, in 1/m.

        `c = subpixel_px / (stereo_focal_px * stereo_baseline_m)`; `subpixel_px` is the standard deviation of the
        disparity in pixels. Example: 0.12 px, 640 px and 0.05 m give 0.00375 / m, so 15 mm at 2 m.
        """
        return subpixel_px / (self.stereo_focal_px * self.stereo_baseline_m)

    def deproject(self, depth: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Return points (H, W, 3), metres, camera frame, of a raw depth image (H, W); z is 0 without a measurement."""
        z_m = depth.astype(np.float64) * self.depth_scale_m
        v, u = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack(((u - self.cx) / self.fx * z_m, (v - self.cy) / self.fy * z_m, z_m), axis=-1)

    def project(self, points_camera_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixel coordinates (..., 2) as (u, v) of points (..., 3) in metres in front of the camera."""
        x, y, z = np.moveaxis(points_camera_m, -1, 0)
        return np.stack((x / z * self.fx + self.cx, y / z * self.fy + self.cy), axis=-1)

    def check_depth(self, depth: object) -> NDArray[np.uint16]:
        """Return `depth` if it is a (height, width) uint16 image in C order.

        Raises:
            InputError: `depth` is not an array, is masked, or has another dtype or shape.
        """
        if not isinstance(depth, np.ndarray):
            raise InputError(f"depth: expected a numpy array, got {type(depth).__name__}")
        if isinstance(depth, np.ma.MaskedArray):
            raise InputError(
                "depth: expected a plain numpy array with 0 for pixels without a measurement, got a masked array"
            )
        if depth.dtype != np.uint16:
            raise InputError(f"depth: expected dtype uint16 (units of depth_scale_m), got {depth.dtype}")
        if depth.shape != self.shape:
            raise InputError(f"depth: expected shape {self.shape} (height, width), got {depth.shape}")
        return np.ascontiguousarray(depth)
