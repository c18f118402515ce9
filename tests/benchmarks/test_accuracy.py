# SPDX-License-Identifier: Apache-2.0
"""Measurement of accuracy: baselines behave as described, and the truth does not come from the filter."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks import accuracy
from benchmarks.ground_truth import real
from benchmarks.ground_truth.curves import AXES, METRICS, Collection, Curve, worse
from benchmarks.ground_truth.plan import BASELINES, OURS, POINTS
from benchmarks.ground_truth.rules import Measured, MinimumPoints, Ours, Paper, Place, algorithm_1, algorithm_6, before
from benchmarks.ground_truth.surface import TOOL_M, Judge, Surface, Tally, visible_pixels_min
from benchmarks.ground_truth.things import THINGS, before_wall, placed
from benchmarks.ground_truth.trials import Entry
from benchmarks.reporting.plots import draw
from edge_unit.pipeline import DepthPipeline
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import apply, inverse
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import FIRST_UNKNOWN

Keys = NDArray[np.uint32]
DISTANCE_M, BEHIND_M = 1.5, 1.0


class Scene:
    """A perfect camera before one thing."""

    def __init__(self, thing: str, noise: DepthNoise | None = None, seed: int = 3) -> None:
        stage = before_wall(DISTANCE_M, BEHIND_M, noise or DepthNoise.none(), seed)
        self.place = Place(stage.intrinsics, stage.T_world_camera, stage.cell)
        frame = stage.frame(*placed(thing, DISTANCE_M, np.random.default_rng(seed)))
        self.depth, self.view = frame.depth, frame.view
        self.pipeline = DepthPipeline(stage.intrinsics, stage.T_world_camera, stage.cell)
        known_m = self.pipeline.expected_depth(None)
        self.frame = Measured(self.depth, None, known_m, np.zeros(stage.intrinsics.shape, np.bool_))
        self.surface = Surface.of(self.view, self.place, DepthNoise(), np.random.default_rng(0))
        self.lattice: Lattice = stage.cell.lattice(0.05)
        self.judge = Judge(self.place, self.lattice, DepthNoise())

    def true_keys(self) -> Keys:
        return np.unique(self.lattice.keys(self.lattice.index(self.surface.points_m))).astype(np.uint32)


@pytest.mark.parametrize("thing", THINGS)
def test_a_thing_is_at_its_place_and_every_measured_voxel_is_found(thing: str) -> None:
    scene = Scene(thing)
    middles_m = apply(inverse(scene.place.T_world_camera), scene.surface.points_m).mean(axis=0)
    assert abs(middles_m[2] - DISTANCE_M) < 0.3
    assert np.abs(middles_m[:2]).max() < 0.45
    tally = scene.judge.judge(scene.surface, MinimumPoints(0.5, 1).at(scene.place, 0.05)(scene.frame))
    assert tally.visible == tally.found == tally.found_strictly > 0
    assert tally.false == 0
    assert 1e3 * abs(tally.camera_errors_m[0]) < 90.0


def test_the_wall_is_known_by_rays_as_by_the_rasteriser() -> None:
    scene = Scene("arm 80 mm")
    wall = scene.view.owner < FIRST_UNKNOWN
    assert np.abs(scene.frame.known_m - scene.view.z_m)[wall].max() < 1e-3


def test_the_papers_rule_is_the_pipelines_own_paper_rule_but_for_the_shifted_lattice() -> None:
    scene = Scene("box 300 mm")
    settings = FilterSettings(density_rule="single", density_model="angular", occupancy_threshold=0.55)
    ours = Ours(settings).at(scene.place, 0.05)(scene.frame)
    # On the stage no pixel lies between the two limits, so only voxels and density differ.
    paper = Paper(0.3, 0.55).at(scene.place, 0.05)(scene.frame)
    assert len(ours) > 10
    assert len(np.intersect1d(ours, paper)) >= 0.8 * max(len(ours), len(paper))


def test_algorithms_1_and_6_are_as_the_paper_has_them() -> None:
    points_m = np.array([[0.0499, 0.0, -0.001], [0.0488, 0.12, 0.0]])
    # 0.0488 / 0.05 + 0.025 is 1.001: the constant has the wrong unit, and shifts by a fortieth of a voxel.
    assert algorithm_1(points_m, 0.05).tolist() == [[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]]
    camera = before_wall(1.0, 1.0, DepthNoise.none(), 0).intrinsics
    full = algorithm_6(0.05, np.array([1.0, 2.0]), camera)
    columns = math.degrees(math.atan(0.05)) / (math.degrees(2 * math.atan(424 / 425)) / 848)
    rows = math.degrees(math.atan(0.05)) / (math.degrees(2 * math.atan(240 / 425)) / 480)
    assert full[0] == pytest.approx(columns * rows)
    # More than a pinhole delivers in the middle of the view, because it is an average over the whole view.
    assert full[0] > 1.2 * (425 * 0.05) ** 2
    assert full[0] / full[1] == pytest.approx(4.0, rel=0.01)


def test_a_fixed_limit_keeps_nearer_pixels_except_the_robot() -> None:
    scene = Scene("arm 80 mm")
    depth = np.full_like(scene.depth, 2400)
    depth[0], depth[1] = 2390, 0
    robot = np.zeros(depth.shape, np.bool_)
    robot[:, :100] = True
    frame = Measured(depth, None, np.full(depth.shape, 2.495, np.float32), robot)
    chosen = before(scene.place, frame, 0.1)
    assert chosen[0, 100:].all()
    assert chosen.sum() == depth.shape[1] - 100


def test_a_voxel_is_false_beyond_its_diagonal_and_the_noise() -> None:
    scene = Scene("rod 20 mm")
    toward_camera = scene.place.T_world_camera[:3, 3] - scene.surface.points_m[0]
    toward_camera /= np.linalg.norm(toward_camera)
    tolerance_m = math.sqrt(3.0) * 0.05 + scene.surface.tolerance_m.max()

    def false_at(distance_m: float) -> int:
        nearest_m = scene.surface.points_m[np.argmin(scene.surface.points_m @ -toward_camera)]
        key = scene.lattice.keys(scene.lattice.index((nearest_m + distance_m * toward_camera)[None]))
        return scene.judge.judge(scene.surface, key).false

    assert false_at(0.0) == 0
    assert false_at(tolerance_m - 0.06) == 0
    assert false_at(tolerance_m + 0.06) == 1


def test_recall_within_a_voxel_and_strictly() -> None:
    scene = Scene("arm 80 mm")
    visible = scene.judge._visible_keys(scene.surface)
    shifted = scene.lattice.keys(scene.lattice.indices(visible) + np.array((0, 0, 1), np.int16))
    tally = scene.judge.judge(scene.surface, np.unique(shifted))
    assert tally.found == tally.visible
    assert tally.found_strictly < tally.visible
    nothing = scene.judge.judge(scene.surface, np.empty(0, np.uint32))
    assert (nothing.found, nothing.lost_frames) == (0, 1)
    assert nothing.tool_errors_m == [math.inf]


def test_errors_of_distance_are_signed_and_those_of_the_cube() -> None:
    scene = Scene("box 300 mm")
    from_tool_m = np.linalg.norm(scene.surface.points_m - scene.surface.tool_m, axis=1).min()
    assert TOOL_M <= from_tool_m < 3.0 * TOOL_M
    exact = scene.judge.judge(scene.surface, scene.true_keys())
    assert -0.05 * math.sqrt(3.0) <= exact.tool_errors_m[0] <= 0.0
    assert -0.05 * math.sqrt(3.0) <= exact.camera_errors_m[0] <= 0.0
    order = np.argsort(np.linalg.norm(scene.surface.points_m - scene.surface.tool_m, axis=1))
    far = scene.lattice.keys(scene.lattice.index(scene.surface.points_m[order[-1:]]))
    assert scene.judge.judge(scene.surface, far).tool_errors_m[0] > 0.1


def test_n_is_listed_and_falls_with_distance() -> None:
    place = Scene("rod 10 mm").place
    assert visible_pixels_min(place, 0.05, 1.5) == math.ceil(0.1 * (425 * 0.05 / 1.5) ** 2)
    assert visible_pixels_min(place, 0.01, 4.0) == 1


def test_only_figures_in_which_ours_is_worse_are_listed() -> None:
    def curve(metric: str, mine: float, theirs: float) -> Curve:
        return Curve(AXES["distance"], METRICS[metric], "arm", {OURS: [(2.0, mine)], POINTS: [(2.0, theirs)]}, 5)

    said = worse(
        [
            curve("recall_percent", 90.0, 95.0),
            curve("false_per_1000", 40.0, 0.0),
            curve("tool_median_mm", -60.0, 20.0),
            curve("lost_percent", 0.0, 50.0),
            curve("tool_p99_mm", math.nan, 10.0),
        ],
        OURS,
        BASELINES,
    )
    assert [row[:2] for row in said.rows] == [
        (POINTS, f"{METRICS[key].label}, {METRICS[key].unit}")
        for key in ("recall_percent", "false_per_1000", "tool_median_mm", "tool_p99_mm")
    ]
    assert said.rows[0][-3:] == (2.0, 90.0, 95.0)
    assert worse([curve("recall_percent", 95.0, 90.0), curve("tool_median_mm", 5.0, -60.0)], OURS, BASELINES).rows == ()


def test_tallies_add_up_by_thing_and_over_all() -> None:
    collection = Collection()
    entry = Entry("distance", OURS, 1.0, Paper())
    for thing, found in (("rod", 3), ("arm", 9)):
        collection.add(thing, [(entry, Tally(frames=2, visible=10, found=found, tool_errors_m=[0.01, math.inf]))], True)
    assert collection.tally("distance", "rod", OURS).found == 3
    both = collection.tally("distance", "all things", OURS, 1.0)
    assert (both.frames, both.visible, both.found) == (4, 20, 12)
    drawn = {(curve.subject, curve.metric.key): curve for curve in collection.curves()}
    assert drawn["all things", "recall_percent"].series == {OURS: [(1.0, 60.0)]}
    assert drawn["rod", "tool_median_mm"].series[OURS] == [(1.0, 10.0)]
    # Half of the frames reported nothing, so the 99 % quantile is infinite, which is no figure.
    assert drawn["rod", "tool_p99_mm"].document()["contenders"] == {OURS: [None]}


def test_a_quick_run_leaves_curves_that_explain_themselves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = [part for part in accuracy.PARTS if part != accuracy.REAL]
    code = accuracy.main(["--quick", "--processes", "1", "--results", str(tmp_path), "--only", *parts])
    document = json.loads((tmp_path / "accuracy.json").read_text())
    assert code == (0 if document["passed"] else 1)
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["passed"] == document["passed"]
    assert {figure["x"]["key"] for figure in document["figures"]} == set(AXES)
    for figure in document["figures"]:
        assert figure["x"]["unit"]
        assert figure["y"]["unit"]
        assert set(figure["contenders"]) <= set(document["contenders"])
        assert all(len(values) == len(figure["x"]["values"]) for values in figure["contenders"].values())
    arm = next(each for each in document["figures"] if each["id"] == "distance/recall_percent/arm 80 mm")
    assert arm["x"]["values"] == [1.0, 3.0]
    assert min(arm["contenders"][OURS]) > 95.0
    assert arm["contenders"]["paper"][-1] < 50.0
    assert len(document["curves"]) >= 10
    files = [draw(picture, tmp_path, "accuracy") for picture in document["curves"]]
    assert len(set(files)) == len(files)
    for picture in document["curves"]:
        assert picture["title"]
        assert picture["y_label"]
        assert "(" in picture["x_label"]


def test_real_frames_one_by_one(data_dir: Path) -> None:
    judged = real.watch(OURS, {POINTS: MinimumPoints()}, FilterSettings(), 0)
    assert [mark.met for mark in real.marks(judged, OURS)] == [True, True, True]
    frames, distributions = real.results(judged, OURS)
    mine = [row for row in frames.rows if row[0] == OURS]
    assert [row[1] for row in mine] == [0, 1, 2, 3]
    assert min(float(row[4]) for row in mine) >= 90
    assert max(float(row[5]) for row in frames.rows if row[0] == POINTS) > 0
    assert any("second robot missed" in text for text in frames.remarks)
    assert [row[:2] for row in distributions.rows][:2] == [(OURS, "robot reported"), (OURS, "second robot missed")]
