# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import edge_unit.pipeline.background_model
from edge_unit.pipeline import BackgroundLearner, BackgroundModel, DepthPipeline
from shared.cell import Cell, PlacedMesh
from shared.errors import InputError
from shared.meshes import box_mesh, cylinder_mesh
from shared.transforms import look_at
from tests.edge_unit.scenes import (
    OVERHEAD,
    Depth,
    bodies,
    camera,
    grown,
    measured,
    placed,
    raycast,
    shrunk,
    small_cell,
    small_robot,
)

CAMERA = camera(160, 90)
NO_ROBOT = np.full(CAMERA.shape, 65535, np.uint16), np.zeros(CAMERA.shape, np.uint16)

# ---------------------------------------------------------------- a cell that is not in CAD

ROOM = (placed("ground", box_mesh("ground", (12.0, 12.0, 0.02)), (0, 0, -0.01)),
        placed("bench", box_mesh("bench", (0.5, 0.4, 0.5)), (-0.5, 0.4, 0.25)))  # fmt: skip
"""Things that stand in the empty cell and in no model."""

PERSON = placed("person", cylinder_mesh("person", 0.12, 1.2), (0.4, -0.3, 0.6))

COLUMN = np.isfinite(raycast(bodies(small_cell(floor=False), [0.0])[:1], OVERHEAD, CAMERA))
"""Pixels at which the camera sees the robot's fixed link."""


def look(*things: PlacedMesh, joints: float | None = None, noise: np.random.Generator | None = None) -> Depth:
    """Return the camera's depth of the room, of `things`, and of the robot if joints are given."""
    robot = bodies(small_cell(floor=False), None if joints is None else [joints])
    depth_m = raycast([*ROOM, *things, *robot], OVERHEAD, CAMERA)
    if noise is not None:
        depth_m = depth_m + noise.normal(0.0, 0.003, depth_m.shape) * depth_m**2
    return measured(depth_m, CAMERA)


def pipeline(robot: bool = True) -> DepthPipeline:
    return DepthPipeline(CAMERA, OVERHEAD, small_cell(robot=robot, floor=False))


def test_a_learned_surface_is_no_obstacle_and_a_new_one_is() -> None:
    empty = pipeline(robot=False)
    rng = np.random.default_rng(0)
    assert len(empty.process(look(), None).voxels) > 10
    reference = empty.learn((look(noise=rng), None) for _ in range(20))
    assert reference.frames == 20
    assert reference.learned_share > 0.99
    empty.use(reference)
    assert len(empty.process(look(noise=rng), None).voxels) == 0
    assert len(empty.process(look(PERSON, noise=rng), None).voxels) > 10
    empty.use(None)
    assert len(empty.process(look(noise=rng), None).voxels) > 10


def test_the_expected_depth_is_the_learned_one() -> None:
    empty = pipeline(robot=False)
    empty.use(empty.learn([(look(), None)]))
    expected_m = empty.expected_depth(None)
    assert np.allclose(expected_m, look() / 1000.0, atol=1e-3)


def test_a_person_who_crosses_during_learning_is_still_reported() -> None:
    """The person covers each pixel on the way for 5 of 60 frames."""
    empty = pipeline(robot=False)
    rng = np.random.default_rng(0)

    def frames() -> Iterator[tuple[Depth, None]]:
        for i in range(60):
            x = -1.0 + 2.0 * i / 60
            crossing = placed("person", cylinder_mesh("person", 0.12, 1.2), (x, -0.3, 0.6))
            yield look(crossing, noise=rng), None

    empty.use(empty.learn(frames()))
    person = (look(PERSON) < look()) & shrunk(look(PERSON) < look(), 2)
    assert person.sum() > 200
    assert empty.foreground(look(PERSON, noise=rng), None)[person].mean() > 0.99
    assert len(empty.process(look(noise=rng), None).voxels) == 0


def test_a_person_who_crosses_unmeasured_pixels_is_still_reported() -> None:
    empty = pipeline(robot=False)

    def frames() -> Iterator[tuple[Depth, None]]:
        for i in range(60):
            depth = look(PERSON) if 20 <= i < 24 else look()
            # A black floor: only the person is measured.
            yield np.where(depth > 1600, 0, depth).astype(np.uint16), None

    empty.use(empty.learn(frames()))
    person = shrunk(look(PERSON) < look(), 2)
    assert empty.foreground(look(PERSON), None)[person].mean() > 0.99


