# SPDX-License-Identifier: Apache-2.0
"""The unit's images as PNG, on request."""

from __future__ import annotations

import struct
import zlib
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline.depth_pipeline import DepthPipeline
from shared.errors import InputError
from shared.messages import PICTURE_RANGE_M

RAW_MAX = 65535
BEHIND_HEADER = 33
"""Offset at which a chunk may be inserted into a PNG: behind its signature and its header."""


def picture_raw(
    kind: Literal["expected", "foreground"],
    depth: NDArray[np.uint16],
    pipeline: DepthPipeline,
    joints: ArrayLike | None,
    joint_uncertainty_rad: ArrayLike,
) -> NDArray[np.uint16]:
    """Return an image (H, W) in units of depth_scale_m, 0 for nothing: the expected depth, or the foreground.

    It takes some milliseconds between two frames; call it only from the pipeline's own thread.
    """
    if kind == "expected":
        raw = np.rint(pipeline.expected_depth(joints) / pipeline.intrinsics.depth_scale_m)
        return np.where(raw <= RAW_MAX, raw, 0.0).astype(np.uint16)
    mask = pipeline.foreground(depth, joints, joint_uncertainty_rad=joint_uncertainty_rad)
    return np.where(mask, depth, np.uint16(0))


def png_of(picture: NDArray[np.uint16], depth_scale_m: float, raw: bool) -> bytes:
    """Encode an image (H, W) as PNG: 16 bits, or colours over PICTURE_RANGE_M (near red, far blue, nothing black)."""
    image = picture if raw else _colours(picture, depth_scale_m)
    done, data = cv2.imencode(".png", image)
    if not done:
        raise InputError(f"image of {picture.shape}: it cannot be encoded as PNG")
    text = f"depth_scale_m\0{depth_scale_m:g}" if raw else "X-Depth-Range-M\0{:g} {:g}".format(*PICTURE_RANGE_M)
    png = data.tobytes()
    return png[:BEHIND_HEADER] + _chunk(b"tEXt", text.encode("latin-1")) + png[BEHIND_HEADER:]


def _colours(picture: NDArray[np.uint16], depth_scale_m: float) -> NDArray[np.uint8]:
    near_m, far_m = PICTURE_RANGE_M
    share = (far_m - picture * np.float32(depth_scale_m)) / np.float32(far_m - near_m)
    coloured = cv2.applyColorMap((np.clip(share, 0.0, 1.0) * 255.0).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[picture == 0] = 0
    return np.asarray(coloured, np.uint8)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
