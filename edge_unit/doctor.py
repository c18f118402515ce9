# SPDX-License-Identifier: Apache-2.0
"""`edge-unit doctor`: checks all requirements of a unit, and prints remedies for a person with a board.

It changes nothing: it queries the master, but does not register.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import platform
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from edge_unit.config import UnitConfig
from edge_unit.monitoring import clock_is_set, usb_cameras
from edge_unit.sources.frame import CameraInfo, DepthFrame, DepthSource
from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.capture_session import CaptureSession
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.tls import tls_context
from edge_unit.uplink.cell_cache import mesh_hashes
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.master_discovery import check_offers, criteria_of, last_master_of, reach
from edge_unit.uplink.master_selection import MasterAddress, choose, initial_address
from geometry.compilation.cache import PRIVATE, settle
from shared.cell import Cell
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns, wall_ns
from shared.discovery import Browser
from shared.errors import CellwatchError, ConfigError, MasterRefused, SourceError
from shared.messages import UpdateRequest, Versions
from shared.settings import FilterSettings
from shared.transforms import Transform, look_at
from shared.waiting import within

Level = Literal["ok", "warning", "FAIL"]

MEASURE_S = 3.0
"""Long enough to measure the frame rate to a few per cent."""

KEPT_FRAMES = 10
"""Number of the measured frames that the pipeline processes."""

RATE_OK, RATE_POOR = 0.9, 0.5
"""Shares of the configured rate."""

VALID_OK = 0.3
"""Share of measured pixels; a camera that looks into a cell has twice that."""

BUDGET_OK = 0.7
"""Share of a frame's period that processing may take, so that the board keeps a reserve."""

ROUND_TRIP_OK_MS = 20.0
"""Half of it is the time error of the robot's joints: at 1 rad/s and 1 m reach, a centimetre."""

LISTEN_S = 2.0
"""Time to hear announcements of masters; they answer within a fifth of a second."""

SURVEY_S = 15.0
"""Time for the SDK to search for cameras."""

NOBODY = 2**62
"""An id that no unit has."""

EPOCH_NS = 1_735_689_600 * NS_PER_S
"""2025-01-01: a clock that shows an earlier date was never set."""


@dataclass(frozen=True)
class Finding:
    """One line of the report; `text` is the result and, unless it is ok, the remedy."""

    level: Level
    what: str
    text: str

    def __str__(self) -> str:
        return f"{self.level:<8} {self.what:<9} {self.text}"


@dataclass
class Measured:
    """Frames and ages that a source delivered during the check."""

    numbers: list[int] = field(default_factory=list)
    captured_ns: list[int] = field(default_factory=list)
    ages_ms: list[float] = field(default_factory=list)
    depth: list[NDArray[np.uint16]] = field(default_factory=list)

    @property
    def fps(self) -> float:
        """Frames that the camera took in a second, including dropped ones."""
        span_ns = self.captured_ns[-1] - self.captured_ns[0] if self.captured_ns else 0
        return (self.numbers[-1] - self.numbers[0]) * NS_PER_S / span_ns if span_ns > 0 else 0.0


async def examine(config: UnitConfig, seconds: float = MEASURE_S) -> AsyncIterator[Finding]:
    """Yield the result of one check after the other, each as soon as it is known."""
    yield await asyncio.to_thread(software)
    yield clock()
    cell: Cell | None = None
    address: MasterAddress | None = None
    async for heard in _network(config):
        if isinstance(heard, MasterAddress):
            address = heard
        else:
            yield heard
    if address is not None:
        async for found in _master(config, address):
            if isinstance(found, Cell):
                cell = found
            else:
                yield found
    source = config.source
    if isinstance(source, RealsenseSourceConfig):
        async for finding in _cameras(source):
            yield finding
            if finding.level == "FAIL":
                return
    measured = Measured()
    info: CameraInfo | None = None
    camera, settled = await asyncio.to_thread(_source, config)
    try:
        info = await camera.open()
        await within(seconds, _watch(camera, measured))
    except SourceError as error:
        yield Finding("FAIL", "stream", str(error))
    finally:
        wanted_fps = _wanted_fps(camera, config)
        warning = camera.status.warning if isinstance(camera, RealsenseSource) else ""
        await camera.close()
    if info is None:
        return
    if warning:
        yield Finding("warning", "profile", warning)
    for finding in stream(info, measured, wanted_fps):
        yield finding
    for finding in await asyncio.to_thread(_pipeline, config, info, cell, measured, wanted_fps, settled):
        yield finding


