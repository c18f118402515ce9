# SPDX-License-Identifier: Apache-2.0
"""`make bench-scale`: one master with an increasing number of units up to its limit, and the age of a robot's map
meanwhile.

A real master on loopback has one core of this machine to itself. The units (each with an address of its own), the
robot's controller and two robots that read the map share another. Frames are 20 ms old when their update falls due, as
those of real cameras are. If the master refuses more units, a second master with a limit of as many units as a voxel
can have witnesses shows the limit of the machine. The command prints tables and, at the end, all figures as one line of
JSON. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.load_generator.map_readers import ASKING, BEGUN, LISTENING, Reading, read
from benchmarks.load_generator.merge_costs import MergeCost, merge_costs
from benchmarks.load_generator.scale_load import ScalePlan, Step
from benchmarks.load_generator.traffic import AGE_NS
from benchmarks.reporting.report import RESULTS, Curves, Mark, Result, line, write
from master_server.core.units import MAX_UNITS
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, UplinkError
from shared.settings import Settings
from simulation.fleet.fleet import MASTER_PREFIX
from simulation.fleet.processes import Processes, until_written
from simulation.fleet.running_master import READY_S, start_master
from simulation.world.world import DEMO_CELL

UNITS = (1, 2, 4, 8, 16, 32, 50, 64, 100, 200)
RATES_HZ = (15.0, 30.0)
VOXELS = 300
"""Voxels of a person at 50 mm, as one camera sees them."""

SECONDS, WARM_UP_S = 4.0, 1.0

POLL_S = 0.02
"""Period of a planner that polls 50 times a second."""

FULL_HZ, FULL_UNITS = 30.0, 50
"""Load of a large cell."""

AGE_MS_MAX = 100.0
"""Largest age of its oldest frame at a robot: 20 ms when it is sent, one period until the next, two reads."""


@dataclass(frozen=True)
class Ages:
    """Ages in ms of the youngest and the oldest frame of a map when a robot has it, and the number of maps."""

    maps: int
    youngest_p50: float
    oldest_p50: float
    oldest_p99: float


def ages(merged: NDArray[np.int64], readings: Sequence[Reading], begin_ns: int, end_ns: int) -> Ages:
    """Return the ages. `merged` (N, 4) has per update: its unit, and the times of capture, receipt by the master, and
    answer.
    """
    read = [reading for reading in readings if begin_ns <= reading.made_ns < end_ns]
    made_ns = np.array([reading.made_ns for reading in read], np.int64)
    newest_ns = np.empty((0, len(read)), np.int64)
    for unit in np.unique(merged[:, 0]):
        _, taken_ns, received_ns, _ = merged[merged[:, 0] == unit].T
        place = np.searchsorted(received_ns, made_ns) - 1
        newest_ns = np.vstack((newest_ns, taken_ns[np.maximum(place, 0)]))
    if not newest_ns.size:
        return Ages(0, float("nan"), float("nan"), float("nan"))
    had_ns = np.array([reading.decoded_ns for reading in read], np.int64)
    youngest_ms, oldest_ms = (had_ns - newest_ns.max(0)) / NS_PER_MS, (had_ns - newest_ns.min(0)) / NS_PER_MS
    return Ages(
        len(read), float(np.median(youngest_ms)), float(np.median(oldest_ms)), float(np.percentile(oldest_ms, 99))
    )


@dataclass(frozen=True)
class Row:
    """One step, and its effect on the readers."""

    step: Step
    polled: Ages
    streamed: Ages
    wide: bool

    @property
    def carried(self) -> bool:
        """Return True if all updates arrived, the map was right, and no view in it went stale."""
        oldest_ms = np.max((self.polled.oldest_p99, self.streamed.oldest_p99))
        return not (self.step.lost or self.step.map_wrong) and bool(oldest_ms < 1e3 * Settings().stale_after_s)


class Bench:
    """Starts masters, readers and loads, each on its own core."""

    def __init__(self, processes: Processes, folder: Path, options: argparse.Namespace) -> None:
        cores = sorted(os.sched_getaffinity(0))
        self._server_core, self._load_core = cores[-1], cores[0]
        self._processes, self._folder, self._options = processes, folder, options
        self._count = 0

    async def run(self, module: str, units: tuple[int, ...]) -> tuple[list[Row], dict[str, Any] | None]:
        """Run the steps with a new master, up to the number of units that it refuses. Return the rows and the refused
        step.

        Raises:
            CellwatchError: a process did not start, or ended too early.
        """
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        plan_file, result = folder / "plan.json", folder / "steps"
        os.sched_setaffinity(0, {self._server_core})
        master = await start_master(
            self._processes, DEMO_CELL, folder / "state", name=f"master-{self._count}", module=module
        )
        os.sched_setaffinity(0, {self._load_core})
        url, operator = master.url, str(master.operator_token_file)
        robot = await self._processes.start(
            f"robot-{self._count}", "simulation.fleet.controller", "--url", url, "--token-file", operator
        )
        readers = await self._processes.start(
            f"readers-{self._count}",
            "benchmarks.load_generator.map_readers",
            url,
            operator,
            str(POLL_S),
            str(folder / "read"),
        )
        await until_written(readers, folder / f"read{BEGUN}", READY_S)
        options = self._options
        plan = ScalePlan(
            url, str(master.unit_token_file), str(DEMO_CELL), units, options.rates, options.voxels, options.seconds,
            WARM_UP_S, master.pid,
        )  # fmt: skip
        plan_file.write_text(json.dumps(asdict(plan)))
        load = await self._processes.start(
            f"load-{self._count}", "benchmarks.load_generator.scale_load", str(plan_file), str(result), may_end=True
        )
        code = await load.process.wait()
        readers.may_end = True
        readers.process.terminate()
        await readers.process.wait()
        failed = [child for child in (master.child, robot) if child.failed] + ([load] if code else [])
        if failed:
            raise UplinkError(f"{failed[0].name} failed: {failed[0].ended}; {failed[0].log_tail()}")
        await self._processes.stop(master.child, robot)
        found = [json.loads(text) for text in result.read_text().splitlines()]
        readings = read(folder / "read")
        rows = []
        for step in (Step(**fields) for fields in found if "refused" not in fields):
            merged = np.load(f"{result}.{step.units}-{step.rate_hz:g}.npz")["merged"]
            polled, streamed = (
                ages(merged, readings[name], step.begin_ns, step.end_ns) for name in (ASKING, LISTENING)
            )
            rows.append(Row(step, polled, streamed, module != "master_server"))
        return rows, next((fields for fields in found if "refused" in fields), None)


async def measure(options: argparse.Namespace) -> tuple[list[Row], str]:
    """Return all steps, and the reason for which the unmodified master took no more units."""
    with tempfile.TemporaryDirectory(prefix="cellwatch-scale-") as scratch:
        folder = Path(scratch)
        async with Processes(folder / "logs", without=(MASTER_PREFIX,)) as processes:
            bench = Bench(processes, folder, options)
            rows, refused = await bench.run("master_server", options.units)
            if refused is None:
                return rows, ""
            beyond = tuple(count for count in options.units if count >= refused["units"])
            wide, _ = await bench.run("benchmarks.load_generator.wide_master", beyond)
            return rows + wide, f"{refused['units']} units: {refused['refused']}"


def load_result(rows: Sequence[Row], refused: str) -> Result:
    """Return the load on the units and on the machine."""
    columns = (
        "units", "each /s", "updates/s", "lost", "p50 ms", "p99 ms", "in master us", "p99 us", "bytes", "kB/s a unit",
        "CPU %", "CPU us", "waited %", "load CPU %", "map", "master",
    )  # fmt: skip
    table = []
    for row in rows:
        step = row.step
        table.append((
            step.units, step.rate_hz, step.per_s, step.lost, step.p50_ms, step.p99_ms, step.in_master_p50_us,
            step.in_master_p99_us, step.bytes_per_update, step.bytes_per_update * step.per_s / step.units / 1e3,
            step.master_cpu_percent, 1e4 * step.master_cpu_percent / max(step.per_s, 1.0), step.master_waited_percent,
            step.load_cpu_percent, "wrong" if step.map_wrong else "right", "unbounded" if row.wide else "as it is",
        ))  # fmt: skip
    remarks = [
        "p50, p99: round trip of an update, from when it fell due. in master: from its last byte to its answer.",
        "bytes: update and answer with all headers and the seen report. CPU: of the master's process, "
        "with readers and robot. waited: time for which the master was ready but had no core, because of"
        " other processes. load CPU: of the process that plays the units; near 100 this process is late,"
        " not the master.",
    ]
    if refused:
        remarks.append(f"It stops at {MAX_UNITS} units because it is told to: {refused}")
    fit = cpu_fit(rows)
    if fit is not None:
        remarks.append(
            f"The master's CPU is {fit[1]:.0f} % of a core for readers and robot, and {fit[0]:.0f} us an update: a "
            f"core is full at {1e4 * (100.0 - fit[1]) / fit[0]:.0f} updates a second."
        )
    for rate_hz in dict.fromkeys(row.step.rate_hz for row in rows):
        of_rate = [row for row in rows if row.step.rate_hz == rate_hz]
        failed = next((row for row in of_rate if not row.carried), None)
        most = max((row.step.units for row in of_rate if row.carried), default=0)
        bent = "and no size that was tried was too much" if failed is None else f"{failed.step.units} were too many"
        if failed is not None:
            step = failed.step
            bent += (
                f" (master's CPU {step.master_cpu_percent:.0f} %, {step.master_waited_percent:.0f} % of the time its "
                f"core was another's, load's CPU {step.load_cpu_percent:.0f} %; {step.lost} of {step.sent} updates "
                f"lost; {step.map_wrong or 'map right'})"
            )
        remarks.append(f"At {rate_hz:g}/s {most} units were carried, {bent}.")
    return Result("A master and more and more units", columns, tuple(table), remarks=tuple(remarks))


def age_result(rows: Sequence[Row]) -> Result:
    """Return the age of a robot's map."""
    columns = (
        "units", "each /s", "asked: maps", "youngest ms", "oldest ms", "oldest p99",
        "streamed: maps", "youngest ms ", "oldest ms ", "oldest p99 ",
    )  # fmt: skip
    table = [
        (row.step.units, row.step.rate_hz, *asdict(row.polled).values(), *asdict(row.streamed).values()) for row in rows
    ]
    remark = (
        f"ms from a frame's capture until a robot has the map decoded, {AGE_NS / NS_PER_MS:g} of them before it is "
        f"sent; medians and p99. Asked: GET /voxels every {1e3 * POLL_S:g} ms. Streamed: each message of WS /stream."
    )
    marks = []
    for row in rows:
        if (row.step.units, row.step.rate_hz) == (FULL_UNITS, FULL_HZ):
            name = f"{FULL_UNITS} units at {FULL_HZ:g}/s: oldest frame at a robot"
            marks.append(Mark(f"{name} that asks, p99 ms", row.polled.oldest_p99, at_most=AGE_MS_MAX))
            marks.append(Mark(f"{name} that listens, p99 ms", row.streamed.oldest_p99, at_most=AGE_MS_MAX))
    if any(row.step.units == MAX_UNITS for row in rows):
        full = [row for row in rows if row.step.units == MAX_UNITS]
        marks.append(
            Mark(
                f"rates at which {MAX_UNITS} units are carried, of {len(full)}",
                float(sum(row.carried for row in full)),
                at_least=float(len(full)),
            )
        )
    return Result("How old the map is at a robot", columns, tuple(table), tuple(marks), (remark,))


