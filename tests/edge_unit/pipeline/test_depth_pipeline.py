# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from edge_unit.pipeline import DepthPipeline, moving_model
from edge_unit.pipeline import depth_pipeline as pipeline_module
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import InputError
from shared.meshes import box_mesh, cylinder_mesh
from shared.settings import FilterSettings
from shared.transforms import from_xyz_rpy, look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics
from simulation.world.world import World
from tests.edge_unit.scenes import (
    ABOVE_TABLE,
    CHECKOUT,
    HOME_RAD,
    OVERHEAD,
    Depth,
    bodies,
    camera,
    demo_cell,
    grown,
    measured,
    placed,
    raycast,
    shrunk,
    small_cell,
    small_robot,
)

CAMERA = camera(424, 240)
PERSON = placed("person", cylinder_mesh("person", 0.12, 0.8), (-0.3, 0.4, 0.4))
DefaultPipeline = Callable[[], DepthPipeline]


def pipeline(cell: Cell | None = None, **settings: Any) -> DepthPipeline:
    return DepthPipeline(CAMERA, OVERHEAD, cell or small_cell(), FilterSettings(**settings))


def look(
    *things: Any, joints: float = 0.3, cell: Cell | None = None, noise: np.random.Generator | None = None
) -> Depth:
    """Return the camera's depth of the small cell, its robot and `things`."""
    depth_m = raycast([*bodies(cell or small_cell(), [joints]), *things], OVERHEAD, CAMERA)
    if noise is not None:
        noisy = noise.normal(0.0, 0.004, depth_m.shape)
        depth_m = np.where(np.isfinite(depth_m), depth_m + noisy * np.nan_to_num(depth_m, posinf=0) ** 2, np.inf)
    return measured(depth_m, CAMERA)


# ---------------------------------------------------------------- known and unknown surfaces


def test_a_known_surface_is_no_obstacle() -> None:
    rng = np.random.default_rng(0)
    watched = pipeline()
    for joints in np.linspace(-3.0, 3.0, 12):
        assert len(watched.process(look(joints=joints, noise=rng), [joints]).voxels) == 0


def test_an_unknown_object_is_reported_at_its_position() -> None:
    watched = pipeline()
    depth = look(PERSON)
    voxels = watched.process(depth, [0.3]).voxels
    assert len(voxels) > 20
    centres_m = voxels.lattice.centres(voxels.indices)
    from_axis_m = np.hypot(centres_m[:, 0] + 0.3, centres_m[:, 1] - 0.4)
    assert from_axis_m.max() < 0.12 + 0.05
    assert 0.75 < centres_m[:, 2].max() < 0.85


def test_foreground_agrees_with_process() -> None:
    watched = pipeline(occupancy_threshold=0.05, own_share_min=0.0, support_area_max_m2=1e-4)
    depth = look(PERSON)
    mask = watched.foreground(depth, [0.3])
    assert mask.dtype == np.bool_
    assert mask.shape == CAMERA.shape
    voxels = watched.process(depth, [0.3]).voxels
    assert 0 < voxels.counts.sum() <= mask.sum()


def test_depth_0_is_neither_obstacle_nor_free() -> None:
    watched = pipeline()
    nothing = np.zeros(CAMERA.shape, np.uint16)
    assert not watched.foreground(nothing, [0.3]).any()
    result = watched.process(nothing, [0.3])
    assert len(result.voxels) == 0
    assert not result.seen.seen.any()
    assert result.health.valid_share == 0.0


def test_measurements_out_of_range_are_ignored() -> None:
    watched = pipeline(small_cell(robot=False, floor=False), range_min_m=0.5, range_max_m=1.5)
    for raw, number in ((499, 0), (500, CAMERA.width * CAMERA.height), (1499, CAMERA.width * CAMERA.height), (1500, 0)):
        assert watched.foreground(np.full(CAMERA.shape, raw, np.uint16), None).sum() == number


def test_a_range_beyond_16_bits_ignores_everything() -> None:
    """5 m are 500,000 units of 10 micrometres."""
    fine = camera(64, 40, depth_scale_m=1e-5)
    watched = DepthPipeline(fine, OVERHEAD, small_cell(floor=False, robot=False), FilterSettings(range_min_m=5.0))
    assert watched.foreground(np.full(fine.shape, 60000, np.uint16), None).sum() == 0


