# SPDX-License-Identifier: Apache-2.0
"""`make right-time`: test that the robot is filtered in its pose at the time of the frame.

A UR3e's tool moves at 1 m/s, on sinusoids and with sharp reversals, in view of a D435i of 848x480 at 15 fps. A box of
10 cm, which no model contains, stands 15 cm beside the arm in every frame, on alternating sides. Embree casts the rays,
and the camera's faults are added. The joints reach the master late, in many ways, and then the unit by the code of the
product. A frame arrives `FRAME_LATENCY_S` after its capture. The command prints a table for each question, and all
figures as one line of JSON; a whole run writes `out/results/right_time.json`. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.joint_delivery import Delivered, Delivery
from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from benchmarks.sweep_scenes.stage import reported_at
from benchmarks.sweeps import runner
from edge_unit.joints import DelayComparison, DelayEstimate, JointEstimate, compare_frame, estimate_delay
from edge_unit.joints.delay_monitor import LOOKS_MAX
from edge_unit.pipeline import DepthPipeline, Voxels
from shared.camera import Intrinsics
from shared.meshes import box_mesh
from shared.settings import Settings
from shared.transforms import apply, from_xyz_rpy, look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.robot_path import JointPath, RobotPath, ShuttlePath
from simulation.world.scene import Body, Owner
from simulation.world.world import World

FRAMES = 500
FPS = 15.0

FRAME_LATENCY_S = 0.02
"""Time from the capture to the unit: 15 to 50 ms with a D435, so this leaves little time for samples to arrive."""

HOLD_S = 0.02
"""Time that a frame might wait for its joints, which delays it in the map. Units do not wait; the benchmark measures
the possible gain.
"""

T_WORLD_CAMERA = look_at((0.9, 0.0, 1.2), (0.25, 0.0, 0.2))

BOX_M, GAP_M = 0.10, 0.15

VISIBLE_PART = 0.5
"""Share of a face of the box. With less of it in view the box need not be reported."""

HOME_RAD = np.array((0.0, -1.25, 1.35, -1.67, -1.57, 0.0))
SWING_RAD = np.array((0.9, 0.12, 0.15, 0.2, 0.0, 0.5))

ROBOT_FRAMES_MAX, BOX_KEPT_MIN = 0.005, 0.99

WRISTS = slice(4, 8)
"""Links that the box stands beside: from the wrists to the tool."""


def paths() -> dict[str, JointPath]:
    """Return the robot's paths: tool up to 1.2 m/s (median 0.8) on sines, 1.05 m/s (median 0.94) with reversals."""
    phase_rad = np.arange(len(HOME_RAD))[None, :].astype(np.float64)
    return {
        "sines": RobotPath(HOME_RAD, SWING_RAD[None, :], phase_rad, 2.0 * np.pi * SWING_RAD[0] / 3.0),
        "reversals": ShuttlePath(HOME_RAD, SWING_RAD, np.array((2.4, 0.3, 0.4, 0.5, 1.0, 1.0)), 15.0),
    }


def deliveries() -> tuple[Delivery, ...]:
    """Return the kinds of joint delivery; the first two are the usual ones."""
    late = Delivery("125 Hz, 40 ms late, with times")
    arrival = Delivery("125 Hz, 40 ms late, no times", stamped=False, configured_delay_s=0.04)
    jittery = replace(arrival, jitter_s=0.01, configured_delay_s=0.05)
    slow = replace(late, rate_hz=30.0)
    return (
        late,
        arrival,
        replace(late, name="no velocities", velocities=False),
        replace(slow, name="30 Hz"),
        replace(slow, name="30 Hz, no velocities", velocities=False),
        replace(late, name="jitter 10 ms", jitter_s=0.01),
        replace(late, name="5 % lost", lost_share=0.05),
        replace(slow, name="30 Hz, jitter, 5 % lost, no velocities", jitter_s=0.01, lost_share=0.05, velocities=False),
        replace(jittery, name="no times, jitter 10 ms"),
        replace(jittery, name="no times, jitter 10 ms, no velocities", velocities=False),
        replace(arrival, name="no times, 30 Hz, jitter, 5 % lost", rate_hz=30.0, jitter_s=0.01, lost_share=0.05,
                configured_delay_s=0.05),
    )  # fmt: skip


