# SPDX-License-Identifier: Apache-2.0
"""All static surfaces before one camera: CAD, known objects and background model, prepared for the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline.background_model import BackgroundModel
from edge_unit.pipeline.edge_halo import EdgeHalo
from edge_unit.pipeline.expected_depth import StaticLayer
from geometry.kernels import limits
from geometry.kernels.bundles import plain
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import InputError
from shared.settings import FilterSettings
from shared.transforms import Transform

EDGE_RADIUS_WIDTH_PX = 1280
"""`edge_radius_px` is given for this width; an edge's blur covers the same angle at every resolution."""


@dataclass(frozen=True, eq=False)
class StaticImages:
    """The images (H, W) that a frame is compared with, pixel by pixel.

    Attributes:
        minimum_raw: the nearest raw depth that counts.
            room_raw: uint16, a depth at least this far beyond `minimum_raw` is explained by a static surface.
        seen_limit_raw: uint16, the depth up to which a pixel's ray surely meets no static surface.
        depth_m: float32, depth of the nearest surface, unpadded; inf where nothing is known.
        depth_raw: uint16, the same in raw units; 0 where nothing is known.
        standing_raw: uint16, as `depth_raw` without known objects, which may be carried away before it is reported.
    """

    minimum_raw: int
    room_raw: NDArray[np.uint16]
    seen_limit_raw: NDArray[np.uint16]
    depth_m: NDArray[np.float32]
    depth_raw: NDArray[np.uint16]
    standing_raw: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Bodies:
    """CAD and known objects, drawn from the camera's pose."""

    cad: StaticLayer
    objects: StaticLayer

    @classmethod
    def of(cls, intrinsics: Intrinsics, cell: Cell, T_world_camera: Transform) -> Bodies:
        """Draw the cell's bodies."""
        return cls(StaticLayer(intrinsics, cell.static), StaticLayer(intrinsics, cell.objects)).drawn(T_world_camera)

    def of_cell(self, cell: Cell, T_world_camera: Transform) -> Bodies:
        """Return the bodies of another cell; layers without a moved body are kept."""
        return Bodies(self.cad.of(cell.static), self.objects.of(cell.objects)).drawn(T_world_camera)

    def drawn(self, T_world_camera: Transform) -> Bodies:
        """Draw both layers from `T_world_camera`, unless they are drawn so already."""
        self.cad.draw(T_world_camera)
        self.objects.draw(T_world_camera)
        return self

    @property
    def nearest_w(self) -> NDArray[np.float32]:
        """Inverse depth (H, W) of the nearest surface in 1/m, 0 where there is none."""
        return np.asarray(np.maximum(self.cad.nearest_w, self.objects.nearest_w))

    def depth_m(self) -> NDArray[np.float32]:
        """Depth (H, W) of the nearest surface in metres, inf where there is none."""
        return _depth_m(self.nearest_w)


class StaticModel:
    """The static surfaces before one camera.

    Attributes:
        bodies: CAD and known objects.
        reference: the background model; None if there is none.
        images: the images that a frame is compared with.
        halo: the false depths beside edges of the CAD.
        version: rises with each change of these.
    """

    def __init__(self, intrinsics: Intrinsics, bodies: Bodies, settings: FilterSettings) -> None:
        self._intrinsics = intrinsics
        self._settings = settings
        self._unlearned = np.full(intrinsics.shape, np.nan, np.float32)
        self._limit_raw = np.empty(intrinsics.shape, np.uint16)
        self._seen_limit_raw = np.empty(intrinsics.shape, np.uint16)
        self._room_raw = np.empty(intrinsics.shape, np.uint16)
        self._scratch_raw = np.empty((2, *intrinsics.shape), np.uint16)
        self.bodies = bodies
        self.reference: BackgroundModel | None = None
        self.halo = EdgeHalo(intrinsics)
        self.version = 0
        self.images = self._renewed()

    def change(self, bodies: Bodies, settings: FilterSettings) -> None:
        """Use other bodies, or the same for another pose of the camera, and other settings."""
        self.bodies, self._settings = bodies, settings
        self.images = self._renewed()

    def use(self, reference: BackgroundModel | None) -> None:
        """Make `reference` part of the model; None removes it.

        Raises:
            InputError: it is of another resolution; the old one stays.
        """
        if reference is not None and reference.depth_m.shape != self._intrinsics.shape:
            raise InputError(
                f"reference: expected images of {self._intrinsics.shape} (height, width), got {reference.depth_m.shape}"
            )
        self.reference = reference
        self.images = self._renewed()

    def _renewed(self) -> StaticImages:
        """Compute the limits of all static surfaces, less margins, as the minimum over the blur of an edge."""
        settings, camera = self._settings, self._intrinsics
        w = self.bodies.nearest_w
        learned = self.reference
        reference_m = learned.depth_m if learned else self._unlearned
        spread_m = learned.spread_m if learned else self._unlearned
        cad_noise_per_m = settings.margin_noise_gain * camera.disparity_noise_m(settings.stereo_subpixel_px)
        raw, scratch = self._scratch_raw
        limits.static_limit_raw(
            w,
            reference_m,
            spread_m,
            plain(
                limits.Margins(
                    settings.margin_base_m,
                    cad_noise_per_m,
                    settings.reference_margin_base_m,
                    settings.reference_spread_gain,
                    settings.range_max_m,
                    camera.depth_scale_m,
                )
            ),
            raw,
        )
        radius_px = round(settings.edge_radius_px * camera.width / EDGE_RADIUS_WIDTH_PX)
        limits.nearest_over(raw, radius_px, scratch, self._limit_raw)
        minimum_raw = min(max(int(np.ceil(settings.range_min_m / camera.depth_scale_m)), 1), limits.RAW_MAX)
        np.subtract(np.maximum(self._limit_raw, minimum_raw), minimum_raw, out=self._room_raw)
        self.halo.renew(w, settings.static_padding_m, settings.margin_base_m, cad_noise_per_m)
        self.halo.lower(self._limit_raw, self._seen_limit_raw)
        depth_m = np.fmin(_depth_m(w), reference_m)
        self.version += 1
        return StaticImages(
            minimum_raw=minimum_raw,
            room_raw=self._room_raw,
            seen_limit_raw=self._seen_limit_raw,
            depth_m=depth_m,
            depth_raw=self._raw(depth_m),
            standing_raw=self._raw(np.fmin(_depth_m(self.bodies.cad.nearest_w), reference_m)),
        )

    def _raw(self, depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Depth (H, W) in raw units, 0 where nothing is known or it is too far for 16 bits."""
        raw = np.nan_to_num(depth_m / self._intrinsics.depth_scale_m, nan=0.0, posinf=0.0)
        return np.where(raw < limits.RAW_MAX, raw, 0.0).astype(np.uint16)


def _depth_m(w_per_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) in metres of inverse depth, inf where that is 0."""
    depth_m = np.full(w_per_m.shape, np.inf, np.float32)
    np.divide(1.0, w_per_m, out=depth_m, where=w_per_m > 0.0)
    return depth_m