def test_known_edges_have_a_halo_and_no_more() -> None:
    """Stereo matching makes known objects look 30 mm wider; 150 mm beside them there are unknown ones."""
    cell = small_cell(robot=False)
    watched = pipeline(cell)
    empty_m = raycast(bodies(cell, None), OVERHEAD, CAMERA)

    def wider(radius_px: int) -> Depth:
        v, u = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
        return measured(ndimage.minimum_filter(empty_m, footprint=np.hypot(u, v) <= radius_px), CAMERA)

    assert (wider(4) != wider(0)).sum() > 300
    assert not watched.foreground(wider(4), None).any()
    assert len(watched.process(wider(20), None).voxels) > 5


# ---------------------------------------------------------------- the robot


def test_the_robot_is_filtered_at_its_joints_and_reported_elsewhere() -> None:
    watched = pipeline()
    alone_m = raycast(bodies(small_cell(floor=False), [0.3])[1:], OVERHEAD, CAMERA)
    arm = shrunk(np.isfinite(alone_m) & (measured(alone_m, CAMERA) == look()), 3)
    assert arm.sum() > 40
    assert not watched.foreground(look(joints=0.3), [0.3])[arm].any()
    assert watched.foreground(look(joints=0.3), [2.3])[arm].mean() > 0.8
    assert len(watched.process(look(joints=0.3), [2.3]).voxels) > 3


def test_without_joints_the_robot_is_reported() -> None:
    watched = pipeline()
    robot = shrunk(np.isfinite(raycast(bodies(small_cell(floor=False), [0.3]), OVERHEAD, CAMERA)))
    depth = look()
    assert not watched.foreground(depth, [0.3])[robot].any()
    assert watched.foreground(depth, None)[robot].mean() > 0.95
    assert len(watched.process(depth, None).voxels) > 10
    assert len(watched.process(depth, [0.3]).voxels) == 0
    assert np.isfinite(watched.expected_depth([0.3])).sum() >= np.isfinite(watched.expected_depth(None)).sum()
    assert (watched.expected_depth([0.3]) < watched.expected_depth(None)).any()


def test_the_robot_is_two_sided() -> None:
    """A wall 300 mm behind the robot is seen right up to its silhouette; the halo of matching around it is not."""
    alone = small_cell(floor=False)
    watched = pipeline(alone)
    robot_m = raycast(bodies(alone, [0.3]), OVERHEAD, CAMERA)
    robot = np.isfinite(robot_m)
    padding_m = watched.settings.robot_padding_m
    wall_m = np.where(robot, robot_m, robot_m[robot].max() + 0.3 + padding_m)
    foreground = watched.foreground(measured(wall_m, CAMERA), [0.3])
    # Where the line of sight grazes a side, the side lies far behind the padded edge that it enters by.
    assert foreground[robot].mean() < 0.03
    assert len(watched.process(measured(robot_m, CAMERA), [0.3]).voxels) == 0
    assert foreground[~robot].mean() > 0.999
    # 30 mm of halo: at 1.35 m not quite 5 px.
    nearest_m = ndimage.minimum_filter(robot_m, 9)
    halo_m = np.where(robot, robot_m, nearest_m)
    assert watched.foreground(measured(halo_m, CAMERA), [0.3]).sum() < 0.03 * robot.sum()


def test_a_hand_before_the_robot_is_seen() -> None:
    alone = small_cell(floor=False)
    watched = pipeline(alone)
    robot_m = raycast(bodies(alone, [0.3]), OVERHEAD, CAMERA)
    robot = np.isfinite(robot_m)
    near = measured(np.where(robot, robot_m[robot].min() - 0.25, np.inf), CAMERA)
    assert watched.foreground(near, [0.3])[robot].all()


def test_joint_uncertainty_widens_the_robot() -> None:
    """By the possible motion of the links, and evenly; zero, a scalar and an array give the same."""
    watched = pipeline(small_cell(floor=False))
    everything = np.full(CAMERA.shape, 1350, np.uint16)

    def robot_px(uncertainty: Any) -> int:
        return int((~watched.foreground(everything, [0.3], joint_uncertainty_rad=uncertainty)).sum())

    sure, unsure, very = robot_px(0.0), robot_px(0.1), robot_px([0.3])
    assert 50 < sure < unsure < very
    assert robot_px([0.1]) == robot_px(0.1) == unsure
    assert robot_px(np.zeros(1)) == sure
    # The expected depth is not padded.
    known = watched.expected_depth([0.3], joint_uncertainty_rad=0.3)
    assert (known == watched.expected_depth([0.3])).all()


