# SPDX-License-Identifier: Apache-2.0
"""The method, one line for each stage: from a depth image to the obstacle voxels of the cell."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline.background_model import BackgroundLearner, BackgroundModel
from edge_unit.pipeline.fit_check import HealthCheck
from edge_unit.pipeline.frame_result import FrameResult
from edge_unit.pipeline.moving_model import EXACT, MovingModel
from edge_unit.pipeline.pose_misfit import MisfitCheck
from edge_unit.pipeline.pose_refinement import Refiner
from edge_unit.pipeline.stage_times import StageRunner
from edge_unit.pipeline.static_model import Bodies, StaticModel
from edge_unit.pipeline.visibility import Visibility
from edge_unit.pipeline.voxelizer import Voxelizer
from geometry.kernels import foreground, limits
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import InputError
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import validated

Kind = TypeVar("Kind")


class DepthPipeline:
    """One camera's filter. Not for use from several threads at once.

    Each change (`apply`, `move`, `use_cell`, `adopt`, `use`) takes effect with the next frame.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        T_world_camera: ArrayLike,
        cell: Cell,
        settings: FilterSettings | None = None,
    ) -> None:
        """Prepare everything that no frame changes.

        Args:
            intrinsics: intrinsics of the depth camera.
            T_world_camera: (4, 4) pose of its optical frame in the cell.
            cell: the watched workspace.
            settings: None: the defaults.

        Raises:
            InputError: an argument has a wrong type, the pose is not a rigid transform, or the lattice would be too
                large.
        """
        self.intrinsics = _of_type(intrinsics, Intrinsics, "intrinsics")
        self.cell = _of_type(cell, Cell, "cell")
        self.settings = FilterSettings() if settings is None else _of_type(settings, FilterSettings, "settings")
        self.T_world_camera = validated(T_world_camera, "T_world_camera")
        self._voxelizer = self._voxelizer_of(cell, self.settings)
        self._visibility = self._visibility_of(cell, self.settings)
        self._health = HealthCheck(intrinsics)
        self._misfit = MisfitCheck(intrinsics)
        self._moving = MovingModel(intrinsics, cell.robot, self.T_world_camera, self.settings)
        self._static = StaticModel(intrinsics, Bodies.of(intrinsics, cell, self.T_world_camera), self.settings)

    # ------------------------------------------------------------------ stages of a frame

    def process(
        self,
        depth: NDArray[np.uint16],
        joints: ArrayLike | None,
        *,
        joint_uncertainty_rad: ArrayLike = EXACT,
        with_misfit: bool = False,
    ) -> FrameResult:
        """Find the obstacle voxels of one frame, its seen blocks, and its fit to the known surfaces.

        Args:
            depth: (H, W) uint16 in units of depth_scale_m, 0 where nothing was measured.
            joints: (n,) rad (m where prismatic) at the frame's time; None if they are not known: then the robot is
                reported, not filtered.
            joint_uncertainty_rad: uncertainty of each joint, one number or (n,); it widens the padding.
            with_misfit: also compare the frame with poses close to the camera's pose.

        Raises:
            InputError: depth or joints have the wrong type, shape or values.
        """
        depth_raw = self.intrinsics.check_depth(depth)
        known, settings = self._static.images, self.settings
        stages = StageRunner()
        robot = stages.run("expected", self._moving.place, joints, joint_uncertainty_rad)
        voxels = self._voxelizer.voxels(depth_raw, known.room_raw, known.minimum_raw, robot, self._static.halo, stages)
        seen = stages.run("seen", self._visibility.find_seen, depth_raw, known.seen_limit_raw, robot.near_raw)
        health = stages.run("health", self._health.check, depth_raw, known.depth_raw, robot.near_raw, settings)
        misfit = None
        if with_misfit:
            standing = known.standing_raw
            misfit = stages.run("misfit", self._misfit.check, depth_raw, standing, robot.near_raw, settings)
        return FrameResult(voxels, seen, health, stages.times(), misfit)

    def foreground(
        self, depth: NDArray[np.uint16], joints: ArrayLike | None, *, joint_uncertainty_rad: ArrayLike = EXACT
    ) -> NDArray[np.bool_]:
        """Return the pixels (H, W) that survive the filter; arguments and errors as in `process`."""
        depth_raw, known = self.intrinsics.check_depth(depth), self._static.images
        robot = self._moving.place(joints, joint_uncertainty_rad)
        mask = np.empty(self.intrinsics.shape, np.uint8)
        foreground.foreground_mask(depth_raw, known.room_raw, known.minimum_raw, robot.bundle, mask)
        self._static.halo.drop(depth_raw, mask)
        return mask.view(np.bool_)

    def expected_depth(
        self, joints: ArrayLike | None, *, joint_uncertainty_rad: ArrayLike = EXACT
    ) -> NDArray[np.float32]:
        """Return the depth (H, W) in metres of the nearest known surface, unpadded; inf where nothing is known.

        Without joints the robot counts as unknown. The uncertainty widens the filter only, never the expected depth.
        """
        nearest_m = self._static.images.depth_m.copy()
        self._moving.lower(joints, joint_uncertainty_rad, nearest_m)
        return nearest_m

    # ------------------------------------------------------------------ learning the empty cell

    def learn(self, frames: Iterable[tuple[NDArray[np.uint16], ArrayLike | None]]) -> BackgroundModel:
        """Learn the background model from frames of the empty cell; `use` makes it part of the static layer.

        Args:
            frames: pairs of depth (H, W) uint16 and joints (n,).

        Raises:
                InputError: there was no frame, one is not a pair, or the cell has a robot and joints are missing.
        """
        learner = self.learner()
        pairs: Iterable[object] = _of_type(frames, Iterable, "frames")
        for pair in pairs:
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                came = f"{len(pair)} values" if isinstance(pair, (tuple, list)) else type(pair).__name__
                raise InputError(f"frames: expected pairs of depth and joints, got {came}")
            self.learn_frame(learner, *pair)
        return learner.reference()

    def learner(self) -> BackgroundLearner:
        """Return a learner for this camera, to be fed with `learn_frame`."""
        return BackgroundLearner(self.intrinsics, self._noise_per_m, self.settings.range_max_m)

    def learn_frame(self, learner: BackgroundLearner, depth: NDArray[np.uint16], joints: ArrayLike | None) -> None:
        """Add one frame of the empty cell to `learner`; arguments and errors as in `learn`.

        The robot's pixels are left out by its padded render. Links that never move are static and are learned, since
        leaving them out would leave an unlearned ring around the base.
        """
        _of_type(learner, BackgroundLearner, "learner")
        depth_raw = self.intrinsics.check_depth(depth)
        if self.cell.robot is not None and joints is None:
            raise InputError("learn: expected joints with each frame, as the robot must not be learned as background")
        robot = self._moving.place(joints, without_fixed_links=True)
        learner.add(depth_raw, robot.near_raw, robot.span_raw)

    def use(self, reference: BackgroundModel | None) -> None:
        """Make `reference` part of the static layer from now on; None removes it.

        Raises:
            InputError: it is not a background model, or is of another resolution; the old one stays.
        """
        self._static.use(None if reference is None else _of_type(reference, BackgroundModel, "reference"))

    @property
    def reference(self) -> BackgroundModel | None:
        """The background model in use."""
        return self._static.reference

    # ------------------------------------------------------------------ refinement of the pose

    def without_robot(self, depth: NDArray[np.uint16], joints: ArrayLike | None) -> NDArray[np.uint16]:
        """Copy a frame (H, W), with depth 0 where the padded robot may be; errors as `process`.

        Without joints the robot's pixels stay in the image: its position is not known.
        """
        bare = self.intrinsics.check_depth(depth).copy()
        bare[self._moving.place(joints).near_raw < limits.RAW_MAX] = 0
        return bare

    def refiner(self) -> Refiner:
        """Return a refiner: it refines the pose by the CAD, from frames of `without_robot`; `move` applies its pose."""
        return Refiner(self.intrinsics, self.T_world_camera, self._static.bodies.depth_m(), self._noise_per_m)

    # ------------------------------------------------------------------ changes at run time

    @property
    def lattice(self) -> Lattice:
        """The lattice of the reported voxels."""
        return self._voxelizer.lattice

    @property
    def static_version(self) -> int:
        """A number that rises with each change of the static layer."""
        return self._static.version

    def apply(self, settings: FilterSettings) -> None:
        """Use other settings from now on.

        Raises:
            InputError: the type is wrong, or the lattice would be too large; the old settings stay.
        """
        self.adopt(self.cell, settings)

    def use_cell(self, cell: Cell) -> None:
        """Use another cell from now on, or the same with moved objects.

        Raises:
            InputError: the type is wrong, or its lattice would be too large; the old cell stays.
        """
        self.adopt(cell, self.settings)

    def adopt(self, cell: Cell, settings: FilterSettings) -> None:
        """Use another cell and other settings from now on: both, or neither if one of them is invalid.

        Only changes are prepared anew: the robot and meshes that are the same objects as before are kept.

        Raises:
            InputError: an argument has a wrong type, or the lattice would be too large; the old ones stay.
        """
        _of_type(cell, Cell, "cell")
        _of_type(settings, FilterSettings, "settings")
        voxelizer, visibility = self._voxelizer, self._visibility
        if settings != self.settings or cell.lattice(settings.voxel_size_m) != self.lattice:
            voxelizer = self._voxelizer_of(cell, settings)
        if settings != self.settings or not _same_box(cell, self.cell):
            visibility = self._visibility_of(cell, settings)
        moving = self._moving.changed(cell.robot, settings, self.T_world_camera)
        bodies = self._static.bodies.of_cell(cell, self.T_world_camera)
        # Nothing from here on can fail.
        self.cell, self.settings = cell, settings
        self._voxelizer, self._visibility, self._moving = voxelizer, visibility, moving
        self._static.change(bodies, settings)

    def move(self, T_world_camera: ArrayLike, *, refined: bool = False) -> None:
        """Use another pose of the camera from now on.

        The background model belongs to the old pose and is dropped, unless the pose was only `refined`: then the
        camera did not move, and only the knowledge of its pose is better.

        Raises:
            InputError: the pose is not a rigid transform; the old one stays.
        """
        self.T_world_camera = validated(T_world_camera, "T_world_camera")
        self._voxelizer.place(self.T_world_camera)
        self._visibility.place(self.T_world_camera)
        self._moving.move(self.T_world_camera)
        if not refined:
            self._static.reference = None
        self._static.change(self._static.bodies.drawn(self.T_world_camera), self.settings)

    # ------------------------------------------------------------------ parts

    def _voxelizer_of(self, cell: Cell, settings: FilterSettings) -> Voxelizer:
        return Voxelizer(self.intrinsics, self.T_world_camera, cell.lattice(settings.voxel_size_m), settings)

    def _visibility_of(self, cell: Cell, settings: FilterSettings) -> Visibility:
        return Visibility(
            self.intrinsics,
            self.T_world_camera,
            cell.box_min_m,
            cell.box_max_m,
            settings.seen_block_size_m,
            settings.seen_share_min,
            self.intrinsics.disparity_noise_m(settings.stereo_subpixel_px),
        )

    @property
    def _noise_per_m(self) -> float:
        """`c` of the camera's noise `sigma(z) = c * z**2`, 1/m."""
        return self.intrinsics.disparity_noise_m(self.settings.stereo_subpixel_px)


def _same_box(one: Cell, other: Cell) -> bool:
    return np.array_equal(one.box_min_m, other.box_min_m) and np.array_equal(one.box_max_m, other.box_max_m)


def _of_type(value: Kind, kind: type, name: str) -> Kind:
    """Return `value` if it is a `kind`; without static type checks a wrong one must not fail half-way."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected {kind.__name__}, got {type(value).__name__}")
    return value