def test_the_robots_shadow_fills_in_as_it_moves() -> None:
    watched = pipeline()
    still = watched.learn((look(joints=0.0), [0.0]) for _ in range(5))
    moved = watched.learn((look(joints=angle), [angle]) for angle in np.linspace(0.0, 2.0, 9))
    shadow = ~np.isfinite(still.depth_m)
    assert 100 < shadow.sum() < 0.4 * shadow.size
    # All but the hub, which the arm turns about.
    unlearned = ~np.isfinite(moved.depth_m)
    assert (unlearned & ~grown(COLUMN, 3)).sum() == 0
    # The room filled in, not the robot.
    room_m = look() / 1000.0
    filled = shadow & ~unlearned & ~COLUMN
    assert (np.abs(moved.depth_m[filled] - room_m[filled]) < 0.01).mean() > 0.98


def test_the_fixed_base_leaves_no_unlearned_ring() -> None:
    """The room right beside the column is learned, and nothing there is reported afterwards."""
    watched = pipeline()
    reference = watched.learn((look(joints=angle), [angle]) for angle in np.linspace(0.0, 2.0, 9))
    ring = grown(COLUMN, 3) & ~COLUMN
    # Except for a pixel or two beside the hub.
    assert np.isfinite(reference.depth_m[ring]).mean() > 0.97
    watched.use(reference)
    assert not watched.foreground(look(joints=-2.5), [-2.5])[ring].any()
    assert len(watched.process(look(joints=-2.5), [-2.5]).voxels) == 0


def test_the_robot_is_not_learned() -> None:
    """A hand at the robot's position during learning is reported after the robot has left."""
    watched = pipeline()
    watched.use(watched.learn((look(joints=0.5), [0.5]) for _ in range(10)))
    arm = shrunk(np.isfinite(raycast(bodies(small_cell(floor=False), [0.5])[1:], OVERHEAD, CAMERA))) & ~grown(COLUMN, 2)
    assert arm.sum() > 20
    assert watched.foreground(look(joints=0.5), [-2.5])[arm].mean() > 0.9


def test_learning_without_joints_is_refused_when_there_is_a_robot() -> None:
    with pytest.raises(InputError, match="joints"):
        pipeline().learn([(look(), None)])
    pipeline(robot=False).learn([(look(), None)])


def test_learning_from_no_frame_is_refused() -> None:
    with pytest.raises(InputError, match="at least one frame"):
        pipeline().learn([])


def test_learning_disturbs_no_frame_between() -> None:
    """A unit learns while it works: links that learning leaves out are filtered all the same."""
    watched = pipeline()
    before = watched.foreground(look(joints=0.5), [0.5])
    learner = watched.learner()
    for _ in range(3):
        watched.learn_frame(learner, look(joints=0.5), [0.5])
        assert (watched.foreground(look(joints=0.5), [0.5]) == before).all()


# ---------------------------------------------------------------- a void background model


def test_it_is_void_when_the_camera_moved_and_kept_when_its_pose_is_refined() -> None:
    empty = pipeline(robot=False)
    reference = empty.learn([(look(), None)])
    empty.use(reference)
    nudged = look_at((0.3, -0.2, 1.752), (0.1, 0.0, 0.0))
    empty.move(nudged, refined=True)
    assert empty.reference is reference
    assert len(empty.process(look(), None).voxels) == 0
    empty.move(nudged)
    assert empty.reference is None
    assert len(empty.process(look(), None).voxels) > 10


def test_it_outlives_new_settings_and_a_new_cell() -> None:
    empty = pipeline(robot=False)
    reference = empty.learn([(look(), None)])
    empty.use(reference)
    empty.apply(empty.settings.model_copy(update={"voxel_size_m": 0.1}))
    assert len(empty.process(look(), None).voxels) == 0
    empty.use_cell(small_cell(robot=False))
    assert empty.reference is reference
    assert len(empty.process(look(), None).voxels) == 0


def test_one_of_another_resolution_is_refused() -> None:
    other = BackgroundModel(np.ones((3, 4), np.float32), np.ones((3, 4), np.float32), 1)
    empty = pipeline(robot=False)
    with pytest.raises(InputError, match=r"\(90, 160\).*\(3, 4\)"):
        empty.use(other)
    assert empty.reference is None


# ---------------------------------------------------------------- bytes