def test_a_misplaced_arm_is_covered_by_its_uncertainty() -> None:
    watched = pipeline()
    off_rad = 0.25
    depth = look(joints=0.3 + off_rad)
    assert len(watched.process(depth, [0.3]).voxels) > 0
    assert len(watched.process(depth, [0.3], joint_uncertainty_rad=off_rad).voxels) == 0


def test_a_link_close_to_the_camera_is_filtered() -> None:
    """It passes 12 cm before the lens, and its uncertainty pads it beyond the near plane."""
    alone = small_cell(floor=False)
    T_world_camera = look_at((0.35, 0.0, 0.3 + 0.04 + 0.12), (0.3, 0.0, 0.0))
    near = DepthPipeline(CAMERA, T_world_camera, alone)
    arm_m = raycast(bodies(alone, [0.0]), T_world_camera, CAMERA)
    assert 0.10 < arm_m.min() < 0.13
    assert np.isfinite(arm_m).mean() > 0.1
    for uncertainty_rad in (0.0, 0.05, 0.1):
        depth = measured(arm_m, CAMERA)
        assert not near.foreground(depth, [0.0], joint_uncertainty_rad=uncertainty_rad).any()


def test_a_cell_without_a_robot_takes_no_joints() -> None:
    watched = pipeline(small_cell(robot=False))
    depth = measured(raycast(bodies(small_cell(robot=False), None), OVERHEAD, CAMERA), CAMERA)
    assert len(watched.process(depth, None).voxels) == 0
    assert (watched.expected_depth(None) == watched.expected_depth(None)).all()


def test_a_robot_without_meshes_filters_nothing() -> None:
    bare = small_robot()
    cell = small_cell(floor=False)
    nothing = replace(cell, robot=type(bare)("bare", bare.joint_names, bare._motions, ()))
    watched = pipeline(nothing)
    assert watched.foreground(np.full(CAMERA.shape, 900, np.uint16), [0.3]).all()
    assert np.isinf(watched.expected_depth([0.3])).all()


# ---------------------------------------------------------------- changes at run time


def test_the_voxel_size_changes_while_it_runs() -> None:
    watched = pipeline()
    depth = look(PERSON)
    numbers = []
    for size_m in (0.05, 0.1, 0.02, 0.01, 0.05):
        watched.apply(watched.settings.model_copy(update={"voxel_size_m": size_m}))
        voxels = watched.process(depth, [0.3]).voxels
        assert watched.lattice == voxels.lattice == small_cell().lattice(size_m)
        centres_m = voxels.lattice.centres(voxels.indices)
        assert np.hypot(centres_m[:, 0] + 0.3, centres_m[:, 1] - 0.4).max() < 0.12 + size_m
        numbers.append(len(voxels))
    assert numbers[0] == numbers[-1]
    assert 0 < numbers[1] < numbers[0] < numbers[2]


def test_voxels_are_cropped_to_the_box() -> None:
    """The person stands astride the box's border."""
    cell = small_cell(robot=False)
    cropped = replace(cell, box_min_m=np.array((-0.3, -1.0, 0.1)), box_max_m=np.array((1.0, 0.4, 1.0)))
    watched = DepthPipeline(CAMERA, OVERHEAD, cropped)
    depth = measured(raycast([*bodies(cell, None), PERSON], OVERHEAD, CAMERA), CAMERA)
    voxels = watched.process(depth, None).voxels
    assert len(voxels) > 3
    centres_m = voxels.lattice.centres(voxels.indices)
    assert (centres_m > cropped.box_min_m).all()
    assert (centres_m < cropped.box_max_m + voxels.lattice.voxel_size_m).all()
    assert len(DepthPipeline(CAMERA, OVERHEAD, cell).process(depth, None).voxels) > len(voxels)


def test_settings_take_effect_with_the_next_frame() -> None:
    watched = pipeline()
    noisy, still = look(noise=np.random.default_rng(0)), look()
    assert not watched.foreground(noisy, [0.3]).any()
    watched.apply(FilterSettings(margin_base_m=0.0, margin_noise_gain=0.0, edge_radius_px=0, static_padding_m=0.0))
    assert watched.foreground(noisy, [0.3]).mean() > 0.1
    watched.apply(FilterSettings(robot_padding_m=0.1, robot_depth_m=0.0))
    assert not watched.foreground(still, [0.3])[0:10].any()
    watched.apply(FilterSettings())
    assert not watched.foreground(noisy, [0.3]).any()


