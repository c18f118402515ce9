# SPDX-License-Identifier: Apache-2.0
"""The background model: the static layer learned from the empty cell, as few cells are wholly in CAD."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import reference as kernels
from geometry.kernels.bundles import plain
from shared.camera import Intrinsics
from shared.errors import InputError
from shared.files import write_whole

SHARE_MIN = 0.15
"""A person who walks through the image covers a pixel for half a second: 5 % of ten seconds of learning. A surface that
stereo matching shows in one frame of six, at an edge, is real and must be expected."""

MATCH_BASE_M = 0.03
"""Depths that differ by less than this plus three standard deviations of stereo noise are one surface."""

MATCH_SIGMAS = 3.0

PRIOR_FRAMES = 4.0
"""Weight of the camera's noise model in a pixel's spread, in frames."""

MAX_FRAMES = 65535
"""Samples of a pixel are counted in uint16."""

DAMAGED = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Exceptions of numpy and zipfile for damaged bytes; a fuzz test finds no others."""

FILE_BYTES_MAX = 64 * 1024 * 1024
"""Two float32 images of the largest camera, uncompressed, and a header: a larger file is not a background model."""


@dataclass(frozen=True, eq=False)
class BackgroundModel:
    """Depth of the empty cell: `depth_m` and `spread_m` (H, W) float32 in metres, NaN where nothing was learned.

    It belongs to one camera at one pose: it is void after a move of the camera, or a change of its serial or profile.
    """

    depth_m: NDArray[np.float32]
    spread_m: NDArray[np.float32]
    frames: int

    def __post_init__(self) -> None:
        if self.depth_m.shape != self.spread_m.shape or self.depth_m.ndim != 2:
            raise InputError(
                f"reference: expected two images of one shape, got {self.depth_m.shape} and {self.spread_m.shape}"
            )
        if self.depth_m.dtype != np.float32 or self.spread_m.dtype != np.float32:
            raise InputError(f"reference: expected float32, got {self.depth_m.dtype} and {self.spread_m.dtype}")
        if self.frames < 1:
            raise InputError(f"reference: expected at least one frame, got {self.frames}")
        sound = (self.depth_m > 0.0) & np.isfinite(self.depth_m) & (self.spread_m >= 0.0) & np.isfinite(self.spread_m)
        if not (sound | np.isnan(self.depth_m)).all():
            raise InputError("reference: expected depths above 0 with a spread of at least 0, or NaN, got others")

    @property
    def learned_share(self) -> float:
        """Share of the pixels that have a learned depth."""
        return float(np.isfinite(self.depth_m).mean())

    def to_bytes(self) -> bytes:
        """Return it as a compressed npz."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, depth_m=self.depth_m, spread_m=self.spread_m, frames=np.int64(self.frames))
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> BackgroundModel:
        """Inverse of `to_bytes`.

        Raises:
            InputError: the bytes are not a background model.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as stored:
                depth_m, spread_m, frames = stored["depth_m"], stored["spread_m"], int(stored["frames"])
        except DAMAGED as error:
            raise InputError(f"reference: expected an npz with depth_m, spread_m and frames, got {error}") from error
        return cls(np.ascontiguousarray(depth_m), np.ascontiguousarray(spread_m), frames)

    def save(self, path: Path) -> None:
        """Write to `path`, whole or not at all.

        Raises:
            OSError: it cannot be written; the old file stays.
        """
        write_whole(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path) -> BackgroundModel:
        """Read a file of `save`.

        Raises:
            InputError: the file is missing, too large, or not a background model.
        """
        try:
            if path.stat().st_size > FILE_BYTES_MAX:
                raise InputError(f"expected at most {FILE_BYTES_MAX} bytes")
            return cls.from_bytes(path.read_bytes())
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


class BackgroundLearner:
    """Collects any number of frames of the empty cell in memory of fixed size."""

    def __init__(self, intrinsics: Intrinsics, noise_per_m: float, range_max_m: float) -> None:
        """`noise_per_m` is `c` of the camera's `sigma(z) = c * z**2`."""
        shape = (*intrinsics.shape, kernels.MODES)
        self._intrinsics = intrinsics
        self._noise_per_m = noise_per_m
        self._matching = plain(
            kernels.Matching(intrinsics.depth_scale_m, range_max_m, MATCH_BASE_M, MATCH_SIGMAS * noise_per_m)
        )
        self._modes = plain(
            kernels.Modes(
                looks=np.zeros(intrinsics.shape, np.uint16),
                numbers=np.zeros(shape, np.uint16),
                means_m=np.zeros(shape, np.float32),
                squares_m2=np.zeros(shape, np.float32),
            )
        )
        self.frames = 0

    def add(
        self,
        depth_raw: NDArray[np.uint16],
        robot_near_raw: NDArray[np.uint16],
        robot_span_raw: NDArray[np.uint16],
    ) -> None:
        """Add a frame (H, W), except for depths within the robot's band (H, W).

        Raises:
            InputError: MAX_FRAMES are reached.
        """
        if self.frames >= MAX_FRAMES:
            raise InputError(f"reference: expected at most {MAX_FRAMES} frames")
        kernels.observe(depth_raw, robot_near_raw, robot_span_raw, self._matching, self._modes)
        self.frames += 1

    def reference(self) -> BackgroundModel:
        """Return the background model of the frames so far.

        Raises:
            InputError: there was no frame.
        """
        if self.frames == 0:
            raise InputError("reference: expected at least one frame of the empty cell, got none")
        depth_m = np.empty(self._intrinsics.shape, np.float32)
        spread_m = np.empty(self._intrinsics.shape, np.float32)
        prior = plain(kernels.Prior(SHARE_MIN, PRIOR_FRAMES, self._noise_per_m))
        kernels.conclude(self._modes, prior, depth_m, spread_m)
        return BackgroundModel(depth_m, spread_m, self.frames)
