# SPDX-License-Identifier: Apache-2.0
"""The joints' delay, estimated from frames of a robot that moves; with a real master it is reported as a warning."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from edge_unit.__main__ import main
from edge_unit.joints import (
    DelayComparison,
    DelayEstimate,
    DelayMonitor,
    JointHistory,
    compare_frame,
    delay_monitor,
    estimate_delay,
)
from edge_unit.joints.delay_estimation import LOOKS_MIN
from edge_unit.joints.delay_from_recording import JointSamples
from edge_unit.joints.delay_monitor import PERIOD_NS
from edge_unit.pipeline import DepthPipeline
from shared.clock import NS_PER_S
from shared.errors import InputError, SourceError
from shared.messages import JointSample
from shared.settings import FilterSettings
from shared.transforms import look_at as camera_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics
from simulation.world.robot_path import JointPath, RobotPath
from simulation.world.world import DEMO_CELL, World

Frame = tuple[NDArray[np.uint16], float]

INTRINSICS = d435i_intrinsics(424, 240)
POSE = camera_at((0.9, 0.0, 1.2), (0.25, 0.0, 0.2))
PATH = RobotPath.demo()
PERIOD_S = 0.2


@pytest.fixture(scope="module")
def world() -> World:
    return World.demo(people=1)


@pytest.fixture(scope="module")
def pipeline(world: World) -> DepthPipeline:
    return DepthPipeline(INTRINSICS, POSE, world.cell)


@pytest.fixture(scope="module")
def frames(world: World) -> list[Frame]:
    """Eight seconds with a person who walks by."""
    camera = SimulatedCamera(world, POSE, INTRINSICS)
    return [(camera.capture(number * PERIOD_S).depth, number * PERIOD_S) for number in range(40)]


def looks(
    pipeline: DepthPipeline, frames: list[Frame], delay_s: float, path: JointPath = PATH
) -> list[NDArray[np.float64]]:
    robot = pipeline.cell.robot
    assert robot is not None
    comparison = DelayComparison(INTRINSICS, POSE, robot, pipeline.expected_depth(None), FilterSettings())
    found = [
        compare_frame(comparison, depth, t_s, lambda at_s: path.joints_at(at_s - delay_s)) for depth, t_s in frames
    ]
    return [misfits for misfits in found if misfits is not None]


@pytest.mark.parametrize("delay_s", [-0.03, 0.0, 0.017, 0.043, 0.12])
def test_the_delay_is_found_within_5_ms(pipeline: DepthPipeline, frames: list[Frame], delay_s: float) -> None:
    found = estimate_delay(looks(pipeline, frames, delay_s))
    assert found.delay_s == pytest.approx(delay_s, abs=0.005)
    assert 0.0 < found.uncertainty_s < 0.005
    assert found.looks >= LOOKS_MIN


def test_a_robot_that_hardly_moves_gives_no_estimate(pipeline: DepthPipeline, frames: list[Frame]) -> None:
    assert looks(pipeline, frames, 0.0, RobotPath.still(PATH.joints_at(0.0))) == []
    with pytest.raises(InputError, match="hardly moved"):
        estimate_delay([])


def test_a_delay_beyond_the_tried_range_is_refused(pipeline: DepthPipeline, frames: list[Frame]) -> None:
    with pytest.raises(InputError, match="the same clock"):
        estimate_delay(looks(pipeline, frames, 0.24))


def test_a_running_unit_warns_of_a_delay_that_is_off(pipeline: DepthPipeline, frames: list[Frame]) -> None:
    """Joints come 60 ms late, without times; frames are kept until those are known."""
    watch, history = DelayMonitor(), JointHistory()
    began_ns, told = 100 * NS_PER_S, []
    # Slower than the frames were taken, so that each is due.
    slow = PERIOD_NS / NS_PER_S / PERIOD_S
    path = replace(PATH, period_s=PATH.period_s * slow)
    for depth, frame_s in frames:
        at_ns = began_ns + round(frame_s * slow * NS_PER_S)
        assert watch.due(at_ns)
        watch.keep(pipeline, depth, at_ns)
        assert not watch.due(at_ns + PERIOD_NS // 2)
        assert watch.next_comparison(history) is None
        for step in range(round(PERIOD_NS / NS_PER_S / 0.008)):
            t_s = frame_s * slow + 0.008 * step - 0.1
            late_ns = began_ns + round((t_s + 0.06) * NS_PER_S)
            history.add([JointSample(late_ns, tuple(path.joints_at(t_s).tolist()), None)])
        comparison = watch.next_comparison(history)
        if comparison is not None:
            comparison()
        told.append(watch.warning(0.0))
    assert told[: LOOKS_MIN - 1] == [None] * (LOOKS_MIN - 1)
    assert told[-1] is not None
    assert float(told[-1].split("seem ")[1].split(" ms later")[0]) == pytest.approx(60.0, abs=5.0)
    assert watch.warning(0.06) is None
    earlier = watch.warning(0.12)
    assert earlier is not None
    assert "earlier" in earlier
    assert len(told[-1]) < 200


def test_comparisons_run_one_by_one_and_those_of_another_background_do_not_count(
    world: World, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = DepthPipeline(INTRINSICS, POSE, world.cell)
    monkeypatch.setattr(delay_monitor, "estimate_delay", lambda misfits: DelayEstimate(1.0, 0.0, len(misfits)))
    watch, history = DelayMonitor(), JointHistory()
    depth, frame_s = frames[3]
    for step in range(150):
        t_s = frame_s - 0.2 + 0.008 * step
        history.add([JointSample(NS_PER_S + round(t_s * NS_PER_S), tuple(PATH.joints_at(t_s).tolist()), None)])

    def kept_look() -> Callable[[], None] | None:
        watch.keep(pipeline, depth, NS_PER_S + round(frame_s * NS_PER_S))
        return watch.next_comparison(history)

    first = kept_look()
    assert first is not None
    assert watch.next_comparison(history) is None
    # Until it is done there is no other comparison, and a frame that is kept meanwhile waits for it.
    assert kept_look() is None
    first()
    assert watch.warning(0.0) is not None
    second = watch.next_comparison(history)
    assert second is not None
    pipeline.move(camera_at((0.9, 0.1, 1.2), (0.25, 0.0, 0.2)))
    watch.keep(pipeline, depth, NS_PER_S + round(frame_s * NS_PER_S))
    second()
    assert watch.warning(0.0) is None
    third = watch.next_comparison(history)
    assert third is not None
    third()
    assert watch.warning(0.0) is not None


def test_a_frame_that_is_kept_is_a_copy(pipeline: DepthPipeline, frames: list[Frame]) -> None:
    """The source uses its memory again, and the pipeline goes on during the comparison."""
    depth, frame_s = frames[3]
    robot = pipeline.cell.robot
    assert robot is not None
    static_m = pipeline.expected_depth(None)
    comparison = DelayComparison(INTRINSICS, POSE, robot, static_m, FilterSettings())
    joints = [PATH.joints_at(frame_s)]
    before = depth.copy()
    thinned_m = comparison.thinned(before)
    expected = comparison.misfits(thinned_m, joints)
    before[:] = 0
    static_m[:] = 0.0
    np.testing.assert_array_equal(comparison.misfits(thinned_m, joints), expected)


def test_the_delay_of_a_recording_is_estimated(
    frames: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "recording"
    (folder / "depth").mkdir(parents=True)
    for number, (depth, _) in enumerate(frames):
        assert cv2.imwrite(str(folder / "depth" / f"{number:02d}.png"), depth)
    k = [INTRINSICS.fx, 0.0, INTRINSICS.cx, 0.0, INTRINSICS.fy, INTRINSICS.cy, 0.0, 0.0, 1.0]
    (folder / "camera_info.yaml").write_text(yaml.safe_dump({"width": 424, "height": 240, "k": k}))
    np.savetxt(folder / "T_base_optical.txt", POSE)
    np.savetxt(folder / "frame_times_s.csv", [t_s for _, t_s in frames])
    times_s = np.arange(-0.5, 9.0, 0.02)
    rows = [(t_s + 0.08, *PATH.joints_at(t_s)) for t_s in times_s]
    np.savetxt(folder / "joint_samples.csv", rows, delimiter=",")
    command = ("joint-delay", str(folder), "--cell", str(DEMO_CELL))
    assert main(command) == 0
    told = capsys.readouterr().out
    assert float(told.split()[1]) == pytest.approx(0.08, abs=0.005)
    np.savetxt(folder / "frame_times_s.csv", [t_s for _, t_s in frames[1:]])
    assert main(command) == 1
    assert "frame_times_s.csv: expected a row for each of 40 frames, not 39" in capsys.readouterr().err
    (folder / "joint_samples.csv").write_text("0.0,1.0\n")
    assert main(command) == 1
    assert "joint_samples.csv: expected rows of 7 numbers" in capsys.readouterr().err


def test_dense_samples_are_interpolated() -> None:
    samples = JointSamples(np.array(((0.0, 1.0), (0.1, 2.0), (0.9, 3.0))), Path("samples.csv"))
    assert samples.at(0.05) == pytest.approx([1.5])
    assert samples.at(0.5) is None
    assert samples.at(-0.1) is None
    assert samples.at(1.0) is None
    with pytest.raises(SourceError, match="rising"):
        JointSamples(np.array(((0.1, 1.0), (0.1, 2.0))), Path("samples.csv"))