def test_a_finer_lattice_than_fits_is_refused_and_the_old_one_stays() -> None:
    hall = replace(small_cell(), box_min_m=np.full(3, -10.0), box_max_m=np.full(3, 10.0))
    watched = pipeline(hall)
    before = watched.process(look(PERSON), [0.3]).voxels
    with pytest.raises(InputError, match="2000 x 2000 x 2000"):
        watched.apply(FilterSettings(voxel_size_m=0.01))
    assert watched.settings == FilterSettings()
    assert (watched.process(look(PERSON), [0.3]).voxels.keys == before.keys).all()


def test_a_cell_whose_lattice_does_not_fit_is_refused_and_the_old_one_stays() -> None:
    watched = pipeline()
    before, cell = watched.process(look(PERSON), [0.3]).voxels, watched.cell
    with pytest.raises(InputError, match="at most 134217728"):
        watched.use_cell(replace(small_cell(), box_max_m=np.full(3, 100.0)))
    assert watched.cell is cell
    assert (watched.process(look(PERSON), [0.3]).voxels.keys == before.keys).all()


def test_a_large_cell_works() -> None:
    """30 m of hall in voxels of 10 cm: its seen blocks are larger."""
    hall = replace(small_cell(), box_min_m=np.full(3, -15.0), box_max_m=np.full(3, 15.0))
    watched = pipeline(hall, voxel_size_m=0.1, seen_block_size_m=0.05)
    result = watched.process(look(PERSON), [0.3])
    assert len(result.voxels) > 0
    assert result.seen.lattice.voxel_size_m == pytest.approx(0.8)


def test_an_object_that_moved_is_known_at_its_new_place() -> None:
    watched, cell = pipeline(), small_cell()
    moved = cell.with_object_pose("crate", from_xyz_rpy((0.5, -0.4, 0.2), (0, 0, 0.7)))
    old, new = look(cell=cell), look(cell=moved)
    assert len(watched.process(old, [0.3]).voxels) == 0
    assert len(watched.process(new, [0.3]).voxels) > 0
    watched.use_cell(moved)
    assert len(watched.process(new, [0.3]).voxels) == 0
    assert len(watched.process(old, [0.3]).voxels) > 0
    assert (watched.expected_depth([0.3]) != pipeline().expected_depth([0.3])).any()


def test_an_object_that_moves_leaves_the_robot_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = small_cell()
    watched = pipeline(cell)
    watched.process(look(PERSON), [0.3])
    for module, name in (
        (moving_model, "RobotLayer"),
        (moving_model, "BareRobot"),
        (pipeline_module, "Voxelizer"),
        (pipeline_module, "Visibility"),
    ):
        monkeypatch.setattr(module, name, None)
    moved = cell.with_object_pose("crate", from_xyz_rpy((0.5, -0.4, 0.2), (0, 0, 0.7)))
    watched.use_cell(moved)
    monkeypatch.undo()
    fresh = pipeline(moved)
    depth = look(PERSON, cell=moved)
    found, wanted = watched.process(depth, [0.3]), fresh.process(depth, [0.3])
    assert (found.voxels.keys == wanted.voxels.keys).all()
    assert (watched.expected_depth([0.3]) == fresh.expected_depth([0.3])).all()
    assert (found.seen.seen == wanted.seen.seen).all()


def test_cell_and_settings_are_adopted_together_or_not_at_all() -> None:
    # Too large for the earlier settings, so that two changes in sequence would fail.
    hall = replace(small_cell(), box_min_m=np.full(3, -15.0), box_max_m=np.full(3, 15.0))
    watched = pipeline()
    cell, before = watched.cell, watched.process(look(PERSON), [0.3]).voxels
    for voxel_size_m in (0.05, 0.04):
        with pytest.raises(InputError, match="choose larger voxels"):
            watched.adopt(hall, FilterSettings(voxel_size_m=voxel_size_m))
        assert (watched.cell, watched.settings) == (cell, FilterSettings())
        assert (watched.process(look(PERSON), [0.3]).voxels.keys == before.keys).all()
    watched.adopt(hall, FilterSettings(voxel_size_m=0.1, robot_padding_m=0.08))
    fresh = pipeline(hall, voxel_size_m=0.1, robot_padding_m=0.08)
    assert watched.lattice == fresh.lattice
    found, wanted = watched.process(look(PERSON), [0.3]), fresh.process(look(PERSON), [0.3])
    assert (found.voxels.keys == wanted.voxels.keys).all()
    assert (found.seen.seen == wanted.seen.seen).all()


