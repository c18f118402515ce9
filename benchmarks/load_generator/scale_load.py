# SPDX-License-Identifier: Apache-2.0
"""An increasing number of units for one master, from a process of its own.

`python -m benchmarks.load_generator.scale_load PLAN RESULT` executes the `ScalePlan` in one file. For each step it
appends a line of JSON to the other file: `Step`, or `{"units", "refused"}` if the master takes no more units. The merge
times of the frames go to RESULT with the suffix `.UNITS-RATE.npz`.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.load_generator.load import Generator, Plan, map_is_right, register
from benchmarks.load_generator.traffic import VIEWS, SimpleUnit, View, address_of, captured_head, view
from shared.cell import Cell
from shared.clock import NS_PER_S, NS_PER_US, monotonic_ns
from shared.errors import CellwatchError, MasterRefused
from shared.settings import Settings

STRIDE = 11
"""Steps between two units that share the view of one camera."""


@dataclass(frozen=True)
class ScalePlan:
    """Plan: each of `units` at each of `rates_hz`, in this order. `pid` is the master's process."""

    url: str
    token_file: str
    cell: str
    units: tuple[int, ...]
    rates_hz: tuple[float, ...]
    voxels: int
    seconds: float
    warm_up_s: float
    pid: int


@dataclass(frozen=True)
class Step:
    """Figures of one step. A round trip counts from the moment at which the update fell due."""

    units: int
    rate_hz: float
    begin_ns: int
    end_ns: int
    sent: int
    lost: int
    per_s: float
    p50_ms: float
    p99_ms: float
    in_master_p50_us: float
    in_master_p99_us: float
    bytes_per_update: float
    master_cpu_percent: float
    master_waited_percent: float
    load_cpu_percent: float
    map_wrong: str
    trouble: str


@dataclass(eq=False)
class LoggingUnit(SimpleUnit):
    """A unit that records three times of each update: frame taken, received by the master, answered by the master."""

    merged: list[tuple[int, int, int]] = field(default_factory=list)
    _captured_at_ns: int = 0

    def request(self, captured_at_ns: int, now_ns: int) -> tuple[bytes, int]:
        """See `SimpleUnit`."""
        self._captured_at_ns = captured_at_ns
        return super().request(captured_at_ns, now_ns)

    def take(self, body: bytes, now_ns: int) -> None:
        """See `SimpleUnit`."""
        super().take(body, now_ns)
        assert self.exchange is not None
        self.merged.append((self._captured_at_ns, self.exchange.received_ns, self.exchange.answered_ns))


def steps(plan: ScalePlan, result: Path) -> Iterator[dict[str, Any]]:
    """Execute one step after the other.

    Raises:
        CellwatchError: the master cannot be reached.
    """
    token = Path(plan.token_file).read_text(encoding="ascii").strip()
    views = {rate_hz: _views(plan, rate_hz) for rate_hz in plan.rates_hz}
    head = asyncio.run(captured_head(plan.url, token))
    for count in plan.units:
        try:
            units = asyncio.run(_registered(plan, token, head, count))
        except MasterRefused as refusal:
            yield {"units": count, "refused": str(refusal)}
            return
        for rate_hz in plan.rates_hz:
            for number, unit in enumerate(units):
                unit.view = views[rate_hz][number % VIEWS]
                unit.step = STRIDE * number % len(unit.view.keys)
                unit.merged.clear()
            yield asdict(_step(plan, token, units, rate_hz))
            merged = [(number, *row) for number, unit in enumerate(units) for row in unit.merged]
            np.savez(f"{result}.{count}-{rate_hz:g}.npz", merged=np.array(merged, np.int64))


def _step(plan: ScalePlan, token: str, units: list[LoggingUnit], rate_hz: float) -> Step:
    load = Plan(
        plan.url, plan.token_file, plan.cell, len(units), plan.voxels, plan.seconds, plan.warm_up_s, rate_hz, plan.pid
    )
    own = psutil.Process()
    with closing(Generator(load, list(units))) as generator:
        waited_ns, before_s, began_ns = _waited_ns(plan.pid), sum(own.cpu_times()[:2]), monotonic_ns()
        tally = generator.run()
        cpu_s, ended_ns = sum(own.cpu_times()[:2]) - before_s, monotonic_ns()
        waited_ns = _waited_ns(plan.pid) - waited_ns
        begin_ns = began_ns + round(plan.warm_up_s * NS_PER_S)
        in_master_us = [
            (answered_ns - received_ns) / NS_PER_US
            for unit in units
            for _, received_ns, answered_ns in unit.merged
            if received_ns >= begin_ns
        ] or [np.nan]
        generator.send_all()
        wrong = map_is_right(load, token, list(units))
    trips_ms = tally.trips_ms or [np.nan]
    return Step(
        units=len(units),
        rate_hz=rate_hz,
        begin_ns=begin_ns,
        end_ns=begin_ns + round(plan.seconds * NS_PER_S),
        sent=tally.sent,
        lost=tally.lost,
        per_s=tally.counted / plan.seconds,
        p50_ms=float(np.percentile(trips_ms, 50)),
        p99_ms=float(np.percentile(trips_ms, 99)),
        in_master_p50_us=float(np.percentile(in_master_us, 50)),
        in_master_p99_us=float(np.percentile(in_master_us, 99)),
        bytes_per_update=(tally.bytes_out + tally.bytes_in) / max(tally.counted, 1),
        master_cpu_percent=tally.cpu_percent,
        master_waited_percent=100.0 * waited_ns / (ended_ns - began_ns),
        load_cpu_percent=100.0 * cpu_s * NS_PER_S / (ended_ns - began_ns),
        map_wrong=wrong,
        trouble=tally.trouble,
    )


def _waited_ns(pid: int) -> int:
    """Return the total time in ns for which the main thread was ready to run but had no core."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])


def _views(plan: ScalePlan, rate_hz: float) -> list[View]:
    cell, settings = Cell.load(Path(plan.cell)), Settings()
    lattice, blocks = cell.lattice(settings.voxel_size_m), cell.lattice(settings.seen_block_size_m)
    return [view(n, plan.voxels, lattice, blocks, rate_hz) for n in range(min(max(plan.units), VIEWS))]


async def _registered(plan: ScalePlan, token: str, head: bytes, count: int) -> list[LoggingUnit]:
    nothing = View((b"",), (), ())
    units = [LoggingUnit(address_of(number), nothing, 0, head) for number in range(count)]
    for unit in units:
        await register(unit, plan.url, token)
    return units


def main() -> int:
    """Run once."""
    plan, result = Path(sys.argv[1]), Path(sys.argv[2])
    fields = json.loads(plan.read_text())
    fields |= {name: tuple(fields[name]) for name in ("units", "rates_hz")}
    try:
        with result.open("a", buffering=1) as file:
            for step in steps(ScalePlan(**fields), result):
                file.write(json.dumps(step) + "\n")
    except (CellwatchError, OSError) as error:
        print(f"load: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
