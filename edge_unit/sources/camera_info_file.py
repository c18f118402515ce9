# SPDX-License-Identifier: Apache-2.0
"""A camera's intrinsics from a file, in the forms that drivers and calibrators write, as the recorded images have them.

A depth image has no distortion here: its rays are those of a pinhole. A file that says anything else of the recorded
images, or that leaves open which of two cameras they are of, is refused and says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.camera import Intrinsics
from shared.configuration import sentence
from shared.errors import SourceError
from shared.text_files import parse_yaml_documents, read_text

DISTORTION_MAX_PX = 1e-3
"""A distortion that moves no pixel by more is none: drivers leave values of 1e-38 where they mean zero."""

SAME_PX = 1e-3
"""Two matrices of intrinsics that differ by less, in pixels, are one."""

PINHOLE_MODELS = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady")
"""Models of distortion that are a pinhole where their coefficients are zero; a fish-eye's is none with zeros, too."""

MESSAGE_KEYS = {"K": "k", "D": "d", "R": "r", "P": "p"}
"""Names of ROS 1, and those of ROS 2 for the same."""

CALIBRATOR_KEYS = {
    "image_width": "width",
    "image_height": "height",
    "camera_matrix": "k",
    "distortion_coefficients": "d",
    "rectification_matrix": "r",
    "projection_matrix": "p",
}
"""Names of ROS' camera calibrator, whose matrices are {rows, cols, data}, and those of the message for the same."""


class _Region(BaseModel):
    model_config = ConfigDict(extra="ignore")

    x_offset: int = Field(default=0, ge=0)
    y_offset: int = Field(default=0, ge=0)
    width: int = Field(default=0, ge=0)
    height: int = Field(default=0, ge=0)