def test_another_pose_of_the_camera() -> None:
    """After a move the result equals that of a pipeline made at the new pose."""
    there = look_at((-0.5, -0.6, 1.6), (0.0, 0.0, 0.1))
    depth = measured(raycast([*bodies(small_cell(), [0.3]), PERSON], there, CAMERA), CAMERA)
    moved = pipeline()
    moved.process(look(), [0.3])
    moved.move(there)
    fresh = DepthPipeline(CAMERA, there, small_cell())
    found, wanted = moved.process(depth, [0.3]), fresh.process(depth, [0.3])
    assert (found.voxels.keys == wanted.voxels.keys).all()
    assert (moved.expected_depth([0.3]) == fresh.expected_depth([0.3])).all()
    assert (found.seen.seen == wanted.seen.seen).all()
    assert found.health == wanted.health


def test_another_cell() -> None:
    """Another robot, other CAD: the result equals that of a pipeline made for them."""
    cell = replace(small_cell(), robot=None, objects=(), name="other")
    changed = pipeline()
    changed.process(look(), [0.3])
    changed.use_cell(cell)
    fresh = pipeline(cell)
    depth = look()
    assert (changed.process(depth, None).voxels.keys == fresh.process(depth, None).voxels.keys).all()
    assert (changed.expected_depth(None) == fresh.expected_depth(None)).all()
    changed.use_cell(small_cell())
    assert len(changed.process(depth, [0.3]).voxels) == 0


@pytest.mark.parametrize("change", ["next frame", "source", "apply", "move", "use_cell", "use"])
def test_a_result_does_not_change_later(change: str) -> None:
    """Later frames, changes, and a source that reuses its memory do not change it."""
    watched, depth = pipeline(), look(PERSON)
    result = watched.process(depth, [0.3], with_misfit=True)
    assert result.misfit is not None
    values = (result.voxels.keys, result.voxels.counts, result.seen.seen, result.misfit.slope)
    before = [value.copy() for value in values]
    if change == "next frame":
        watched.process(look(), [0.5], with_misfit=True)
    elif change == "source":
        depth[:] = 0
    elif change == "apply":
        watched.apply(FilterSettings(voxel_size_m=0.1))
    elif change == "move":
        watched.move(look_at((-0.5, -0.6, 1.6), (0.0, 0.0, 0.1)))
    elif change == "use_cell":
        watched.use_cell(replace(small_cell(), objects=()))
    else:
        watched.use(watched.learn([(look(), [0.3])]))
    for value, old in zip(values, before, strict=True):
        assert (value == old).all()


def test_blocks_that_the_robot_hides_are_not_seen() -> None:
    """Neither behind the robot nor within its padding; without joints it is an obstacle and hides as such."""
    watched = pipeline()
    seen = watched.process(look(), [0.3]).seen
    keys = np.nonzero(seen.seen)[0]
    assert len(keys) > 100
    low_m = np.array(seen.lattice.origin_m) + seen.lattice.indices(keys) * seen.lattice.voxel_size_m
    column = (np.abs(low_m[:, :2] + 0.05) < 0.11).all(axis=1) & (low_m[:, 2] < 0.4)
    assert not column.any()
    assert watched.process(look(), None).seen.seen.sum() > 100


def test_blocks_that_a_halo_may_hide_are_not_seen() -> None:
    """Beside the crate, at its own depth, nothing would be reported."""
    haloed, plain = pipeline(), pipeline(static_padding_m=0.0)
    with_halo, without = (watched.process(look(), [0.3]).seen.seen for watched in (haloed, plain))
    assert not (with_halo & ~without).any()
    assert with_halo.sum() < without.sum()


def test_a_frame_reports_the_time_of_each_stage() -> None:
    watched = pipeline()
    times = watched.process(look(), [0.3]).times
    parts = (times.expected_ns, times.foreground_ns, times.density_ns, times.seen_ns, times.health_ns)
    assert min(parts) > 0
    assert times.misfit_ns == 0
    assert sum(parts) == times.total_ns
    assert watched.process(look(), [0.3], with_misfit=True).times.misfit_ns > 0


def test_misfit_is_computed_on_request() -> None:
    assert pipeline().process(look(), [0.3]).misfit is None


# ---------------------------------------------------------------- input


@pytest.mark.parametrize("order", ["flipped", "cropped", "fortran", "readonly"])
def test_depth_in_any_memory_order_is_the_same_frame(order: str) -> None:
    watched = pipeline()
    depth = look(PERSON)
    wanted = watched.process(depth, [0.3]).voxels
    if order == "flipped":
        other = depth[::-1, ::-1].copy()[::-1, ::-1]
    elif order == "cropped":
        other = np.pad(depth, 7)[7:-7, 7:-7]
    elif order == "fortran":
        other = np.asfortranarray(depth)
    else:
        other = np.frombuffer(depth.tobytes(), np.uint16).reshape(depth.shape)
    voxels = watched.process(other, [0.3]).voxels
    assert (voxels.keys == wanted.keys).all()
    assert (voxels.counts == wanted.counts).all()


