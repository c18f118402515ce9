# SPDX-License-Identifier: Apache-2.0
"""The demo: a fleet with a live table, and a comparison of its reports with the ground truth."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import msgpack

from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, ConfigError
from shared.messages import UnitRow
from shared.settings import FilterSettings
from shared.wire import MEDIA_TYPE
from simulation.cameras.camera import D435I_FOCAL_PX, MAX_RIG
from simulation.demo.table import MapLine, Screen, UnitLine
from simulation.fleet.evaluation import evaluate
from simulation.fleet.fleet import QUIET_S, Fleet, FleetOptions, FleetUnit
from simulation.fleet.power import PowerSwitch
from simulation.fleet.processes import STOP_SIGNALS, raise_when_stopped
from simulation.world.world import MAX_DEMO_PEOPLE

START_S = 120.0
"""Timeout for all units to be live, on a slow and busy machine, without the time for compilation."""

SETTLE_S = 2.0
"""Delay between the moment when all units are live and the first frame that counts."""

DRAIN_S = 0.3
"""Delay after the last frame that counts, until it is merged."""

REFRESH_S = 0.5
"""Period of the table. It requests the list of unseen blocks, which is long."""

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
"""Variables of which one is set if a browser can open."""

RESOLUTIONS = ", ".join(f"{width}x{height}" for width, height in D435I_FOCAL_PX)

FRAME_RATE_SHARE_MIN = 14.0 / 15.0
CAPTURE_TO_MAP_MS_MAX = 66.0
FALSE_FRAME_FRACTION_MAX = 0.005
MISSED_FRACTION_MAX = 0.02
"""Marks that a quiet machine with two cores meets."""


@dataclass
class Outcome:
    """Outcome of a run: the period whose frames count, once known; whether a person stopped it; failures."""

    begin_ns: int | None = None
    end_ns: int | None = None
    stopped: bool = False
    failures: list[str] = field(default_factory=list)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; exit code 1 if something failed.

    Raises:
        KeyboardInterrupt: a person stopped it before its end.
    """
    options = _parse(arguments)
    screen = Screen(sys.stderr if options.json else sys.stdout)
    try:
        with _folder(options.folder) as folder:
            fleet = Fleet(_fleet_options(options), folder)
            outcome = asyncio.run(_run(fleet, options.seconds, screen, not options.no_browser and not options.json))
            # The event loop removed its handlers when it closed.
            raise_when_stopped()
            screen.leave()
            for failure in outcome.failures:
                screen.say(f"demo: {failure}")
            if outcome.stopped and options.seconds is not None:
                raise KeyboardInterrupt
            figures = _figures(fleet, options.seconds, outcome, screen)
    except CellwatchError as error:
        screen.say(f"demo: {error}")
        return 1
    if options.json:
        print(json.dumps(figures), flush=True)
    elif options.seconds is not None:
        for name, value in figures.items():
            screen.say(f"{name:<26}{value}")
    return 1 if outcome.failures else 0


async def _run(fleet: Fleet, seconds: float | None, screen: Screen, may_open: bool) -> Outcome:
    """Start everything, show it until its end or a stop, then stop everything."""
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None

    def stop() -> None:
        for number in STOP_SIGNALS:
            # A second signal must not interrupt the stop.
            loop.add_signal_handler(number, int)
        task.cancel()

    for number in STOP_SIGNALS:
        loop.add_signal_handler(number, stop)
    outcome = Outcome()
    try:
        async with fleet.processes, PowerSwitch(fleet.switch_power) as power:
            await _start(fleet, screen, power, may_open)
            await _watch(fleet, seconds, screen, outcome)
    except asyncio.CancelledError:
        outcome.stopped = True
    outcome.failures += [
        f"{child.name} ended by itself, {child.ended}; {child.log_tail()}" for child in fleet.processes if child.failed
    ]
    return outcome


async def _start(fleet: Fleet, screen: Screen, power: PowerSwitch, may_open: bool) -> None:
    """Start the fleet; print the address first, and then the link to the viewer."""
    await fleet.start_master(power.actions)
    screen.say(f"Cellwatch demo: {fleet.url} (try: curl {fleet.url}/voxels; Ctrl-C stops)")
    if link := await fleet.viewer_link():
        screen.say(f"watch it in a browser: {link} (works once)")
        if may_open and any(os.environ.get(name) for name in DISPLAYS):
            await asyncio.to_thread(webbrowser.open, link)
    warm_up = await fleet.start_warm_up()
    try:
        await asyncio.wait((warm_up,), timeout=QUIET_S)
        if not warm_up.done():
            screen.say("compiling kernels (only the first time, about a minute) ...")
        await warm_up
    finally:
        warm_up.cancel()
    await fleet.start_units()


