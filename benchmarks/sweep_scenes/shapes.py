# SPDX-License-Identifier: Apache-2.0
"""Things that must never be lost between voxels, and speckle that must be: our rule of density beside the paper's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.reporting.report import Mark, Result
from benchmarks.sweep_scenes.stage import Stage, above_table, lying, reported_at
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.meshes import box_mesh, cylinder_mesh
from shared.settings import FilterSettings
from shared.transforms import Transform, from_rotation_translation
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import Body, Owner

VOXELS_M = (0.02, 0.05)
ROOM_M = 1.0
"""Distance of the known floor below the thing: beyond every margin. Things cast a shadow on it."""

PLATE_M, PLATE_THICK_M = 0.10, 0.002
PLATE_DISTANCES_M = (1.0, 1.5, 2.0)
PLATE_VOXEL_M = 0.05
PLATE_PLACES = (0.0, 0.25, 0.5)
"""Centre of the plate along x and along y, in voxels from a voxel's corner. On a corner it is split most evenly."""

ROD_DISTANCE_M, ROD_RADIUS_M, ROD_LENGTH_M = 1.5, 0.01, 0.30
ROD_TILT_MAX_DEG = 60.0
ROD_LOST_SHARE_MAX = 0.01
ROD_PLACES_M = 0.3

SPECKLE_DISTANCE_M, SPECKLE_PX = 1.5, 20
SPECKLE_MARGIN_PX = 40
"""Distance of speckle from the image border, where its voxels would be outside the cell."""

Rules = dict[str, FilterSettings]
Lost = dict[str, int]
"""Number of frames in which each rule lost the thing (speckle: reported it)."""


def rules(settings: FilterSettings, voxel_size_m: float) -> Rules:
    """Return the compared rules by name, for one voxel size; ours is the first."""
    ours = settings.model_copy(update={"voxel_size_m": voxel_size_m})
    paper = {"density_rule": "single", "density_model": "angular"}
    return {
        "ours": ours,
        "paper 50 %": ours.model_copy(update={**paper, "occupancy_threshold": 0.5}),
        "paper 60 %": ours.model_copy(update={**paper, "occupancy_threshold": 0.6}),
    }


CAMERAS = {"perfect": DepthNoise.none(), "D435i": DepthNoise()}
"""A halo makes thin things wider, so a camera without faults is the harder test of the rules."""


@dataclass(frozen=True)
class Tally:
    """Results of one kind of thing with one camera: `lost` of `frames` by each rule."""

    thing: str
    camera: str
    distance_m: float
    voxel_m: float
    frames: int
    lost: Lost


# ---------------------------------------------------------------------------------------------------- plates


def plates(camera: str, distance_m: float, step_m: float, settings: FilterSettings) -> Tally:
    """Move a plate that faces the camera in steps through the depth of two voxels."""
    stage = above_table(distance_m + ROOM_M, CAMERAS[camera], seed=3)
    pipelines = _pipelines(stage, settings, PLATE_VOXEL_M)
    mesh = box_mesh("plate", (PLATE_M, PLATE_M, PLATE_THICK_M))
    lost = dict.fromkeys(pipelines, 0)
    steps = round(2.0 * PLATE_VOXEL_M / step_m)
    for k in range(steps):
        z_m = ROOM_M - PLATE_VOXEL_M + k * step_m
        for x in PLATE_PLACES:
            for y in PLATE_PLACES:
                place = (x * PLATE_VOXEL_M, y * PLATE_VOXEL_M, z_m)
                body = Body("plate", mesh, from_rotation_translation(np.eye(3), place), Owner.UNKNOWN)
                _tally(stage, body, pipelines, lost)
    return Tally("plate 10x10 cm", camera, distance_m, PLATE_VOXEL_M, steps * len(PLATE_PLACES) ** 2, lost)


# ---------------------------------------------------------------------------------------------------- rods


def rods(camera: str, voxel_m: float, tilt_max_deg: float, poses: int, settings: FilterSettings) -> Tally:
    """Show a rod at another place and in another direction in each frame.

    Up to 60 degrees from the image plane all tilts are equally frequent; at 90, all directions of space.
    """
    stage = above_table(ROD_DISTANCE_M + ROOM_M, CAMERAS[camera], seed=4)
    pipelines = _pipelines(stage, settings, voxel_m)
    mesh = cylinder_mesh("rod", ROD_RADIUS_M, ROD_LENGTH_M)
    rng = np.random.default_rng(5)
    lost = dict.fromkeys(pipelines, 0)
    for _ in range(poses):
        body = Body("rod", mesh, _rod_pose(rng, tilt_max_deg), Owner.UNKNOWN)
        _tally(stage, body, pipelines, lost)
    tilt = "any direction" if tilt_max_deg >= 90.0 else f"tilt to {tilt_max_deg:.0f}°"
    return Tally(f"rod 2x30 cm, {tilt}", camera, ROD_DISTANCE_M, voxel_m, poses, lost)


