# SPDX-License-Identifier: Apache-2.0
"""The marks of the sweeps with few frames each; they can be missed."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from benchmarks import sweeps
from benchmarks.reporting.report import Mark, Result
from benchmarks.sweep_scenes import shapes
from benchmarks.sweep_scenes.stage import above_table, reported_at
from benchmarks.sweeps import Amount, quick
from shared.meshes import box_mesh
from shared.settings import FilterSettings
from shared.transforms import from_rotation_translation
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import Body, Owner

LITTLE = replace(quick(), boxes=25, curve_boxes=8, plate_step_m=0.025, rods=25, speckles=20, moments=2)


def result(name: str, settings: FilterSettings | None = None, amount: Amount = LITTLE) -> Result:
    with sweeps.runner(1) as run:
        return dict(sweeps.sweep([name], amount, settings or FilterSettings(), run))[name]


def missed(found: Result) -> list[str]:
    return [str(mark) for mark in found.marks if not mark.met]


@pytest.mark.parametrize(("name", "marks"), [("thickness", 8), ("shapes", 11), ("quiet", 2), ("walkers", 2)])
def test_the_defaults_meet_every_mark(name: str, marks: int) -> None:
    found = result(name)
    assert missed(found) == []
    assert len(found.marks) == marks


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thickness", "shapes", "quiet", "walkers"])
def test_the_defaults_meet_every_mark_over_many_frames(name: str) -> None:
    many = Amount(boxes=200, plate_step_m=0.005, rods=300, speckles=200, frames=100, moments=20)
    assert missed(result(name, amount=many)) == []


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("thickness", {"margin_base_m": 0.1}),
        ("thickness", {"margin_base_m": 0.0, "margin_noise_gain": 0.5}),
        ("shapes", {"density_rule": "single", "occupancy_threshold": 0.75}),
        ("shapes", {"support_points_min": 0, "occupancy_threshold": 0.05}),
        ("quiet", {"margin_noise_gain": 1.0}),
        ("quiet", {"robot_padding_m": 0.0}),
        ("quiet", {"static_padding_m": 0.0}),
        ("walkers", {"own_share_min": 0.9}),
    ],
)
def test_worse_settings_miss_a_mark(name: str, settings: dict[str, object]) -> None:
    little = replace(LITTLE, boxes=10, plate_step_m=0.05, rods=4, speckles=10, frames=2, learned_too=False)
    assert missed(result(name, FilterSettings.model_validate(settings), little))


def test_the_curve_rises_with_distance() -> None:
    rows = result("curve").rows
    assert [row[0] for row in rows] == [1.0, 2.0]
    heights = np.array([row[1:] for row in rows], float)
    assert (heights[1] > heights[0]).all()
    assert (heights[0] <= 75).all()
    assert (heights[1] <= 135).all()


def test_the_first_rule_is_the_default_and_the_others_are_the_papers() -> None:
    ours, *paper = shapes.rules(FilterSettings(), 0.05).values()
    assert ours == FilterSettings()
    assert [(each.density_rule, each.density_model, each.occupancy_threshold) for each in paper] == [
        ("single", "angular", 0.5),
        ("single", "angular", 0.6),
    ]


def test_a_blob_is_one_piece_of_its_size() -> None:
    camera = above_table(1.0, DepthNoise.none(), 0).intrinsics
    for pixels in (1, 7, 20):
        rows, columns = shapes.blob(np.random.default_rng(pixels), pixels, camera)
        image = np.zeros(camera.shape, bool)
        image[rows, columns] = True
        assert image.sum() == pixels
        assert ndimage.label(image)[1] == 1


@pytest.mark.parametrize("tilt_max_deg", [60.0, 90.0])
def test_rods_tilt_as_far_as_they_should(tilt_max_deg: float) -> None:
    rng = np.random.default_rng(0)
    poses = np.array([shapes._rod_pose(rng, tilt_max_deg) for _ in range(500)])
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    tilt_deg = np.degrees(np.arcsin(poses[:, 2, 2]))
    assert tilt_max_deg - 10.0 < tilt_deg.max() <= tilt_max_deg
    assert tilt_deg.min() < 5.0


def test_only_voxels_at_the_thing_count() -> None:
    stage = above_table(1.5, DepthNoise.none(), 0)
    mesh = box_mesh("box", (0.1, 0.1, 0.3))

    def at(x_m: float) -> Body:
        return Body("box", mesh, from_rotation_translation(np.eye(3), (x_m, 0.0, 0.15)), Owner.UNKNOWN)

    voxels = stage.pipeline(FilterSettings()).process(stage.frame(at(0.3)).depth, None).voxels
    assert reported_at(voxels, at(0.3))
    assert not reported_at(voxels, at(-0.3))


@pytest.mark.parametrize("processes", [1, 2])
def test_jobs_come_back_in_their_order(processes: int) -> None:
    with sweeps.runner(processes) as run:
        assert run([partial(pow, 2, power) for power in range(20)]) == [2**power for power in range(20)]


def test_the_command_prints_json_and_reports_a_missed_mark(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    mark = Mark("lost, %", 3.0, at_most=1.0)
    monkeypatch.setitem(sweeps._SWEEPS, "quiet", lambda *_: Result("Quiet", ("a",), ((1,),), (mark,)))
    assert sweeps.main(["--quick", "--only", "quiet", "--processes", "1", "--results", str(tmp_path)]) == 1
    printed = capsys.readouterr().out.splitlines()
    document = json.loads(printed[-1])
    kept = json.loads((tmp_path / "sweeps.json").read_text())
    assert kept.pop("taken")
    assert document == kept
    assert document["passed"] is False
    assert document["quiet"]["marks"] == [{"name": "lost, %", "value": 3.0, "at_most": 1.0, "met": False}]
    assert "MISSED  lost, %: 3 (at most 1)" in printed


def test_a_resolution_that_the_camera_does_not_have(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        sweeps.main(["--resolution", "100x100"])
    assert "expected one of 424x240, 640x480, 848x480, 1280x720, got 100x100" in capsys.readouterr().err