WORST = ("30 Hz, jitter, 5 % lost, no velocities", "no times, jitter 10 ms, no velocities")
"""Deliveries with the largest gain from waiting."""

DELAYS_S = (0.0, 0.02, 0.043, 0.08, 0.12)
"""True delays, which the estimate must find."""

FRAME_SPACING_S = 0.5
"""Time between two frames of the delay estimate in a running unit. The estimate uses as many as the unit keeps."""

DELAY_ERROR_MAX_S = 0.005

RIG_CAMERA = 1
"""A camera at a corner of the cell, at twice the distance."""

UNCONFIGURED = Delivery("no times, 40 ms late, delay not told", stamped=False)
"""Result if nobody sets `joint_delay_s`; it has no mark."""


@dataclass(frozen=True, eq=False)
class Watched:
    """One frame: its depth (H, W), its capture time, the box in it, and whether the box is visible."""

    depth: NDArray[np.uint16]
    captured_s: float
    box: Body
    visible: bool


@dataclass(frozen=True)
class Found:
    """Results of one delivery on one path. Per frame: robot voxels reported, box kept, and the padding."""

    path: str
    delivery: str
    hold_s: float
    robot_share: float
    kept_share: float
    visible: int
    padding_m: float
    unknown_share: float


class Stage:
    """The cell, its robot on a path, and a box beside it."""

    def __init__(self, path: JointPath, intrinsics: Intrinsics, seed: int = 0) -> None:
        self.world = replace(World.demo(people=0), robot_path=path)
        self._intrinsics = intrinsics
        self._renderer = RaycastRenderer(intrinsics, T_WORLD_CAMERA)
        self._sensor = DepthSensor(intrinsics, DepthNoise(), seed)
        self._mesh = box_mesh("box", (BOX_M, BOX_M, BOX_M))

    def frame(self, number: int) -> Watched:
        """Return the frame of this number, with noise of its own."""
        t_s = number / FPS
        scene = self.world.scene(t_s)
        box = self._box(t_s, -1.0 if number % 2 else 1.0)
        view = self._renderer.render(replace(scene, moving=(*scene.moving, box)))
        z_m = float(np.linalg.inv(T_WORLD_CAMERA)[2] @ (*box.T_world_mesh[:3, 3], 1.0))
        face_px = self._intrinsics.fx * self._intrinsics.fy * (BOX_M / z_m) ** 2
        visible = int((view.owner == Owner.UNKNOWN).sum()) >= VISIBLE_PART * face_px
        return Watched(self._sensor.measure(view.z_m, number), t_s, box, visible)

    def _box(self, t_s: float, side: float) -> Body:
        """Return the box at the height and distance of the tool. Its near face is `GAP_M` from the arm there."""
        robot, joints = self.world.cell.robot, self.world.joints_at(t_s)
        assert robot is not None
        assert joints is not None
        poses = robot.T_world_base @ robot.link_poses(joints)
        T_world_pan = robot.T_world_base @ from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, float(joints[0])))
        links = [apply(np.linalg.inv(T_world_pan) @ poses[link.index], link.mesh.vertices) for link in robot.links]
        tool_m = links[-1].mean(axis=0)
        beside_m = np.concatenate(links[WRISTS])[:, 1]
        edge_m = beside_m.max() if side > 0.0 else beside_m.min()
        at_m = (tool_m[0], edge_m + side * (GAP_M + 0.5 * BOX_M), tool_m[2])
        return Body("box", self._mesh, T_world_pan @ from_xyz_rpy(at_m, (0.0, 0.0, 0.0)), Owner.UNKNOWN)