def test_a_frame_is_left_as_it_was() -> None:
    depth = look(PERSON)
    copy = depth.copy()
    watched = pipeline()
    watched.process(depth, [0.3], with_misfit=True)
    assert (depth == copy).all()


GOOD = look(PERSON)
BAD_DEPTH = [
    (GOOD.astype(np.float32), "depth: expected dtype uint16.*float32"),
    (GOOD.astype(np.int16), "depth: expected dtype uint16.*int16"),
    (GOOD.astype(">u2"), "depth: expected dtype uint16.*>u2"),
    (GOOD[:-1], r"depth: expected shape \(240, 424\).*\(239, 424\)"),
    (GOOD.T, r"depth: expected shape \(240, 424\).*\(424, 240\)"),
    (GOOD[..., None], r"depth: expected shape \(240, 424\)"),
    (GOOD.ravel(), r"depth: expected shape \(240, 424\)"),
    (GOOD.tolist(), "depth: expected a numpy array, got list"),
    (None, "depth: expected a numpy array, got NoneType"),
    (np.ma.masked_equal(GOOD, 0), "depth: expected a plain numpy array .*, got a masked array"),
]
BAD_JOINTS = [
    ([np.nan], "joints: expected .*nan"),
    ([np.inf], "joints: expected .*inf"),
    ([0.1, 0.2], r"joints: expected .*\(2,\)"),
    ([], r"joints: expected .*\(0,\)"),
    ([[0.1]], r"joints: expected .*\(1, 1\)"),
    (0.1, r"joints: expected .*\(\)"),
    (["a"], "joints: expected .*list"),
    ([None], "joints: expected"),
    ("no", "joints: expected .*str"),
    (np.ma.masked_array([0.3], [True]), "joints: expected .*, got a masked array"),
    (np.array([True]), "joints: expected .*, got booleans"),
    ([True], "joints: expected .*, got booleans"),
]
BAD_UNCERTAINTY = [
    (-0.1, "joint_uncertainty_rad: expected .*-0.1"),
    ([-0.1], "joint_uncertainty_rad: expected .*-0.1"),
    (np.nan, "joint_uncertainty_rad: expected .*nan"),
    (np.inf, "joint_uncertainty_rad: expected .*inf"),
    ([0.1, 0.1], "joint_uncertainty_rad: expected"),
    ("much", "joint_uncertainty_rad: expected .*much"),
    (None, "joint_uncertainty_rad: expected"),
]
BAD_POSES = [
    (np.eye(3), r"T_world_camera: expected a 4x4 matrix, got shape \(3, 3\)"),
    (np.full((4, 4), np.nan), "T_world_camera: expected finite"),
    (2.0 * np.eye(4), "T_world_camera: expected"),
    (np.diag((1.0, 1.0, -1.0, 1.0)), "T_world_camera: expected a right-handed rotation"),
    ("here", "T_world_camera: expected a 4x4 matrix"),
    (None, "T_world_camera: expected a 4x4 matrix"),
]


@pytest.fixture(scope="module")
def working() -> DepthPipeline:
    return pipeline()


def still_works(watched: DepthPipeline) -> bool:
    wanted = pipeline().process(GOOD, [0.3]).voxels
    found = watched.process(GOOD, [0.3]).voxels
    return len(found) > 0 and np.array_equal(found.keys, wanted.keys) and np.array_equal(found.counts, wanted.counts)


