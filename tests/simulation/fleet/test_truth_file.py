# SPDX-License-Identifier: Apache-2.0
"""The truth file: each frame is appended, and read as it was written."""

from __future__ import annotations

from pathlib import Path

import msgpack
import numpy as np
import pytest

from shared.errors import InputError, SourceError
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.truth import TruthFinder
from simulation.fleet.truth_file import TruthWriter, read_truth
from simulation.world.world import World

VOXEL_SIZE_M = 0.05
TIMES_S = (0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def camera() -> SimulatedCamera:
    world = World.demo(people=1)
    return SimulatedCamera(world, rig(world.cell)[0], d435i_intrinsics(424, 240))


def test_the_truth_is_appended_frame_by_frame(camera: SimulatedCamera, tmp_path: Path) -> None:
    path = tmp_path / "truth.msgpack"
    writer = TruthWriter(path, VOXEL_SIZE_M)
    for number, t_s in enumerate(TIMES_S):
        # Placed and closed for each frame, as a source that is opened again.
        writer.place(camera)
        writer.observe(100 + number, number, camera.capture(t_s))
        writer.close()
    with path.open("rb") as file:
        records = list(msgpack.Unpacker(file))
    finder = TruthFinder(
        camera.intrinsics, camera.T_world_camera, camera.world.cell.lattice(VOXEL_SIZE_M), camera.noise
    )
    for number, (record, frame, t_s) in enumerate(zip(records, read_truth(path), TIMES_S, strict=True)):
        truth = finder.find(camera.look(t_s))
        assert len(truth.visible_keys) > 50
        assert (record["frame_number"], record["captured_at_ns"], record["voxel_size_m"]) == (
            number, 100 + number, VOXEL_SIZE_M,
        )  # fmt: skip
        assert (frame.captured_at_ns, frame.voxel_size_m) == (100 + number, VOXEL_SIZE_M)
        np.testing.assert_array_equal(np.frombuffer(record["visible_counts"], "<u4"), truth.visible_counts)
        np.testing.assert_array_equal(frame.visible_keys, truth.visible_keys)
        np.testing.assert_array_equal(frame.surface_keys, truth.surface_keys)


def test_a_file_that_cannot_be_written_is_named(camera: SimulatedCamera, tmp_path: Path) -> None:
    path = tmp_path / "missing" / "truth"
    with pytest.raises(SourceError, match=str(path)):
        TruthWriter(path, VOXEL_SIZE_M).place(camera)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(tmp_path / "truth")):
        list(read_truth(tmp_path / "truth"))