def watch(
    name: str, cases: Sequence[tuple[Delivery, float]], frames: int, intrinsics: Intrinsics, settings: Settings
) -> list[Found]:
    """Run the path of this name: first with exact joints, then with each delivery and its waiting time of frames."""
    path = paths()[name]
    stage = Stage(path, intrinsics)
    watched = [stage.frame(number) for number in range(frames)]
    pipeline = DepthPipeline(intrinsics, T_WORLD_CAMERA, stage.world.cell, settings)

    def exact(frame: Watched) -> JointEstimate:
        return JointEstimate(path.joints_at(frame.captured_s), np.zeros(len(HOME_RAD)))

    found = [_judge(name, "joints known exactly", 0.0, pipeline, watched, [exact(frame) for frame in watched])]
    for delivery, hold_s in cases:
        delivered = Delivered(delivery, path, frames / FPS)
        estimates = [
            delivered.joints_at(
                frame.captured_s, frame.captured_s + FRAME_LATENCY_S + hold_s, settings.robot_stale_after_s
            )
            for frame in watched
        ]
        found.append(_judge(name, delivery.name, hold_s, pipeline, watched, estimates))
    return found


def _judge(
    path: str,
    delivery: str,
    hold_s: float,
    pipeline: DepthPipeline,
    watched: Sequence[Watched],
    estimates: Sequence[JointEstimate | None],
) -> Found:
    robot = pipeline.cell.robot
    assert robot is not None
    robot_frames, kept, padding_m = 0, 0, []
    for frame, estimate in zip(watched, estimates, strict=True):
        if estimate is None:
            voxels = pipeline.process(frame.depth, None).voxels
        else:
            voxels = pipeline.process(
                frame.depth, estimate.positions, joint_uncertainty_rad=estimate.uncertainty
            ).voxels
            grown_m = robot.displacement_m(estimate.uncertainty, estimate.positions).max()
            padding_m.append(pipeline.settings.robot_padding_m + float(grown_m))
        robot_frames += bool(_others(voxels, frame.box))
        kept += frame.visible and reported_at(voxels, frame.box)
    visible = sum(frame.visible for frame in watched)
    return Found(
        path,
        delivery,
        hold_s,
        robot_frames / len(watched),
        kept / max(visible, 1),
        visible,
        float(np.median(padding_m)) if padding_m else float("nan"),
        1.0 - len(padding_m) / len(watched),
    )


def _others(voxels: Voxels, box: Body) -> int:
    """Return the number of voxels away from the box. Nothing else is unknown, so they belong to the robot."""
    if not len(voxels):
        return 0
    reach_m = 0.5 * BOX_M * np.sqrt(3.0) + 2.0 * voxels.lattice.voxel_size_m
    away_m = np.linalg.norm(voxels.lattice.centres(voxels.indices) - box.T_world_mesh[:3, 3], axis=1)
    return int((away_m > reach_m).sum())


def result(found: Sequence[Found], bound: Sequence[str]) -> Result:
    """Return one row per case. The cases named in `bound` have marks."""
    rows: list[tuple[str | float, ...]] = []
    marks: list[Mark] = []
    for each in found:
        robot, kept = 100.0 * each.robot_share, 100.0 * each.kept_share
        rows.append((
            each.path, each.delivery, 1e3 * each.hold_s, robot, kept, 1e3 * each.padding_m, 100.0 * each.unknown_share
        ))  # fmt: skip
        if each.delivery in bound and not each.hold_s:
            name = f"{each.path}, {each.delivery}"
            marks.append(Mark(f"{name}: frames with robot voxels, %", robot, at_most=100.0 * ROBOT_FRAMES_MAX))
            marks.append(Mark(f"{name}: box kept in % of frames", kept, at_least=100.0 * BOX_KEPT_MIN))
    columns = ("path", "joints", "held ms", "robot frames %", "box kept %", "median padding mm", "robot unknown %")
    return Result(
        f"The robot where it was: tool at 1 m/s, {FPS:g} fps, frames {1e3 * FRAME_LATENCY_S:g} ms old when they come",
        columns,
        tuple(rows),
        tuple(marks),
    )