@pytest.mark.parametrize("call", ["process", "foreground", "learn"])
@pytest.mark.parametrize(("depth", "message"), BAD_DEPTH)
def test_bad_depth_is_one_clear_error(working: DepthPipeline, call: str, depth: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        getattr(working, call)(*(([(depth, [0.3])],) if call == "learn" else (depth, [0.3])))
    assert still_works(working)


@pytest.mark.parametrize("call", ["process", "foreground", "learn", "expected_depth"])
@pytest.mark.parametrize(("joints", "message"), BAD_JOINTS)
def test_bad_joints_are_one_clear_error(working: DepthPipeline, call: str, joints: Any, message: str) -> None:
    arguments = {"learn": ([(GOOD, joints)],), "expected_depth": (joints,)}.get(call, (GOOD, joints))
    with pytest.raises(InputError, match=message):
        getattr(working, call)(*arguments)
    assert still_works(working)


@pytest.mark.parametrize("call", ["process", "foreground", "expected_depth"])
@pytest.mark.parametrize(("uncertainty", "message"), BAD_UNCERTAINTY)
def test_bad_uncertainty_is_one_clear_error(working: DepthPipeline, call: str, uncertainty: Any, message: str) -> None:
    arguments = ([0.3],) if call == "expected_depth" else (GOOD, [0.3])
    with pytest.raises(InputError, match=message):
        getattr(working, call)(*arguments, joint_uncertainty_rad=uncertainty)
    assert still_works(working)


@pytest.mark.parametrize("refined", [True, False])
@pytest.mark.parametrize(("pose", "message"), BAD_POSES)
def test_a_bad_pose_is_one_clear_error(working: DepthPipeline, pose: Any, message: str, refined: bool) -> None:
    with pytest.raises(InputError, match=message):
        working.move(pose, refined=refined)
    with pytest.raises(InputError, match=message):
        DepthPipeline(CAMERA, pose, small_cell())
    assert (working.T_world_camera == OVERHEAD).all()
    assert still_works(working)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("intrinsics", None, "intrinsics: expected Intrinsics, got NoneType"),
        ("cell", None, "cell: expected Cell, got NoneType"),
        ("settings", {}, "settings: expected FilterSettings, got dict"),
        ("settings", {"range_max_m": 3.0}, "settings: expected FilterSettings, got dict"),
    ],
)
def test_a_pipeline_of_other_things_is_one_clear_error(name: str, value: Any, message: str) -> None:
    arguments = {"intrinsics": CAMERA, "T_world_camera": OVERHEAD, "cell": small_cell(), name: value}
    with pytest.raises(InputError) as caught:
        DepthPipeline(**arguments)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("call", "value", "message"),
    [
        ("use", "x", "reference: expected BackgroundModel, got str"),
        ("learn", [1], "frames: expected pairs of depth and joints, got int"),
        ("learn", [(GOOD,)], "frames: expected pairs of depth and joints, got 1 values"),
        ("learn", None, "frames: expected Iterable, got NoneType"),
        ("apply", None, "settings: expected FilterSettings, got NoneType"),
        ("apply", {}, "settings: expected FilterSettings, got dict"),
        ("use_cell", None, "cell: expected Cell, got NoneType"),
    ],
)
def test_other_things_are_one_clear_error_and_change_nothing(
    working: DepthPipeline, call: str, value: Any, message: str
) -> None:
    with pytest.raises(InputError) as caught:
        getattr(working, call)(value)
    assert str(caught.value) == message
    assert still_works(working)


def test_a_bad_frame_while_learning_takes_nothing_in() -> None:
    watched = pipeline()
    learner = watched.learner()
    for depth, joints in ((GOOD[:-1], [0.3]), (GOOD, [np.nan]), (GOOD, None)):
        with pytest.raises(InputError):
            watched.learn_frame(learner, depth, joints)
    assert learner.frames == 0


# ---------------------------------------------------------------- memory


def process_moving(watched: DepthPipeline, depth: Depth, first: int, number: int) -> None:
    for i in range(first, first + number):
        watched.process(depth, HOME_RAD + 0.3 * np.sin(0.05 * i + np.arange(6)))


def demo_frame(intrinsics: Intrinsics) -> Depth:
    person = placed("person", cylinder_mesh("person", 0.2, 1.7), (0.7, -0.6, 0.1))
    return measured(raycast([*bodies(demo_cell(), HOME_RAD), person], ABOVE_TABLE, intrinsics), intrinsics)


def rss_growth_mb(frames: int) -> float:
    intrinsics = camera(424, 240)
    watched, depth = DepthPipeline(intrinsics, ABOVE_TABLE, demo_cell()), demo_frame(intrinsics)
    process_moving(watched, depth, 0, 300)
    gc.collect()
    before = psutil.Process().memory_info().rss
    process_moving(watched, depth, 300, frames)
    gc.collect()
    return (psutil.Process().memory_info().rss - before) / 2**20


def test_memory_is_flat_over_some_frames() -> None:
    assert rss_growth_mb(500) < 1.0


@pytest.mark.slow
def test_memory_is_flat_over_10_000_frames() -> None:
    growth_mb = rss_growth_mb(10_000)
    print(f"RSS grew by {growth_mb:.2f} MB over 10,000 frames")
    assert growth_mb < 1.0


