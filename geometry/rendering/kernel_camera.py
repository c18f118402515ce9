# SPDX-License-Identifier: Apache-2.0
"""A camera's intrinsics in the form of kernels' arguments."""

from __future__ import annotations

import numpy as np

from geometry.kernels.bundles import plain
from geometry.kernels.pinhole import Camera
from geometry.kernels.project import Screen
from shared.camera import Intrinsics


def camera_of(intrinsics: Intrinsics) -> Camera:
    """Return the camera as the plain tuple that a kernel takes."""
    c = intrinsics
    return plain(Camera(c.fx, c.fy, c.cx, c.cy, c.width, c.height))


def screen_of(intrinsics: Intrinsics, near_m: float) -> Screen:
    """Return the camera to render for, with its near plane at `near_m`, as the plain tuple that a kernel takes."""
    c = intrinsics
    fx, fy, cx, cy = np.float32(c.fx), np.float32(c.fy), np.float32(c.cx), np.float32(c.cy)
    return plain(Screen(fx, fy, cx, cy, np.float32(near_m), c.width, c.height))