def software() -> Finding:
    """Report the software versions."""
    version = importlib.metadata.version("cellwatch")
    return Finding("ok", "software", f"cellwatch {version}, Python {platform.python_version()}, {platform.machine()}")


def clock() -> Finding:
    """Check the wall clock, which logs show; units and master use clocks that are never set."""
    if wall_ns() < EPOCH_NS:
        return Finding("warning", "clock", "it was never set, so the times in logs are wrong; start an NTP service")
    if not clock_is_set():
        return Finding("warning", "clock", "no NTP service sets it; times in logs may be off (frames are not)")
    return Finding("ok", "clock", "set by NTP")


def stream(info: CameraInfo, measured: Measured, wanted_fps: float | None) -> Iterator[Finding]:
    """Check the frames of a camera."""
    lens = info.intrinsics
    if len(measured.numbers) < 2:
        yield Finding("FAIL", "stream", f"{info.model} {info.serial} was opened and delivered no frames")
        return
    rate = f"{lens.width}x{lens.height} at {measured.fps:.1f} fps, {np.median(measured.ages_ms):.0f} ms old on arrival"
    share = 1.0 if wanted_fps is None else measured.fps / wanted_fps
    if share >= RATE_OK:
        yield Finding("ok", "stream", rate)
    else:
        advice = "more light (exposure is longer than a frame), a port and cable of its own, or a lower fps"
        level: Level = "warning" if share >= RATE_POOR else "FAIL"
        yield Finding(level, "stream", f"{rate}, {wanted_fps:g} are wanted: try {advice}")
    valid = float(np.mean([np.count_nonzero(depth) / depth.size for depth in measured.depth]))
    if valid >= VALID_OK:
        yield Finding("ok", "depth", f"{valid:.0%} of the pixels measure something")
    else:
        yield Finding(
            "warning", "depth", f"only {valid:.0%} of the pixels measure anything; is the lens free and the cell lit?"
        )


async def _network(config: UnitConfig) -> AsyncIterator[Finding | MasterAddress]:
    """List the announced masters, the objection to each, and the unit's choice."""
    try:
        tls = await asyncio.to_thread(config.tls) or tls_context()
    except ConfigError as error:
        yield Finding("FAIL", "master", f"{error}; correct the configuration")
        return
    criteria, last_master = criteria_of(config), await asyncio.to_thread(last_master_of, config)
    async with Browser() as browser:
        await asyncio.sleep(LISTEN_S)
        candidates = await check_offers(await browser.offers(), criteria, last_master, tls, config.source_address)
    for candidate in candidates:
        yield Finding("ok", "network", f"there is {candidate}")
    chosen, words = choose(candidates)
    address = initial_address(criteria, last_master)
    if chosen is not None and chosen.url is not None:
        if address is None or (address.url != chosen.url and await reach(address.url, tls, config.source_address)):
            address = MasterAddress(chosen.url, words)
    elif not candidates:
        yield Finding("ok" if address is not None else "warning", "network", words)
    if address is not None:
        yield address
    else:
        yield Finding("FAIL", "master", f"{words}; start it on this network, or set master_url")


async def _master(config: UnitConfig, address: MasterAddress) -> AsyncIterator[Finding | Cell]:
    """Check that the master answers and accepts the token; returns its cell, if it gives it."""
    try:
        tls = await asyncio.to_thread(config.tls)
        client = MasterClient(address.url, config.read_token, config.source_address, tls=tls)
    except ConfigError as error:
        yield Finding("FAIL", "master", f"{error}; correct the configuration")
        return
    try:
        await asyncio.to_thread(config.read_token)
    except ConfigError as error:
        yield Finding("FAIL", "token", f"{error}; copy the master's unit.token to this board")
        return
    async with client:
        try:
            asked_ns = monotonic_ns()
            await client.robot(0, MEASURE_S)
            first_ns, asked_ns = monotonic_ns() - asked_ns, monotonic_ns()
            await client.robot(0, MEASURE_S)
            trip_ms = min(first_ns, monotonic_ns() - asked_ns) / NS_PER_MS
        except MasterRefused as error:
            yield Finding("FAIL", "token", f"{error}; copy the master's unit.token to this board")
            return
        except CellwatchError as error:
            yield Finding("FAIL", "master", f"{error}; is it running, and is master_url right?")
            return
        if trip_ms <= ROUND_TRIP_OK_MS:
            yield Finding("ok", "master", f"{client.url} ({address.found_by}) answers within {trip_ms:.1f} ms")
        else:
            yield Finding(
                "warning",
                "master",
                f"{client.url} ({address.found_by}) takes {trip_ms:.0f} ms to answer; use a cable, not a radio network",
            )
        yield await _token(client)
        try:
            document = await client.cell_document()
            meshes = {sha256: await client.mesh(sha256) for sha256 in mesh_hashes(document)}
            cell = await asyncio.to_thread(Cell.from_document, document, meshes)
        except CellwatchError as error:
            yield Finding("FAIL", "cell", str(error))
            return
        yield Finding("ok", "cell", f"{cell.name}, {len(cell.static) + len(cell.objects)} known bodies")
        yield cell