def test_a_frame_allocates_nothing_that_grows_with_it() -> None:
    """A 1280 x 720 frame has 1.8 MB; `process` allocates a few poses and the voxels themselves."""
    intrinsics = camera(1280, 720)
    watched, depth = DepthPipeline(intrinsics, ABOVE_TABLE, demo_cell()), demo_frame(intrinsics)
    process_moving(watched, depth, 0, 5)
    assert len(watched.process(depth, HOME_RAD).voxels) > 50
    tracemalloc.start()
    process_moving(watched, depth, 5, 5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


# ---------------------------------------------------------------- real frames


def test_the_marks_on_real_frames(data_dir: Path) -> None:
    """A RealSense before an xArm7 and, in frames 0 to 3, a second robot without a model; default settings."""
    folder = data_dir / "xarm7_realsense"
    cell = Cell.load(CHECKOUT / "assets" / "cells" / "xarm7" / "cell.yaml")
    intrinsics = Intrinsics(1280, 720, 908.3020, 908.2927, 642.962, 372.7315, fx_stereo=430.0)
    T_world_camera = np.loadtxt(folder / "T_base_optical.txt")
    joints = np.loadtxt(folder / "joint_states_rad.csv", delimiter=",")
    depth = [cv2.imread(str(folder / "depth" / f"{i:02d}.png"), cv2.IMREAD_UNCHANGED) for i in range(10)]
    masks = [cv2.imread(str(folder / "mask" / f"{i:02d}.png"), cv2.IMREAD_GRAYSCALE) > 0 for i in range(4)]
    watched = DepthPipeline(intrinsics, T_world_camera, cell)
    watched.use(watched.learn((depth[i], joints[i]) for i in range(4, 10)))
    v, u = np.mgrid[0:720, 0:1280]
    for i in range(4):
        foreground = watched.foreground(depth[i], joints[i])
        robot = masks[i] & (depth[i] > 0)
        leak = 100.0 * (foreground & robot).sum() / robot.sum()
        window = (u >= 325) & (u <= 490) & (v >= 285) & (v <= 600)
        second = window & (depth[i] >= 1450) & (depth[i] <= 1850) & ~masks[i]
        miss = 100.0 * (second & ~foreground).sum() / second.sum()
        voxels = watched.process(depth[i], joints[i]).voxels
        points_m = voxels.lattice.centres(voxels.indices) - T_world_camera[:3, 3]
        points_m = points_m @ T_world_camera[:3, :3]
        x, y = intrinsics.project(points_m).T
        there = (x >= 315) & (x <= 500) & (y >= 275) & (y <= 610) & (points_m[:, 2] >= 1.4) & (points_m[:, 2] <= 1.9)
        laptop = (x < 250) & (y > 400)
        false = (~there & ~laptop).sum()
        print(f"frame {i}: leak {leak:.3f} %, miss {miss:.2f} %, second robot {there.sum()} voxels, false {false}")
        assert leak <= 0.3
        assert miss <= 2.5
        assert there.sum() >= 90
        assert false == 0


def test_scenes_meet_the_assumptions_of_the_tests() -> None:
    """The person stands clear of the robot and of the crate, in full view."""
    empty, occupied = look(), look(PERSON)
    assert (occupied < empty).sum() > 300
    arm = np.isfinite(raycast(bodies(small_cell(floor=False), [0.3]), OVERHEAD, CAMERA))
    assert not (grown(arm, 2) & (occupied < empty)).any()
    assert box_mesh("box", (1, 1, 1)).closed


def test_masks_are_not_shared_with_the_caller() -> None:
    watched = pipeline()
    mask: NDArray[np.bool_] = watched.foreground(look(PERSON), [0.3])
    number = mask.sum()
    watched.foreground(look(), [0.3])
    assert mask.sum() == number > 0
    expected_m = watched.expected_depth([0.3])
    copy = expected_m.copy()
    watched.expected_depth([1.3])
    assert (expected_m == copy).all()


def test_links_that_point_at_a_camera_above_them_are_still_robot() -> None:
    """Beside the near end of such a link the halo of its far end is measured, deep behind the padded surface."""
    world = World.demo(people=0, seed=1, cell=demo_cell())
    intrinsics = d435i_intrinsics(848, 480)
    above = look_at((0.25, 0.25, 1.4), (0.2, 0.1, 0.0))
    eye = SimulatedCamera(world, above, intrinsics, renderer="raycast", seed=3)
    pipeline = DepthPipeline(intrinsics, above, demo_cell())
    frames = [eye.capture(0.69 * n) for n in range(16)]
    assert [len(pipeline.process(frame.depth, frame.joints).voxels) for frame in frames] == [0] * len(frames)