@dataclass(frozen=True)
class DelayFound:
    """Estimate of one true delay."""

    path: str
    camera: str
    delay_s: float
    estimate: DelayEstimate


def find_delays(name: str, at_corner: bool, looks: int, intrinsics: Intrinsics) -> list[DelayFound]:
    """Estimate joints with late times, from frames half a second apart in a cell with a walking person."""
    path = {**paths(), "demo": RobotPath.demo()}[name]
    world = replace(World.demo(people=1), robot_path=path)
    pose = rig(world.cell)[RIG_CAMERA] if at_corner else T_WORLD_CAMERA
    camera = SimulatedCamera(world, pose, intrinsics, renderer="raycast")
    settings = Settings()
    static_m = DepthPipeline(intrinsics, pose, world.cell, settings).expected_depth(None)
    assert world.cell.robot is not None
    look = DelayComparison(intrinsics, pose, world.cell.robot, static_m, settings)
    frames = [(camera.capture(number * FRAME_SPACING_S).depth, number * FRAME_SPACING_S) for number in range(looks)]
    found = []
    for delay_s in DELAYS_S:
        late = partial(_late, path, delay_s)
        misfits = [each for depth, t_s in frames if (each := compare_frame(look, depth, t_s, late)) is not None]
        found.append(DelayFound(name, "at a corner" if at_corner else "near", delay_s, estimate_delay(misfits)))
    return found


def _late(path: JointPath, delay_s: float, t_s: float) -> NDArray[np.float64]:
    return path.joints_at(t_s - delay_s)


def delays_result(found: Sequence[DelayFound]) -> Result:
    """Return one row per delay, and a mark for the worst of them."""
    rows = tuple(
        (each.path, each.camera, 1e3 * each.delay_s, 1e3 * each.estimate.delay_s, 1e3 * each.estimate.uncertainty_s,
         each.estimate.looks)
        for each in found
    )  # fmt: skip
    worst_s = max((abs(each.estimate.delay_s - each.delay_s) for each in found), default=float("nan"))
    mark = Mark("delay of the joints, estimated: largest error, ms", 1e3 * worst_s, at_most=1e3 * DELAY_ERROR_MAX_S)
    columns = ("path", "camera", "true ms", "estimated ms", "standard deviation ms", "frames")
    return Result("How late joints are, by frames of the moving robot", columns, rows, (mark,))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all cases."""
    parser = argparse.ArgumentParser(
        prog="make right-time", description="Test the filtering of the robot with late joints."
    )
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"frames of each path ({FRAMES})")
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 2), help="number of processes")
    options = parser.parse_args(arguments)
    bound = [delivery.name for delivery in deliveries()]
    cases = [(delivery, 0.0) for delivery in (*deliveries(), UNCONFIGURED)]
    cases += [(delivery, HOLD_S) for delivery in deliveries() if delivery.name in (bound[0], *WORST)]
    jobs = [partial(watch, name, cases, options.frames, d435i_intrinsics(), Settings()) for name in paths()]
    with runner(options.processes) as run:
        found = [each for part in run(jobs) for each in part]
        delay_jobs = [
            partial(find_delays, name, at_corner, LOOKS_MAX, d435i_intrinsics())
            for name in ("reversals", "demo")
            for at_corner in (False, True)
        ]
        delays = delays_result([each for part in run(delay_jobs) for each in part])
    right = result(found, bound)
    print(f"{right}\n\n{delays}")
    late = [each for each in found if each.delivery == bound[0] and not each.hold_s]
    document: dict[str, Any] = {
        "robot_frames_percent": 100.0 * max(each.robot_share for each in late),
        "box_kept_percent": 100.0 * min(each.kept_share for each in late),
        "delay_error_ms": delays.marks[0].value,
        "right_time": right.document(),
        "delays": delays.document(),
    }
    document["passed"] = passed = all(mark.met for mark in (*right.marks, *delays.marks))
    if options.frames >= FRAMES:
        write("right_time", document, RESULTS)
    print(line(document))
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