async def _token(client: MasterClient) -> Finding:
    """Check that the token is a unit's: an update of a non-existent unit is refused for that reason, or another."""
    update = UpdateRequest(id=NOBODY, session=0, sequence=0, sent_at_ns=monotonic_ns(), versions=Versions())
    try:
        await client.update(update)
    except MasterRefused as error:
        if error.status not in (401, 403):
            return Finding("ok", "token", "accepted")
        return Finding("FAIL", "token", f"{error}; copy the master's unit.token to this board")
    except CellwatchError as error:
        return Finding("FAIL", "token", str(error))
    return Finding("warning", "token", "the master took an update of a unit that does not exist; is it ours?")


async def _cameras(source: RealsenseSourceConfig) -> AsyncIterator[Finding]:
    """Check the SDK, and list its cameras."""
    try:
        found = await _survey()
    except SourceError as error:
        yield Finding("FAIL", "sdk", str(error))
        return
    yield Finding("ok", "sdk", f"RealSense SDK {found.sdk} with libusb of {found.libusb}")
    if source.recording is not None:
        yield Finding("ok", "camera", f"none is needed, {source.recording} is played")
        return
    for device in found.devices:
        yield Finding("ok", "camera", f"{device['model']}, serial {device['serial']}")
        firmware, recommended = device["firmware"], device["recommended_firmware"]
        if recommended and firmware != recommended:
            yield Finding(
                "warning", "firmware", f"{firmware}, {recommended} is recommended: update it with realsense-viewer"
            )
        else:
            yield Finding("ok", "firmware", firmware or "not known")
        slow = device["usb"].startswith(("1", "2"))
        advice = ": few profiles and low rates; use a USB 3 port and its cable" if slow else ""
        yield Finding("warning" if slow else "ok", "usb", f"USB {device['usb'] or 'version not known'}{advice}")
    serials = [device["serial"] for device in found.devices]
    if source.serial is not None and source.serial not in serials:
        there = ", ".join(serials) or "none"
        yield Finding(
            "FAIL", "camera", f"source.serial is {source.serial}, and there is {there}: correct it, or plug it in"
        )
    elif not serials:
        yield Finding("FAIL", "camera", _no_camera(await asyncio.to_thread(usb_cameras)))
    elif len(serials) > 1 and source.serial is None:
        yield Finding("FAIL", "camera", f"there are {len(serials)}: choose one by source.serial")


def _no_camera(on_usb: list[str]) -> str:
    if on_usb:
        return (
            f"the kernel sees {', '.join(on_usb)}, the SDK may not open it: install the udev rules "
            "(in deploy/systemd), plug it in anew, or run as a member of the group plugdev"
        )
    return (
        "none is connected: check cable and power. To go on without one, play a recording (source.recording) "
        "or simulate (source.kind: simulated)"
    )


async def _survey() -> link.Found:
    """List the SDK's cameras.

    Raises:
        SourceError: it cannot be loaded, or does not answer.
    """
    session = await CaptureSession.begin(link.Survey())
    deadline_ns = monotonic_ns() + round(SURVEY_S * NS_PER_S)
    try:
        while monotonic_ns() < deadline_ns:
            await session.wait(1.0)
            while (message := session.message()) is not None:
                if isinstance(message, link.Found):
                    return message
                if isinstance(message, link.Failed):
                    raise SourceError(message.reason)
            if session.gone:
                raise SourceError(f"the RealSense SDK was ended by {await session.ended()}")
    finally:
        await session.kill()
    raise SourceError(f"the RealSense SDK did not answer within {SURVEY_S:g} s; unplug all cameras and try again")


