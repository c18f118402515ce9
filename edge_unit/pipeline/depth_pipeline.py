# SPDX-License-Identifier: Apache-2.0
"""The method, one line a stage: from a depth image to the obstacle voxels of the cell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline.background_model import Reference, ReferenceLearner
from edge_unit.pipeline.edge_halo import EdgeHalo
from edge_unit.pipeline.expected_depth import BareRobot, RobotLayer, StaticLayer
from edge_unit.pipeline.fit_check import Health, HealthCheck
from edge_unit.pipeline.pose_misfit import Misfit, MisfitCheck
from edge_unit.pipeline.pose_refinement import Refiner
from edge_unit.pipeline.visibility import SeenBlocks, Visibility
from edge_unit.pipeline.voxelizer import Voxelizer, Voxels
from geometry.kernels import foreground, limits
from geometry.kernels.bundles import plain
from geometry.rendering import Links
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.clock import stage_ns
from shared.errors import InputError
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import inverse, validated

Kind = TypeVar("Kind")

EDGE_RADIUS_WIDTH_PX = 1280
"""`edge_radius_px` is given for this width; an edge's blur covers the same angle at every resolution."""

EXACT: ArrayLike = 0.0
"""The uncertainty of joints that are known."""


@dataclass(frozen=True)
class StageTimes:
    """Nanoseconds that the stages of the last frame took."""

    expected_ns: int
    points_ns: int
    voxels_ns: int

    @property
    def total_ns(self) -> int:
        """All stages together."""
        return self.expected_ns + self.points_ns + self.voxels_ns