async def _watch(fleet: Fleet, seconds: float | None, screen: Screen, outcome: Outcome) -> None:
    """Show the state until the end of the frames that count, or for ever if there is none."""
    started_ns = monotonic_ns()
    async with _Observer(fleet) as observer:
        while not fleet.master.failed:
            lines, merged = await observer.look()
            now_ns = monotonic_ns()
            screen.show(lines, merged, now_ns)
            if seconds is not None and outcome.begin_ns is None:
                waiting = [line for line in lines if line.state != "live"]
                if not waiting:
                    outcome.begin_ns = now_ns + round(SETTLE_S * NS_PER_S)
                    outcome.end_ns = outcome.begin_ns + round(seconds * NS_PER_S)
                elif any(child.failed for child in fleet.processes):
                    return
                elif now_ns - started_ns > START_S * NS_PER_S:
                    outcome.failures += [f"{line.name} is {line.state}: {line.reason}" for line in waiting]
                    return
            if outcome.end_ns is not None and now_ns > outcome.end_ns + DRAIN_S * NS_PER_S:
                return
            await asyncio.sleep(REFRESH_S)


class _Observer:
    """Poll the master over its public interface."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._client = httpx.AsyncClient(base_url=fleet.url, headers={"Accept": MEDIA_TYPE}, trust_env=False)

    async def __aenter__(self) -> _Observer:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._client.aclose()

    async def look(self) -> tuple[list[UnitLine], MapLine | None]:
        """Return all units and the merged map; without figures if the master does not answer."""
        rows: dict[str, UnitRow] = {}
        try:
            rows = {row.ip: row for row in map(UnitRow.model_validate, await self._get("/units"))}
            voxels = await self._get("/voxels?form=keys&unseen=true")
            merged = _map_line(voxels)
        except httpx.HTTPError:
            # No answer means that nothing is known; a master that has failed ends the demo.
            merged = None
        return [_line(unit, rows.get(unit.address)) for unit in self._fleet.units], merged

    async def _get(self, path: str) -> Any:
        answer = await self._client.get(path)
        return msgpack.unpackb(answer.raise_for_status().content)


def _line(unit: FleetUnit, row: UnitRow | None) -> UnitLine:
    if unit.child.ended:
        return UnitLine(unit.name, unit.address, "dead", reason=unit.child.ended)
    if row is None:
        return UnitLine(unit.name, unit.address, "starting")
    return UnitLine(unit.name, unit.address, row.state, row.fps, row.voxels, row.process_ms, row.age_s, row.reason)


def _map_line(voxels: dict[str, Any]) -> MapLine:
    nx, ny, nz = voxels["unseen"]["shape"]
    return MapLine(
        len(voxels["voxels"]),
        1.0 - len(voxels["unseen"]["blocks"]) / (nx * ny * nz),
        voxels["complete"],
        tuple(voxels["reasons"]),
    )


def _figures(fleet: Fleet, seconds: float | None, outcome: Outcome, screen: Screen) -> dict[str, Any]:
    """Return the figures printed at the end of a run of limited time."""
    options = fleet.options
    figures: dict[str, Any] = {
        "units": options.units,
        "people": options.people,
        "resolution": f"{options.width}x{options.height}",
        "voxel_size_m": options.voxel_size_m,
        "seconds": seconds,
    }
    if outcome.begin_ns is not None and outcome.end_ns is not None:
        screen.say("holding what was reported against what was there ...")
        settings = FilterSettings(voxel_size_m=options.voxel_size_m)
        runs = [unit.run for unit in fleet.units]
        figures |= evaluate(runs, settings, outcome.begin_ns, outcome.end_ns)
        figures["marks_missed"] = _marks_missed(figures, options.fps)
    figures["failures"] = [failure.splitlines()[0] for failure in outcome.failures]
    return figures


def _marks_missed(figures: dict[str, Any], fps: float) -> list[str]:
    kept = {
        "fps_per_unit": min(figures["fps_per_unit"]) >= FRAME_RATE_SHARE_MIN * fps,
        "capture_to_map_ms_p99": figures["capture_to_map_ms_p99"] <= CAPTURE_TO_MAP_MS_MAX,
        "frames_with_false_voxels": figures["false_frame_fraction"] <= FALSE_FRAME_FRACTION_MAX,
        "missed_fraction": (figures["missed_fraction"] or 0.0) <= MISSED_FRACTION_MAX,
    }
    return [name for name, is_kept in kept.items() if not is_kept]


@contextmanager
def _folder(wanted: Path | None) -> Iterator[Path]:
    """Create the folder for all files: `wanted`, which stays, or else a temporary one."""
    if wanted is None:
        with tempfile.TemporaryDirectory(prefix="cellwatch-demo-") as folder:
            yield Path(folder)
        return
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        if any(wanted.iterdir()):
            raise ConfigError(f"--folder {wanted}: expected an empty folder or a new one, got one with files")
    except OSError as error:
        raise ConfigError(f"--folder {wanted}: {error.strerror}") from error
    yield wanted.resolve()


def _fleet_options(options: argparse.Namespace) -> FleetOptions:
    width, height = options.resolution
    return FleetOptions(
        units=options.units,
        people=options.people,
        seed=options.seed,
        fps=options.fps,
        width=width,
        height=height,
        voxel_size_m=options.voxel_size,
        port=options.port,
        recorded=options.seconds is not None,
    )


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="make demo",
        description="A simulated cell: a master, units with a depth camera each and a robot's controller run as real "
        "processes on this machine; a UR3e moves over a table, and people walk beside it.",
        epilog='Pass options in ARGS: make demo ARGS="--seconds 20 --json". With --seconds, the reports are compared '
        "with the ground truth. frames_with_false_voxels: frames with a voxel farther than one voxel from all "
        "unknown objects. missed_fraction: of the people's voxels that a camera sees outside "
        "the margins of known surfaces, the share absent from the merged map with all their neighbours; "
        "missed_fraction_strict: the share absent themselves. margin_fraction: the share inside the margins.",
    )
    add = parser.add_argument
    add(
        "--seconds",
        type=_number(1.0, 600.0),
        metavar="S",
        help="count the frames of S seconds, then stop and print the figures (default: run until stopped)",
    )
    add(
        "--json",
        action="store_true",
        help="print the figures as one line of JSON, and all else on stderr (needs --seconds)",
    )
    add("--no-browser", action="store_true", help="do not open a browser")
    add("--units", type=_count(1, MAX_RIG), default=4, metavar="N", help="cameras, each with a unit (default: 4)")
    add(
        "--people",
        type=_count(0, MAX_DEMO_PEOPLE),
        default=1,
        metavar="N",
        help="number of walking people (default: 1)",
    )
    add(
        "--resolution",
        type=_resolution,
        default=(424, 240),
        metavar="WxH",
        help=f"resolution of the cameras: {RESOLUTIONS} (default: 424x240)",
    )
    add("--fps", type=_number(1.0, 90.0), default=15.0, metavar="F", help="frame rate of the cameras (default: 15)")
    add(
        "--voxel-size",
        type=_number(0.01, 0.10),
        default=0.05,
        metavar="M",
        help="edge of a voxel in metres (default: 0.05)",
    )
    add(
        "--seed",
        type=_count(0, 0xFFFF),
        default=0,
        metavar="N",
        help="seed of people's motion and of noise (default: 0)",
    )
    add("--port", type=_count(0, 65535), default=0, metavar="P", help="port of the master (default: a free one)")
    add("--folder", type=Path, metavar="DIR", help="keep configurations, logs and records there (default: deleted)")
    options = parser.parse_args(arguments)
    if options.json and options.seconds is None:
        parser.error("--json: expected --seconds too, since the figures are of a limited time")
    return options


def _number(low: float, high: float) -> Callable[[str], float]:
    """Return a parser of numbers from `low` to `high`."""

    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {low:g} to {high:g}, got {text}")
        return value

    return number


def _count(low: int, high: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from `low` to `high`."""

    def count(text: str) -> int:
        value = int(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {low} to {high}, got {text}")
        return value

    return count


def _resolution(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and (int(width), int(height)) in D435I_FOCAL_PX):
        raise argparse.ArgumentTypeError(f"expected one of {RESOLUTIONS}, got {text}")
    return int(width), int(height)
