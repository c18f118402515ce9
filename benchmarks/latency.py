# SPDX-License-Identifier: Apache-2.0
"""`make bench-latency`: measure the time from the capture of a frame to the map at a robot, stage by stage.

Four real units, a master, the robot's controller and two robots that read the map run on this machine and share one
clock. The cameras play frames that were rendered beforehand (`benchmarks.latency_probe.frames`), so neither a renderer
nor a disk takes time from the measurement. The exposure and transfer of a real camera are not included. The command
prints the tables and, at the end, all figures as one line of JSON. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.latency_probe.frames import FRAMES, PERIOD_S, RING_HZ, prepare
from benchmarks.load_generator.map_readers import ASKING, BEGUN, LISTENING, Reading, read
from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from benchmarks.sweeps import runner
from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from edge_unit.monitoring import TraceRecord, read_trace
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, UplinkError
from simulation.fleet.fleet import FIRST_ADDRESS, MASTER_PREFIX
from simulation.fleet.processes import Child, Processes, until_written
from simulation.fleet.running_master import start_master
from simulation.world.world import DEMO_CELL

UNITS = 4
SIZES = ((424, 240), (848, 480))
RATES_HZ = (15.0, 30.0)
SECONDS, SETTLE_S = 8.0, 2.0

POLL_S = 0.02
"""Period of a planner that polls 50 times a second."""

START_S = 60.0
"""Time limit for all units to be live on a busy machine."""

POLL_S = 0.05

FULL_HZ = 30.0
P99_MS_MAX = 1000.0 / FULL_HZ
"""A frame must be at the robot before the next one is taken."""

TAIL_S = 0.5
"""Time at the end of each run that does not count: readers may not have received its frames."""

STAGES: Mapping[str, str] = {
    "source": "the frame comes to the unit (here: a timer)",
    "joints": "the robot's joints of its moment are waited for",
    "thread": "its turn in the working thread",
    "robot": "the robot is drawn where it stood",
    "filter": "filter and voxelise, one pass",
    "density": "27-neighbourhoods",
    "seen": "blocks seen",
    "health": "fit with what is known, and of the pose now and then",
    "check": "what else the pipeline does",
    "report": "learning, refining, keys",
    "queue": "until it is its turn to be sent",
    "transfer": "encoded, sent, received whole by the master",
    "merge": "decoded, merged, answered",
}
TO_MERGED = "capture to merged"
WHOLE = {LISTENING: "capture to a listening robot", ASKING: "capture to an asking robot"}
READS: Mapping[str, tuple[str, str, str]] = {
    LISTENING: ("until the next message is made", "made, sent, received", "decoded at the robot"),
    ASKING: ("until the robot asks (every 20 ms)", "answer made, sent, received", "decoded at the robot"),
}


@dataclass(frozen=True)
class Case:
    """One resolution at one rate."""

    size: tuple[int, int]
    rate_hz: float

    def __str__(self) -> str:
        return "{}x{}, {:g}/s".format(*self.size, self.rate_hz)


@dataclass(frozen=True)
class Timed:
    """Figures of one case: milliseconds of each frame by stage, and the number of frames that were lost."""

    case: Case
    ms: dict[str, NDArray[np.float64]]
    frames: int
    dropped: int


def timed(case: Case, records: Sequence[TraceRecord], readings: Mapping[str, Sequence[Reading]]) -> Timed:
    """Combine the units' traces of their frames with the robots' records of their maps."""
    sent = [record for record in records if record.sent and record.stages_ns]
    rows = [_stages_ns(record) for record in sent]
    ms: dict[str, NDArray[np.float64]] = {
        name: np.array([row[name] for row in rows], np.float64) / NS_PER_MS for name in (*STAGES, TO_MERGED)
    }
    captured_ns = np.array([record.captured_at_ns for record in sent], np.int64)
    merged_ns = np.array([record.merged_at_ns for record in sent], np.int64)
    for reader, names in READS.items():
        read = sorted(readings[reader], key=lambda reading: reading.made_ns)
        made_ns = np.array([reading.made_ns for reading in read], np.int64)
        place = np.searchsorted(made_ns, merged_ns)
        in_time = place < len(read)
        first = [read[index] for index in place[in_time]]
        had_ns = np.array([reading.had_ns for reading in first], np.int64)
        decoded_ns = np.array([reading.decoded_ns for reading in first], np.int64)
        made_ns = made_ns[place[in_time]]
        for name, took_ns in zip(
            names, (made_ns - merged_ns[in_time], had_ns - made_ns, decoded_ns - had_ns), strict=True
        ):
            ms[f"{reader}: {name}"] = took_ns / NS_PER_MS
        ms[WHOLE[reader]] = (decoded_ns - captured_ns[in_time]) / NS_PER_MS
    return Timed(case, ms, len(sent), len(records) - len(sent))


def _stages_ns(record: TraceRecord) -> dict[str, int]:
    assert record.sent_at_ns is not None
    assert record.received_at_ns is not None
    assert record.merged_at_ns is not None
    stages = record.stages_ns
    return stages | {
        "queue": record.sent_at_ns - record.captured_at_ns - sum(stages.values()),
        "transfer": record.received_at_ns - record.sent_at_ns,
        "merge": record.merged_at_ns - record.received_at_ns,
        TO_MERGED: record.merged_at_ns - record.captured_at_ns,
    }


class Bench:
    """Starts the processes of one case, anew for each."""

    def __init__(self, processes: Processes, folder: Path, seconds: float) -> None:
        self._processes, self._folder, self._seconds = processes, folder, seconds
        self._count = 0

    async def run(self, case: Case, rings: Sequence[Path]) -> Timed:
        """Run one case from the first process to the last.

        Raises:
            CellwatchError: a process did not start, or ended too early.
        """
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        result = folder / "read"
        running = await start_master(
            self._processes, DEMO_CELL, folder / "master", "--public-reads", "--log-level", "WARNING",
            name=f"{self._count}-master", ready_s=START_S,
        )  # fmt: skip
        master, url, operator = running.child, running.url, str(running.operator_token_file)
        epoch_ns = monotonic_ns()
        robot = await self._start(
            "robot", "simulation.fleet.controller",
            *("--url", url, "--token-file", operator, "--epoch-ns", str(epoch_ns)),
        )  # fmt: skip
        traces, units = [], []
        for camera, ring in enumerate(rings):
            state = folder / f"unit{camera + 1}"
            state.mkdir()
            width, height = case.size
            source = SimulatedSourceConfig(
                camera=camera, cameras=len(rings), width=width, height=height, fps=case.rate_hz, epoch_ns=epoch_ns,
            )  # fmt: skip
            traces.append(state / "trace")
            document = {
                "source": source.model_dump(mode="json"),
                "master_url": url,
                "token_file": str(running.unit_token_file),
                "state_dir": str(state),
                "source_address": str(FIRST_ADDRESS + camera),
                "trace_path": str(traces[-1]),
            }
            config = state / "unit.yaml"
            config.write_text(yaml.safe_dump(document))
            units.append(
                await self._start(f"unit{camera + 1}", "benchmarks.latency_probe.unit", str(config), str(ring))
            )
        await self._all_live(url, (master, robot, *units))
        await asyncio.sleep(SETTLE_S)
        readers = await self._start(
            "readers", "benchmarks.load_generator.map_readers", url, operator, str(POLL_S), str(result)
        )
        await until_written(readers, result.with_suffix(BEGUN), START_S)
        began_ns = monotonic_ns()
        await asyncio.sleep(self._seconds + TAIL_S)
        end_ns = monotonic_ns() - round(TAIL_S * NS_PER_S)
        readers.may_end = True
        readers.process.terminate()
        await readers.process.wait()
        if failed := [child for child in (master, robot, *units) if child.failed]:
            raise UplinkError(f"{failed[0].name} failed: {failed[0].ended}; {failed[0].log_tail()}")
        await self._processes.stop(*units, robot, master)
        readings = read(result)
        records = [
            record for trace in traces for record in read_trace(trace) if began_ns <= record.captured_at_ns < end_ns
        ]
        return timed(case, records, readings)

    async def _start(self, name: str, module: str, *arguments: str) -> Child:
        return await self._processes.start(f"{self._count}-{name}", module, *arguments)

    async def _all_live(self, url: str, children: Sequence[Child]) -> None:
        async with httpx.AsyncClient(base_url=url, trust_env=False) as client:
            deadline_ns = monotonic_ns() + round(START_S * NS_PER_S)
            while True:
                rows = (await client.get("/units")).raise_for_status().json()
                if len(rows) == UNITS and all(row["state"] == "live" for row in rows):
                    return
                if ended := next((child for child in children if child.ended), None):
                    raise UplinkError(f"{ended.name}: {ended.ended}; {ended.log_tail()}")
                if monotonic_ns() > deadline_ns:
                    told = [(row["ip"], row["state"], row["reason"]) for row in rows]
                    raise UplinkError(f"not ready within {START_S:g} s: {told}")
                await asyncio.sleep(POLL_S)


async def measure(
    cases: Sequence[Case], rings: Mapping[tuple[int, int], Sequence[Path]], folder: Path, seconds: float
) -> list[Timed]:
    """Run one case after the other."""
    async with Processes(folder / "logs", without=(UNIT_PREFIX, MASTER_PREFIX)) as processes:
        bench = Bench(processes, folder, seconds)
        return [await bench.run(case, rings[case.size]) for case in cases]


def _mark(each: Timed) -> Mark:
    def p99_ms(name: str) -> float:
        return float(np.percentile(each.ms[name], 99))

    reads = ", ".join(f"{name} {p99_ms(f'{LISTENING}: {name}'):.1f}" for name in READS[LISTENING])
    return Mark(
        f"{each.case}: {WHOLE[LISTENING]}, p99 ms",
        p99_ms(WHOLE[LISTENING]),
        P99_MS_MAX,
        why=f"{UNITS} units, the master, its robot and two readers share {os.cpu_count()} cores; p99 until merged "
        f"{p99_ms(TO_MERGED):.1f} ms, then: {reads}",
    )


def result(found: Sequence[Timed]) -> Result:
    """Return one row per stage, with the median and p99 of each case."""
    names = [*STAGES, TO_MERGED]
    for reader, reads in READS.items():
        names += [*(f"{reader}: {name}" for name in reads), WHOLE[reader]]
    columns = ("ms", *(f"{each.case} {share}" for each in found for share in ("p50", "p99")))
    rows: list[tuple[str | float, ...]] = []
    for name in names:
        cells = [
            float(np.percentile(each.ms[name], q)) if each.ms[name].size else np.nan for each in found for q in (50, 99)
        ]
        rows.append((STAGES.get(name, name), *cells))
    marks = [_mark(each) for each in found if each.case.rate_hz == FULL_HZ]
    told = ", ".join(f"{each.case} {each.frames} ({each.dropped} gave way to a newer one)" for each in found)
    remarks = (
        f"Frames that were merged: {told}.",
        f"Medians and p99 do not add up. Cameras play {FRAMES} frames of the demo cell (a person, the robot in its "
        f"period of {PERIOD_S:g} s) rendered beforehand; a frame counts from the moment at which it fell due.",
        "The stages up to the merge come from the units' own trace (trace_path), with the master's times"
        " converted by the unit's estimate of its clock. Later stages come from the robot's clock.",
    )
    return Result(f"Where the milliseconds go: {UNITS} units, one master", columns, tuple(rows), tuple(marks), remarks)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, and all of it as one line of JSON. Exit code 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    began_ns = monotonic_ns()
    cases = [Case(size, rate_hz) for size in options.sizes for rate_hz in options.rates]
    frames = min(FRAMES, options.frames)
    with tempfile.TemporaryDirectory(prefix="cellwatch-latency-") as scratch:
        folder = Path(scratch)
        rings = {size: [folder / "{}x{}-{}.npy".format(*size, n) for n in range(UNITS)] for size in options.sizes}
        jobs = [
            partial(prepare, path, camera, UNITS, size, frames)
            for size, paths in rings.items()
            for camera, path in enumerate(paths)
        ]
        with runner(2) as run:
            run(jobs)
        prepared_s = (monotonic_ns() - began_ns) / NS_PER_S
        try:
            found = asyncio.run(measure(cases, rings, folder, options.seconds))
        except CellwatchError as error:
            print(f"make bench-latency: {error}", file=sys.stderr)
            return 1
    told = result(found)
    print(told)
    document: dict[str, Any] = {
        "title": "From the capture of a frame to the map that a robot has",
        "units": UNITS,
        "ring_hz": RING_HZ,
        "cases": {
            str(each.case): {
                "frames": each.frames,
                "dropped": each.dropped,
                **{
                    name: {f"p{q}_ms": round(float(np.percentile(values, q)), 3) for q in (50, 99)}
                    for name, values in each.ms.items()
                    if values.size
                },
            }
            for each in found
        },
        "latency": told.document(),
        "passed": all(mark.met for mark in told.marks),
        "prepared_s": round(prepared_s, 1),
        "took_s": round((monotonic_ns() - began_ns) / NS_PER_S, 1),
    }
    write("latency", document, options.results)
    print(line(document))
    return 0 if document["passed"] else 1


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make bench-latency", description="Measure the time from a frame's capture to a robot's map."
    )
    parser.add_argument("--sizes", type=_size, nargs="+", default=SIZES, metavar="WxH", help="424x240 848x480")
    parser.add_argument("--rates", type=float, nargs="+", default=RATES_HZ, choices=RATES_HZ, help="frames/s (15 30)")
    parser.add_argument("--seconds", type=float, default=SECONDS, help=f"duration of each case ({SECONDS:g})")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"frames rendered for each camera ({FRAMES})")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for latency.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