class DepthPipeline:
    """One camera's filter. Not for use from several threads at once.

    All that changes while it runs (`apply`, `move`, `use_cell`, `adopt`, `use`) takes effect with the next frame.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        T_world_camera: ArrayLike,
        cell: Cell,
        settings: FilterSettings | None = None,
    ) -> None:
        """Prepare everything that does not depend on a frame.

        Args:
            intrinsics: of the depth camera.
            T_world_camera: (4, 4) pose of its optical frame in the cell.
            cell: the watched workspace.
            settings: defaults when left out.

        Raises:
            InputError: an argument is of another type, the pose is no rigid transform, or the lattice would be too
                large.
        """
        self.intrinsics = _of_type(intrinsics, Intrinsics, "intrinsics")
        self.cell = _of_type(cell, Cell, "cell")
        self.settings = FilterSettings() if settings is None else _of_type(settings, FilterSettings, "settings")
        self.T_world_camera = validated(T_world_camera, "T_world_camera")
        self.reference: Reference | None = None
        self.last = StageTimes(0, 0, 0)
        self._limit_raw = np.empty(intrinsics.shape, np.uint16)
        self._seen_limit_raw = np.empty(intrinsics.shape, np.uint16)
        self._room_raw = np.empty(intrinsics.shape, np.uint16)
        self._scratch_raw = np.empty((2, *intrinsics.shape), np.uint16)
        self._unlearned = np.full(intrinsics.shape, np.nan, np.float32)
        self._no_depth_raw = np.zeros(intrinsics.shape, np.uint16)
        self._halo = EdgeHalo(intrinsics)
        self._health = HealthCheck(intrinsics)
        self._misfit = MisfitCheck(intrinsics)
        self.static_version = 0
        self._voxelizer = self._voxelizer_of(cell, self.settings)
        self._visibility = self._visibility_of(cell, self.settings)
        self._static = StaticLayer(intrinsics, cell.static)
        self._objects = StaticLayer(intrinsics, cell.objects)
        self._robot = RobotLayer(intrinsics, cell.robot, self.settings.robot_padding_m)
        self._bare_robot = BareRobot(intrinsics, cell.robot)
        self._forget_frame()
        self._place_links()
        self._static.draw(self.T_world_camera)
        self._objects.draw(self.T_world_camera)
        self._renew_static()

    # ------------------------------------------------------------------ what a frame goes through

    def process(
        self, depth: NDArray[np.uint16], joints: ArrayLike | None, *, joint_uncertainty_rad: ArrayLike = EXACT
    ) -> Voxels:
        """Obstacle voxels of one frame.

        Args:
            depth: (H, W) uint16 in units of depth_scale_m, 0 where nothing was measured.
            joints: (n,) rad (m where prismatic) at the frame's time; None when unknown: then the robot is
                reported, not filtered.
            joint_uncertainty_rad: how far each joint may be off, one number or (n,); it widens the padding.

        Raises:
            InputError: depth or joints have the wrong type, shape or values.
        """
        depth_raw = self.intrinsics.check_depth(depth)
        started = stage_ns()
        self._place_robot(joints, joint_uncertainty_rad)
        expected = stage_ns()
        found = self._voxelizer.count(depth_raw, self._room_raw, self._minimum_raw, self._robot, self._halo)
        counted = stage_ns()
        voxels = self._voxelizer.keep_dense(found)
        finished = stage_ns()
        self._depth_raw = depth_raw
        self.last = StageTimes(expected - started, counted - expected, finished - counted)
        return voxels

    def foreground(
        self, depth: NDArray[np.uint16], joints: ArrayLike | None, *, joint_uncertainty_rad: ArrayLike = EXACT
    ) -> NDArray[np.bool_]:
        """The pixels (H, W) that survive the filter; arguments and errors as in `process`."""
        depth_raw = self.intrinsics.check_depth(depth)
        self._place_robot(joints, joint_uncertainty_rad)
        mask = np.empty(self.intrinsics.shape, np.uint8)
        self._filter(depth_raw, mask)
        return mask.view(np.bool_)

    def expected_depth(
        self, joints: ArrayLike | None, *, joint_uncertainty_rad: ArrayLike = EXACT
    ) -> NDArray[np.float32]:
        """Depth (H, W) in metres of the nearest known surface, unpadded; inf where nothing is known.

        Without joints the robot is not known. The uncertainty pads the filter only, never what is expected.
        """
        nearest_m = self._static_depth_m.copy()
        if self._links is not None and joints is not None:
            self._check_uncertainty(joint_uncertainty_rad)
            self._bare_robot.lower(self._links.place(joints), nearest_m)
        return nearest_m

    def seen(self) -> SeenBlocks:
        """The blocks of the cell that the last frame looked through."""
        return self._visibility.look(
            self._depth_raw, self._seen_limit_raw, self._robot.near_raw, self.settings.seen_share_min
        )

    def health(self) -> Health:
        """How well the last frame fits what is known."""
        return self._health.check(self._depth_raw, self._static_raw, self._robot.near_raw, self.settings)

    def misfit(self) -> Misfit:
        """How badly the last frame fits what is known, from here and from places close by."""
        return self._misfit.check(self._depth_raw, self._standing_raw, self._robot.near_raw, self.settings)

    # ------------------------------------------------------------------ learning the empty cell

    def learn(self, frames: Iterable[tuple[NDArray[np.uint16], ArrayLike | None]]) -> Reference:
        """Learn the static layer from frames of the empty cell; `use` makes it count.

        Args:
            frames: pairs of depth (H, W) uint16 and joints (n,).

        Raises:
            InputError: there was no frame, one is no such pair, or one of a cell with a robot came without joints.
        """
        learner = self.learner()
        pairs: Iterable[object] = _of_type(frames, Iterable, "frames")
        for pair in pairs:
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                came = f"{len(pair)} values" if isinstance(pair, (tuple, list)) else type(pair).__name__
                raise InputError(f"frames: expected pairs of depth and joints, got {came}")
            self.learn_frame(learner, *pair)
        return learner.reference()

    def learner(self) -> ReferenceLearner:
        """A learner for this camera, to be fed with `learn_frame`."""
        return ReferenceLearner(self.intrinsics, self._noise_per_m, self.settings.range_max_m)

    def learn_frame(self, learner: ReferenceLearner, depth: NDArray[np.uint16], joints: ArrayLike | None) -> None:
        """Add one frame of the empty cell to `learner`; arguments and errors as in `learn`.

        The robot is left out by its own padded render, but for the links that never move: they belong to what stands
        still, and leaving them out would leave an unlearned ring around the base.
        """
        _of_type(learner, ReferenceLearner, "learner")
        depth_raw = self.intrinsics.check_depth(depth)
        if self.cell.robot is not None and joints is None:
            raise InputError("learn: expected joints with every frame, for the robot must not be learned as background")
        self._place_robot(joints, EXACT, hidden=self._fixed_links)
        learner.add(depth_raw, self._robot.near_raw, self._robot.span_raw)

    def use(self, reference: Reference | None) -> None:
        """From now on `reference` is part of the static layer; None takes it out.

        Raises:
            InputError: it is no reference, or was learned by a camera of another resolution; the old one stays.
        """
        if reference is not None and _of_type(reference, Reference, "reference").depth_m.shape != self.intrinsics.shape:
            raise InputError(
                f"reference: expected images of {self.intrinsics.shape} (height, width), got {reference.depth_m.shape}"
            )
        self.reference = reference
        self._renew_static()

    # ------------------------------------------------------------------ refining the pose

    def without_robot(self, depth: NDArray[np.uint16], joints: ArrayLike | None) -> NDArray[np.uint16]:
        """A copy of a frame (H, W) in which nothing is measured where the padded robot may stand; errors as `process`.

        Without joints the robot stays in the picture: it may be anywhere.
        """
        bare = self.intrinsics.check_depth(depth).copy()
        self._place_robot(joints, EXACT)
        bare[self._robot.near_raw < limits.RAW_MAX] = 0
        return bare

    def refiner(self) -> Refiner:
        """Finds a better pose by the CAD, from frames of `without_robot`; `move` makes it count."""
        return Refiner(self.intrinsics, self.T_world_camera, _depth_m(self._cad_w()), self._noise_per_m)

    # ------------------------------------------------------------------ what may change while it runs

    @property
    def lattice(self) -> Lattice:
        """On which voxels are reported."""
        return self._voxelizer.lattice

    def apply(self, settings: FilterSettings) -> None:
        """Work with other settings from now on.

        Raises:
            InputError: these are no settings, or the lattice would be too large; the old settings stay.
        """
        self.adopt(self.cell, settings)

    def use_cell(self, cell: Cell) -> None:
        """The cell is another from now on, or its known objects stand elsewhere.

        Raises:
            InputError: it is no cell, or its lattice would be too large; the old one stays.
        """
        self.adopt(cell, self.settings)

    def adopt(self, cell: Cell, settings: FilterSettings) -> None:
        """Cell and settings are others from now on: both, or neither when one of them cannot be.

        Only what changed is prepared anew: robot and meshes that are the same objects as before are kept.

        Raises:
            InputError: an argument is of another type, or the lattice would be too large; the old ones stay.
        """
        _of_type(cell, Cell, "cell")
        _of_type(settings, FilterSettings, "settings")
        intrinsics, old_cell, old_settings = self.intrinsics, self.cell, self.settings
        same_robot = cell.robot is old_cell.robot
        voxelizer, visibility = self._voxelizer, self._visibility
        if settings != old_settings or cell.lattice(settings.voxel_size_m) != self.lattice:
            voxelizer = self._voxelizer_of(cell, settings)
        if settings != old_settings or not _same_box(cell, old_cell):
            visibility = self._visibility_of(cell, settings)
        robot, bare_robot = self._robot, self._bare_robot
        if not same_robot or settings.robot_padding_m != old_settings.robot_padding_m:
            robot = RobotLayer(intrinsics, cell.robot, settings.robot_padding_m)
        if not same_robot:
            bare_robot = BareRobot(intrinsics, cell.robot)
        static = self._static.of(cell.static)
        objects = self._objects.of(cell.objects)
        static.draw(self.T_world_camera)
        objects.draw(self.T_world_camera)
        # Nothing from here on can fail.
        self.cell, self.settings = cell, settings
        self._voxelizer, self._visibility = voxelizer, visibility
        self._robot, self._bare_robot = robot, bare_robot
        self._static, self._objects = static, objects
        self._forget_frame()
        self._place_links()
        self._renew_static()

    def move(self, T_world_camera: ArrayLike, *, refined: bool = False) -> None:
        """The camera's pose is another from now on.

        What was learned belonged to the old place and is void, unless the pose was only `refined`: then the camera
        did not move, we merely know better where it stands.

        Raises:
            InputError: the pose is no rigid transform; the old one stays.
        """
        self.T_world_camera = validated(T_world_camera, "T_world_camera")
        if not refined:
            self.reference = None
        self._voxelizer.place(self.T_world_camera)
        self._visibility.place(self.T_world_camera)
        self._forget_frame()
        self._place_links()
        self._static.draw(self.T_world_camera)
        self._objects.draw(self.T_world_camera)
        self._renew_static()

    # ------------------------------------------------------------------ the stages

    def _place_robot(
        self, joints: ArrayLike | None, joint_uncertainty_rad: ArrayLike, hidden: NDArray[np.bool_] | None = None
    ) -> None:
        """Draw the padded robot as it stood when the frame was taken."""
        if self._links is None:
            return
        uncertainty = self._check_uncertainty(joint_uncertainty_rad)
        if joints is None:
            self._robot.forget()
            return
        settings = self.settings
        T_camera_link = self._links.place(joints)
        padding_m, most_m = self._robot.padding_m, settings.robot_padding_m
        if uncertainty is not None:
            padding_m = (padding_m + self._links.displacement_m(uncertainty)).astype(np.float32)
            most_m = float(padding_m.max(initial=0.0))
        self._robot.draw(
            T_camera_link,
            padding_m,
            settings.margin_noise_gain * self._noise_per_m,
            # The padded surface stands before the true one by the padding.
            settings.robot_depth_m + most_m,
            hidden,
        )

    def _filter(self, depth_raw: NDArray[np.uint16], mask: NDArray[np.uint8]) -> None:
        """Mark with 1, else 0, what is nearer than all that stands still, and not robot."""
        self._depth_raw = depth_raw
        foreground.foreground_mask(
            depth_raw,
            self._room_raw,
            self._minimum_raw,
            self._robot.band,
            mask,
        )
        self._halo.drop(depth_raw, mask)

    def _forget_frame(self) -> None:
        """The last frame showed another place, or was filtered by other rules: until the next, nothing is seen."""
        self._robot.forget()
        self._depth_raw = self._no_depth_raw

    def _place_links(self) -> None:
        """Place the robot's base before the camera."""
        robot = self.cell.robot
        self._links = Links(robot, inverse(self.T_world_camera)) if robot else None
        self._fixed_links = np.array([not link.moving for link in (robot.links if robot else ())], np.bool_)

    def _renew_static(self) -> None:
        """Limits of all that stands still: CAD and what was learned, less margins, nearest over the blur of an edge."""
        settings, camera = self.settings, self.intrinsics
        w = self._cad_w()
        learned = self.reference
        reference_m = learned.depth_m if learned else self._unlearned
        spread_m = learned.spread_m if learned else self._unlearned
        cad_noise_per_m = settings.margin_noise_gain * self._noise_per_m
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
        self._minimum_raw = min(max(int(np.ceil(settings.range_min_m / camera.depth_scale_m)), 1), limits.RAW_MAX)
        np.subtract(np.maximum(self._limit_raw, self._minimum_raw), self._minimum_raw, out=self._room_raw)
        self._halo.renew(w, settings.static_padding_m, settings.margin_base_m, cad_noise_per_m)
        self._halo.lower(self._limit_raw, self._seen_limit_raw)
        self._static_depth_m = np.fmin(_depth_m(w), reference_m)
        self._static_raw = self._raw(self._static_depth_m)
        # Known objects may be carried away before anyone tells; that is no reason to doubt where the camera stands.
        self._standing_raw = self._raw(np.fmin(_depth_m(self._static.nearest_w), reference_m))
        self.static_version += 1

    def _voxelizer_of(self, cell: Cell, settings: FilterSettings) -> Voxelizer:
        return Voxelizer(self.intrinsics, self.T_world_camera, cell.lattice(settings.voxel_size_m), settings)

    def _visibility_of(self, cell: Cell, settings: FilterSettings) -> Visibility:
        return Visibility(
            self.intrinsics,
            self.T_world_camera,
            cell.box_min_m,
            cell.box_max_m,
            settings.seen_block_size_m,
            self.intrinsics.disparity_noise_m(settings.stereo_subpixel_px),
        )

    def _cad_w(self) -> NDArray[np.float32]:
        """Inverse depth (H, W) of CAD and known objects in 1/m, 0 where there are none."""
        return np.asarray(np.maximum(self._static.nearest_w, self._objects.nearest_w))

    def _raw(self, depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Depth (H, W) in raw units, 0 where nothing is known or it is too far for 16 bits."""
        raw = np.nan_to_num(depth_m / self.intrinsics.depth_scale_m, nan=0.0, posinf=0.0)
        return np.where(raw < limits.RAW_MAX, raw, 0.0).astype(np.uint16)

    def _check_uncertainty(self, joint_uncertainty_rad: ArrayLike) -> NDArray[np.float64] | None:
        """The uncertainty (n,) of each joint; None when there is none."""
        if joint_uncertainty_rad is EXACT:
            return None
        robot = self.cell.robot
        count = robot.joint_count if robot else 0
        try:
            uncertainty = np.asarray(joint_uncertainty_rad, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"joint_uncertainty_rad: expected numbers, got {joint_uncertainty_rad!r}") from error
        sound = (uncertainty >= 0.0) & np.isfinite(uncertainty)
        if uncertainty.shape not in ((), (count,)) or not sound.all():
            raise InputError(
                f"joint_uncertainty_rad: expected one finite number of at least 0, or {count}, "
                f"got {uncertainty.tolist()}"
            )
        return np.array(np.broadcast_to(uncertainty, (count,))) if uncertainty.any() else None

    @property
    def _noise_per_m(self) -> float:
        """The camera's noise `c` of `sigma(z) = c * z**2`, 1/m."""
        return self.intrinsics.disparity_noise_m(self.settings.stereo_subpixel_px)


def _same_box(one: Cell, other: Cell) -> bool:
    return np.array_equal(one.box_min_m, other.box_min_m) and np.array_equal(one.box_max_m, other.box_max_m)


def _depth_m(w_per_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) in metres of inverse depth, inf where that is 0."""
    depth_m = np.full(w_per_m.shape, np.inf, np.float32)
    np.divide(1.0, w_per_m, out=depth_m, where=w_per_m > 0.0)
    return depth_m


def _of_type(value: Kind, kind: type, name: str) -> Kind:
    """Return `value` if it is a `kind`; where types are not checked, a wrong one must not fail half-way."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected {kind.__name__}, got {type(value).__name__}")
    return value