def cost_result(costs: Sequence[MergeCost]) -> Result:
    """Return the cost of the merge itself."""
    columns = ("units", "voxels of the map", "merge us", "union us", "answer us")
    remark = (
        "merge: one report replaces the one before. union: the keys of all after a change; answer: "
        "indices and witnesses as msgpack. Both are made once per message of the stream (at most 100 a "
        "second) or per GET, not per update."
    )
    rows = tuple(tuple(asdict(cost).values()) for cost in costs)
    return Result("The merge itself, in one process", columns, rows, remarks=(remark,))


def cpu_fit(rows: Sequence[Row]) -> tuple[float, float] | None:
    """Fit microseconds per update and a constant percentage, over the steps in which the CPU was not full."""
    points = [(row.step.per_s, row.step.master_cpu_percent) for row in rows if row.step.master_cpu_percent < 90.0]
    if len(set(points)) < 3:
        return None
    per_s, percent = np.array(points).T
    slope, beside = np.polyfit(per_s, percent, 1)
    return 1e4 * float(slope), float(beside)


def curves(rows: Sequence[Row]) -> list[Curves]:
    """Return round trips, ages and CPU over the number of units."""

    def over(values: dict[str, Any]) -> dict[str, list[tuple[float, float]]]:
        return {
            f"{name}, {rate_hz:g}/s": [(float(r.step.units), of(r)) for r in rows if r.step.rate_hz == rate_hz]
            for name, of in values.items()
            for rate_hz in dict.fromkeys(row.step.rate_hz for row in rows)
        }

    trips = {"p50": lambda row: row.step.p50_ms, "p99": lambda row: row.step.p99_ms}
    oldest = {"GET p99": lambda row: row.polled.oldest_p99, "stream p99": lambda row: row.streamed.oldest_p99}
    cpu = {"master": lambda row: row.step.master_cpu_percent, "load": lambda row: row.step.load_cpu_percent}
    return [
        Curves("Round trip of an update", "units", "ms", over(trips), "xy"),
        Curves("Oldest frame in the map at a robot", "units", "ms", over(oldest), "xy"),
        Curves("CPU of one core", "units", "%", over(cpu), "x"),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, and all of it as one line of JSON. Exit code 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    began_ns = monotonic_ns()
    try:
        rows, refused = asyncio.run(measure(options))
    except CellwatchError as error:
        print(f"make bench-scale: {error}", file=sys.stderr)
        return 1
    results = {
        "load": load_result(rows, refused),
        "map_age": age_result(rows),
        "merge": cost_result(list(merge_costs(options.units, options.voxels))),
    }
    print("\n\n".join(map(str, results.values())))
    fit = cpu_fit(rows)
    marks = [mark for result in results.values() for mark in result.marks]
    document = {
        "title": "One master and more and more units",
        "voxels": options.voxels,
        "seconds_each": options.seconds,
        "bound_units": MAX_UNITS,
        "cpu_us_per_update": None if fit is None else round(fit[0], 1),
        "cpu_percent_beside": None if fit is None else round(fit[1], 1),
        "units_carried": {
            f"{rate_hz:g}": max((r.step.units for r in rows if r.carried and r.step.rate_hz == rate_hz), default=0)
            for rate_hz in options.rates
        },
        **{name: result.document() for name, result in results.items()},
        "curves": [each.document() for each in curves(rows)],
        "passed": all(mark.met for mark in marks),
        "took_s": round((monotonic_ns() - began_ns) / NS_PER_S, 1),
    }
    write("scale", document, options.results)
    print(line(document))
    return 0 if document["passed"] else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make bench-scale", description="Load one master with an increasing number of units."
    )
    parser.add_argument("--units", type=int, nargs="+", default=UNITS, help=" ".join(map(str, UNITS)))
    parser.add_argument("--rates", type=float, nargs="+", default=RATES_HZ, help="updates/s of each unit (15 30)")
    parser.add_argument("--voxels", type=int, default=VOXELS, help=f"voxels of each update ({VOXELS})")
    parser.add_argument("--seconds", type=float, default=SECONDS, help=f"duration of each step ({SECONDS:g})")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for scale.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