def some_reference() -> BackgroundModel:
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(0.5, 4.0, (24, 42)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.2] = np.nan
    return BackgroundModel(depth_m, rng.uniform(0.0, 0.1, depth_m.shape).astype(np.float32), 17)


def test_save_and_load(tmp_path: Path) -> None:
    reference = some_reference()
    reference.save(tmp_path / "empty.npz")
    loaded = BackgroundModel.load(tmp_path / "empty.npz")
    assert np.array_equal(loaded.depth_m, reference.depth_m, equal_nan=True)
    assert np.array_equal(loaded.spread_m, reference.spread_m)
    assert loaded.frames == 17
    assert [path.name for path in tmp_path.iterdir()] == ["empty.npz"]


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive at all" * 10, None])
def test_a_file_that_is_no_reference_is_one_error_that_names_it(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "empty.npz"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=r"empty\.npz"):
        BackgroundModel.load(file)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge_unit.pipeline.background_model, "FILE_BYTES_MAX", 100)
    some_reference().save(tmp_path / "empty.npz")
    with pytest.raises(InputError, match="at most 100 bytes"):
        BackgroundModel.load(tmp_path / "empty.npz")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damaged_bytes_are_an_input_error_or_nothing() -> None:
    sound = some_reference().to_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(3000):
        damaged = bytearray(sound[: rng.integers(len(sound)) if rng.random() < 0.2 else None])
        for place in rng.integers(0, max(len(damaged), 1), rng.integers(1, 4)):
            damaged[place : place + 1] = bytes([rng.integers(256)])
        try:
            BackgroundModel.from_bytes(bytes(damaged))
        except InputError:
            refused += 1
    assert refused > 2500


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def images(depth_m: float, spread_m: float = 0.01) -> dict[str, NDArray[np.float32]]:
    return {"depth_m": np.full((2, 3), depth_m, np.float32), "spread_m": np.full((2, 3), spread_m, np.float32)}


@pytest.mark.parametrize(
    "arrays",
    [
        {},
        {**images(1.0)},
        {**images(1.0), "frames": 0},
        {**images(1.0), "frames": [1, 2]},
        {**images(-1.0), "frames": 3},
        {**images(0.0), "frames": 3},
        {**images(np.inf), "frames": 3},
        {**images(1.0, -0.1), "frames": 3},
        {**images(1.0, np.nan), "frames": 3},
        {**images(1.0), "spread_m": np.ones((3, 2), np.float32), "frames": 3},
        {**images(1.0), "depth_m": np.ones((2, 3), np.float64), "frames": 3},
        {**images(1.0), "depth_m": np.ones((2, 3), np.complex64), "frames": 3},
        {"depth_m": np.ones(3, np.float32), "spread_m": np.ones(3, np.float32), "frames": 3},
    ],
)
def test_contents_that_make_no_sense_are_refused(arrays: dict[str, Any]) -> None:
    """A depth below 0, for example, would hide the whole cell."""
    with pytest.raises(InputError, match="reference: expected"):
        BackgroundModel.from_bytes(npz(**arrays))


def test_bytes_of_a_single_array_are_refused() -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.ones(3))
    with pytest.raises(InputError, match="reference: expected"):
        BackgroundModel.from_bytes(buffer.getvalue())


# ---------------------------------------------------------------- the learner


def test_a_learner_takes_no_more_frames_than_it_can_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge_unit.pipeline.background_model, "MAX_FRAMES", 2)
    learner = BackgroundLearner(CAMERA, 0.01, 10.0)
    for _ in range(2):
        learner.add(look(), *NO_ROBOT)
    with pytest.raises(InputError, match="at most 2 frames"):
        learner.add(look(), *NO_ROBOT)
    assert learner.reference().frames == 2


def test_a_learner_without_frames_has_no_reference() -> None:
    with pytest.raises(InputError, match="at least one frame"):
        BackgroundLearner(CAMERA, 0.01, 10.0).reference()


def test_a_robot_without_moving_links_is_learned_with_the_rest() -> None:
    robot = small_robot()
    column = next(link for link in robot.links if not link.moving)
    cell = Cell("column", np.full(3, -1.0), np.full(3, 2.0), static=(PlacedMesh("column", column.mesh, np.eye(4)),))
    empty = DepthPipeline(CAMERA, OVERHEAD, cell)
    assert empty.learn([(look(joints=0.0), None)]).learned_share > 0.9