def _source(config: UnitConfig) -> tuple[DepthSource, Path]:
    """Make the source and settle the cache of compiled kernels, before the first kernel is imported."""
    settled = settle(config.jit_cache_dir)
    from edge_unit.source_factory import make_source

    return make_source(config.source), settled


async def _watch(camera: DepthSource, measured: Measured) -> None:
    async for frame in camera.frames():
        _note(measured, frame)


def _note(measured: Measured, frame: DepthFrame) -> None:
    measured.numbers.append(frame.frame_number)
    measured.captured_ns.append(frame.captured_at_ns)
    measured.ages_ms.append((monotonic_ns() - frame.captured_at_ns) / NS_PER_MS)
    if len(measured.depth) < KEPT_FRAMES:
        measured.depth.append(frame.depth.copy())


def _wanted_fps(camera: DepthSource, config: UnitConfig) -> float | None:
    """Return the configured rate; None if frames come as fast as they are taken."""
    if isinstance(camera, RealsenseSource):
        recorded = isinstance(config.source, RealsenseSourceConfig) and config.source.recording is not None
        return None if recorded or camera.opened is None else float(camera.opened.fps)
    return getattr(config.source, "fps", None)


def _pipeline(
    config: UnitConfig,
    info: CameraInfo,
    cell: Cell | None,
    measured: Measured,
    wanted_fps: float | None,
    settled: Path,
) -> Iterator[Finding]:
    """Measure the kernels and the cost of a frame, with the measured frames and the robot in another pose for each."""
    from edge_unit.pipeline import DepthPipeline
    from geometry.kernels.points import count_foreground

    if not measured.depth:
        return iter(())
    what = f"cell {cell.name}" if cell is not None else "an empty cell of 2 m, for want of the master's"
    cell = cell or Cell("stand-in", np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0]))
    began_ns = monotonic_ns()
    pipeline = DepthPipeline(info.intrinsics, _pose(config, info, cell), cell, FilterSettings())
    costs_ms = []
    count = cell.robot.joint_count if cell.robot is not None else 0
    for number, depth in enumerate([measured.depth[0], *measured.depth]):
        joints = np.full(count, 0.02 * number) if count else None
        started_ns = monotonic_ns()
        pipeline.process(depth, joints)
        costs_ms.append((monotonic_ns() - started_ns) / NS_PER_MS)
        if number == 0:
            compiled_s = (monotonic_ns() - began_ns) / NS_PER_S
    findings = [_kernels(settled, compiled_s, compiled=bool(cast(Any, count_foreground).stats.cache_misses))]
    cost_ms, worst_ms = float(np.median(costs_ms[1:])), max(costs_ms[1:])
    text = f"{cost_ms:.1f} ms a frame (worst {worst_ms:.1f}) in {what}"
    budget_ms = 1000.0 / wanted_fps if wanted_fps else 1000.0 / max(measured.fps, 1.0)
    if cost_ms <= BUDGET_OK * budget_ms:
        findings.append(Finding("ok", "pipeline", f"{text}, of {budget_ms:.0f} ms between frames"))
    else:
        advice = "frames will be dropped; use a smaller image, a lower fps or larger voxels"
        findings.append(Finding("warning", "pipeline", f"{text}, with {budget_ms:.0f} ms between frames: {advice}"))
    return iter(findings)


def _kernels(settled: Path, ready_s: float, *, compiled: bool) -> Finding:
    where = f"in {settled}"
    if any(part.startswith(PRIVATE) for part in settled.parts):
        return Finding(
            "warning", "kernels", f"compiled kernels are kept {where}, and lost at each boot; set CELLWATCH_JIT_CACHE"
        )
    how = "compiled just now, which the next start will not need" if compiled else "as compiled before"
    return Finding("ok", "kernels", f"ready in {ready_s:.1f} s, {how}; kept {where}")


def _pose(config: UnitConfig, info: CameraInfo, cell: Cell) -> Transform:
    """Return the camera's pose or, if it is not known, a pose above the cell that looks down."""
    if config.T_world_camera is not None:
        return config.T_world_camera.transform()
    if info.T_world_camera is not None:
        return info.T_world_camera
    middle = (cell.box_min_m + cell.box_max_m) / 2.0
    return look_at([middle[0], middle[1], cell.box_max_m[2] + 0.5], middle)