class _CameraInfo(BaseModel):
    """A `sensor_msgs/CameraInfo`; its other fields say nothing of the geometry."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    k: list[float] = Field(min_length=9, max_length=9)
    d: list[float] = []
    distortion_model: str = ""
    r: list[float] | None = Field(default=None, min_length=9, max_length=9)
    p: list[float] | None = Field(default=None, min_length=12, max_length=12)
    binning_x: int = Field(default=0, ge=0)
    binning_y: int = Field(default=0, ge=0)
    roi: _Region = _Region()


@dataclass(frozen=True)
class Pinhole:
    """Width, height, focal lengths and principal point of an image in pixels; pixel centres at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def read_camera_info(path: Path, image_shape: tuple[int, int]) -> Pinhole:
    """Read the intrinsics of recorded images of `image_shape` (height, width).

    Takes `sensor_msgs/CameraInfo` of ROS 1 and 2 as YAML or JSON (also as `ros2 topic echo` prints it), and the file
    of ROS' camera calibrator. Applies `binning_x`, `binning_y` and `roi` where the images have the size that they give.

    Raises:
        SourceError: the file is missing or malformed, the images are distorted or of another size, or the file does
            not say for sure which intrinsics they have; names the file and the key.
    """
    try:
        content = _message(parse_yaml_documents(read_text(path)))
        found = _CameraInfo.model_validate(content)
        return _checked(found, image_shape)
    except ValidationError as error:
        raise SourceError(f"{path}: {sentence(error)}") from error
    except yaml.YAMLError as error:
        raise SourceError(f"{path}: expected YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise SourceError(f"{path}: expected values in a few levels, got them nested too deeply") from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error


def distortion_px(pinhole: Pinhole | Intrinsics, coefficients: NDArray[np.float64]) -> float:
    """Return by how many pixels (k1, k2, p1, p2, k3, k4, k5, k6) move the corners and edges of an image at most.

    Missing coefficients are zero, further ones (thin prism, tilt) count by their size. Infinite where the model has no
    value. Source: OpenCV's rational model, of which `plumb_bob` is the part without k4 to k6.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate((coefficients[:8], np.zeros(8 - min(8, coefficients.size))))
    u, v = np.meshgrid(np.linspace(0, pinhole.width - 1, 9), np.linspace(0, pinhole.height - 1, 9))
    x, y = (u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy
    square = x**2 + y**2
    with np.errstate(all="ignore"):
        radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
        dx = x * (radial - 1) + 2 * p1 * x * y + p2 * (square + 2 * x**2)
        dy = y * (radial - 1) + p1 * (square + 2 * y**2) + 2 * p2 * x * y
        moved = np.maximum(np.abs(dx * pinhole.fx), np.abs(dy * pinhole.fy)).max()
    further = np.abs(coefficients[8:]).sum() * (pinhole.fx + pinhole.fy) if coefficients.size > 8 else 0.0
    found = float(moved + further)
    return found if np.isfinite(found) else float("inf")


def _message(documents: list[Any]) -> Mapping[str, Any]:
    """The one message that a file holds, by the names of ROS 2."""
    messages = [document for document in documents if document is not None]
    if not messages or not all(isinstance(message, dict) for message in messages):
        raise ValueError("expected a camera_info as keys and values, got something else")
    found = [_renamed(message) for message in messages]
    geometry = [{key: message.get(key) for key in _CameraInfo.model_fields} for message in found]
    if any(other != geometry[0] for other in geometry):
        raise ValueError(f"expected one camera_info, got {len(found)} documents (between ---) that differ; keep one")
    return found[0]


def _renamed(message: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in message.items():
        name = MESSAGE_KEYS.get(key) or CALIBRATOR_KEYS.get(key) or key
        if name in found:
            raise ValueError(f"{key}: expected {name} once, got it by two names")
        if key in CALIBRATOR_KEYS and isinstance(value, dict):
            value = value.get("data")
        found[name] = value
    # Drivers that know no rectification send zeros.
    return {key: value for key, value in found.items() if not (key in ("r", "p") and _is_zero(value))}


def _is_zero(value: Any) -> bool:
    return value is None or (isinstance(value, list) and not any(value))


def _checked(found: _CameraInfo, image_shape: tuple[int, int]) -> Pinhole:
    k = np.reshape(found.k, (3, 3))
    if abs(k[0, 1]) > SAME_PX or np.abs(k[[1, 2, 2, 2], [0, 0, 1, 2]] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise ValueError(f"k: expected fx 0 cx 0 fy cy 0 0 1, row by row, got {found.k}")
    full = Pinhole(found.width, found.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    _check_rays(found, full, k)
    taken = _of_image(found, full, image_shape)
    if not (-0.5 <= taken.cx <= taken.width - 0.5 and -0.5 <= taken.cy <= taken.height - 0.5):
        raise ValueError(
            f"k: expected the principal point inside an image of {taken.width} x {taken.height} pixels, got "
            f"({taken.cx:g}, {taken.cy:g}); k may be that of an image of another size"
        )
    return taken


def _check_rays(found: _CameraInfo, full: Pinhole, k: NDArray[np.float64]) -> None:
    """Refuse whatever makes the rays others than those of a pinhole with the matrix `k`."""
    if found.distortion_model.lower() not in PINHOLE_MODELS:
        raise ValueError(
            f"distortion_model: expected one of a pinhole ({', '.join(PINHOLE_MODELS[2:])}), "
            f"got {found.distortion_model}; rectify the images first"
        )
    if not (full.fx > 0.0 and full.fy > 0.0):
        raise ValueError(f"k: expected focal lengths above 0, got {full.fx:g} and {full.fy:g}")
    moved_px = distortion_px(full, np.array(found.d))
    if moved_px > DISTORTION_MAX_PX:
        raise ValueError(
            f"d: expected images without distortion, got {found.d}, which moves pixels by up to {moved_px:.3g}; "
            "rectify the images first"
        )
    rectified = found.r is not None and np.abs(np.reshape(found.r, (3, 3)) - np.eye(3)).max() > 1e-6
    if found.p is not None and (rectified or np.abs(np.reshape(found.p, (3, 4))[:, :3] - k).max() > SAME_PX):
        raise ValueError(
            f"p differs from k{' and r is no identity' if rectified else ''}: the file tells of raw and of rectified "
            "images. For rectified images (image_rect) write the numbers of p as k; for raw ones leave p and r out"
        )


def _of_image(found: _CameraInfo, full: Pinhole, image_shape: tuple[int, int]) -> Pinhole:
    """The intrinsics after region and binning, where they give the images' size."""
    height, width = image_shape
    region, bin_x, bin_y = found.roi, max(found.binning_x, 1), max(found.binning_y, 1)
    whole, part = (0, 0, full.width, full.height), (region.x_offset, region.y_offset, region.width, region.height)
    cropped = region.width * region.height > 0 and part != whole
    x, y, wide, high = part if cropped else whole
    changed = [key for key, given in (("roi", cropped), ("binning_x, binning_y", bin_x * bin_y > 1)) if given]
    if (height, width) == (high // bin_y, wide // bin_x) and x + wide <= full.width and y + high <= full.height:
        # A binned pixel's centre is the mean of those that it holds.
        return Pinhole(
            width,
            height,
            full.fx / bin_x,
            full.fy / bin_y,
            (full.cx - x + 0.5) / bin_x - 0.5,
            (full.cy - y + 0.5) / bin_y - 0.5,
        )
    if changed:
        raise ValueError(
            f"{' and '.join(changed)}: expected images of {wide // bin_x} x {high // bin_y} pixels out of "
            f"{full.width} x {full.height}, got images of {width} x {height}; take the camera_info that was published "
            "with these images, or write k of the images and leave these keys out"
        )
    raise ValueError(
        f"width, height: expected those of the images, {width} x {height}, got {full.width} x {full.height}; "
        "k belongs to images of that size"
    )