def _rod_pose(rng: np.random.Generator, tilt_max_deg: float) -> Transform:
    heading = rng.uniform(0.0, 2.0 * math.pi)
    tilt = math.asin(rng.uniform(0.0, 1.0)) if tilt_max_deg >= 90.0 else math.radians(rng.uniform(0.0, tilt_max_deg))
    place = (*rng.uniform(-ROD_PLACES_M, ROD_PLACES_M, 2), ROOM_M + rng.uniform(-0.05, 0.05))
    return from_rotation_translation(lying(heading, tilt), place)


# ---------------------------------------------------------------------------------------------------- speckle


def speckle(voxel_m: float, frames: int, settings: FilterSettings) -> Tally:
    """Show a blob of up to 20 pixels before a known floor, with another size, shape and place in each frame.

    Counts the frames in which it is reported; half of them have the largest blob.
    """
    stage = above_table(SPECKLE_DISTANCE_M + ROOM_M, CAMERAS["D435i"], seed=6)
    pipelines = _pipelines(stage, settings, voxel_m)
    sigma_m = float(DepthNoise().sigma_of(np.array([SPECKLE_DISTANCE_M]), stage.intrinsics)[0])
    rng = np.random.default_rng(7)
    reported = dict.fromkeys(pipelines, 0)
    for k in range(frames):
        depth = stage.frame().depth
        pixels = SPECKLE_PX if k % 2 else int(rng.integers(1, SPECKLE_PX + 1))
        rows, columns = blob(rng, pixels, stage.intrinsics)
        # A blob is one wrong match: all of it lies at one depth, except for the noise of each pixel.
        z_m = SPECKLE_DISTANCE_M + sigma_m * (rng.standard_normal() + math.sqrt(0.1) * rng.standard_normal(pixels))
        depth[rows, columns] = np.round(z_m / stage.intrinsics.depth_scale_m).astype(np.uint16)
        for rule, pipeline in pipelines.items():
            reported[rule] += len(pipeline.process(depth, None).voxels) > 0
    return Tally(f"speckle to {SPECKLE_PX} px (reported)", "D435i", SPECKLE_DISTANCE_M, voxel_m, frames, reported)


def blob(rng: np.random.Generator, pixels: int, intrinsics: Intrinsics) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns (pixels,) of a random connected blob."""
    start = rng.integers(SPECKLE_MARGIN_PX, np.array(intrinsics.shape) - SPECKLE_MARGIN_PX)
    found = {(int(start[0]), int(start[1]))}
    while len(found) < pixels:
        row, column = sorted(found)[rng.integers(len(found))]
        down, right = ((0, 1), (1, 0), (0, -1), (-1, 0))[rng.integers(4)]
        found.add((row + down, column + right))
    rows, columns = np.array(sorted(found)).T
    return rows, columns


# ---------------------------------------------------------------------------------------------------- all of them


def result(tallies: list[Tally]) -> Result:
    """Return the table, and the marks of our rule."""
    names = list(tallies[0].lost)
    rows: list[tuple[str | float, ...]] = []
    for t in tallies:
        shares = [100.0 * t.lost[rule] / t.frames for rule in names]
        rows.append((t.thing, t.camera, t.distance_m, 1e3 * t.voxel_m, t.frames, *shares))
    columns = ("thing", "camera", "distance m", "voxel mm", "frames", *(f"{rule}: lost %" for rule in names))
    return Result("Lost between voxels, by rule of density", columns, tuple(rows), tuple(_marks(tallies, names[0])))


def _marks(tallies: list[Tally], ours: str) -> list[Mark]:
    marks = []
    for t in tallies:
        name = f"{t.thing}, {t.camera} camera, {t.distance_m:g} m, {1e3 * t.voxel_m:.0f} mm voxels, % of frames"
        share = 100.0 * t.lost[ours] / t.frames
        if t.thing.startswith("plate") or (t.thing.startswith("speckle") and t.voxel_m == PLATE_VOXEL_M):
            marks.append(Mark(name, share, at_most=0.0))
        elif "tilt" in t.thing:
            marks.append(Mark(name, share, at_most=100.0 * ROD_LOST_SHARE_MAX))
    return marks


def _pipelines(stage: Stage, settings: FilterSettings, voxel_m: float) -> dict[str, DepthPipeline]:
    """Return a filter for each of the rules."""
    return {rule: stage.pipeline(chosen) for rule, chosen in rules(settings, voxel_m).items()}


def _tally(stage: Stage, body: Body, pipelines: dict[str, DepthPipeline], lost: Lost) -> None:
    """Filter one frame with `body` by every rule."""
    depth = stage.frame(body).depth
    for rule, pipeline in pipelines.items():
        lost[rule] += not reported_at(pipeline.process(depth, None).voxels, body)
