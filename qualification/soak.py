# SPDX-License-Identifier: Apache-2.0
"""`make soak`: run a cell of real processes with random failures for a chosen time.

The cell has a master, two units with known camera images, a robot's controller, and two observers that read the map all
the time. Faults are drawn from a seed that is printed: processes are killed, stopped and started, cameras unplugged,
the cable of a unit pulled, wall clocks stepped, settings changed, the stream read by many and by some that never take a
message. After each round the faults end. The map must then equal the map before the first fault, and memory, threads
and handles of each process are counted. In between, no answer may be wrong. The command prints tables and, at the end,
all figures as one line of JSON. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import shutil
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from qualification.fault_site.site import START_S, FaultError
from qualification.fault_site.watch import SETTLED_S
from qualification.networks import confine
from qualification.soak_site.schedule import Strike, schedule
from qualification.soak_site.site import KINDS, SoakSite
from qualification.soak_site.usage import (
    CALM_LOOKS,
    GROWTH_MIB_MAX,
    GROWTH_SHARE_MAX,
    LIFETIME_MIN_S,
    SPARE,
    Lifetime,
    Usage,
)
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError
from simulation.fleet.fleet import MASTER_PREFIX
from simulation.fleet.processes import Processes

MINUTES = 30.0

ROUND_S = 50.0

EARLY_SHARE = 1.0 / 3.0
"""Share of the early rounds. In the later rounds no long-lived process is killed."""

CALM_S = 30.0
"""Time limit from the end of the last fault to a right map: the unit searches for cameras every 5 s, on a busy machine.
"""

QUIET_S = 2.0
"""Time for old connections to close before handles are counted."""

LOOK_S = 0.1

JUDGE_S = 1.0

EVENTS = "events.log"
"""Log of events; its times are the master's `now_ns`."""

SHOWN = 10
"""Number of wrong answers that are printed."""


@dataclass
class Calm:
    """State at the end of a round; `trouble` is empty if all is right."""

    at_s: float
    recovered_s: float
    trouble: str


@dataclass
class Found:
    """All results of a soak."""

    strikes: list[Strike] = field(default_factory=list)
    calms: list[Calm] = field(default_factory=list)
    lifetimes: Sequence[Lifetime] = ()
    judged: int = 0
    wrongs: list[str] = field(default_factory=list)
    ended: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)


class Soak:
    """A site, and its rounds."""

    def __init__(self, site: SoakSite, seed: int, seconds: float) -> None:
        self._site, self._seed, self._seconds = site, seed, seconds
        self._usage = Usage(site.running)
        self._began_ns = monotonic_ns()
        self._map: tuple[Any, ...] | None = None
        self.found = Found()

    async def run(self) -> Found:
        """Run all rounds.

        Raises:
            FaultError: the cell was not right at the start.
        """
        site, found = self._site, self.found
        try:
            await site.start()
            if trouble := (await self._calm(START_S)).trouble:
                raise FaultError(f"before the first fault: {trouble}")
            found.calms.clear()
            # Before both units were registered, a map without one of them was complete.
            site.begin_judging()
            rounds = max(round(self._seconds / ROUND_S), 2)
            async with _Beside(self._usage.run(), self._judge()):
                for number in range(rounds):
                    early = number < EARLY_SHARE * rounds
                    strikes = schedule(KINDS, f"{self._seed}, round {number}", self._seconds / rounds, early)
                    await self._round(strikes, number)
                    calm = await self._calm(CALM_S)
                    told = calm.trouble or f"right again after {calm.recovered_s:.1f} s"
                    print(
                        f"  round {number + 1} of {rounds}: {len(strikes)} faults, {told}", file=sys.stderr, flush=True
                    )
            site.judge_all()
        finally:
            await site.stop_observers()
            site.close()
        found.lifetimes = self._usage.lifetimes
        found.judged, found.wrongs, found.ended = site.judged, site.wrongs, site.ended
        found.tracebacks = [
            f"{log.name}: {text.strip().splitlines()[-1]}"
            for log in sorted((site.folder / "logs").iterdir())
            if "Traceback" in (text := log.read_text(errors="replace"))
        ]
        return found

    async def _round(self, strikes: Sequence[Strike], number: int) -> None:
        """Run all faults of a round. All of them are undone at the return."""
        self.found.strikes.extend(strikes)
        began_ns = monotonic_ns()

        async def one(place: int, strike: Strike) -> None:
            await asyncio.sleep(strike.at_s - (monotonic_ns() - began_ns) / NS_PER_S)
            target = KINDS[strike.name].target
            # A fault that takes longer to undo than planned delays the next one.
            async with locks[target]:
                self._log(f"begin {strike.name}")
                await self._site.strike(
                    strike.name, lambda: asyncio.sleep(strike.hold_s), random.Random(f"{self._seed} {number} {place}")
                )
                self._log(f"end {strike.name}")

        locks = {kind.target: asyncio.Lock() for kind in KINDS.values()}
        await asyncio.gather(*(one(place, strike) for place, strike in enumerate(strikes)))

    def _log(self, text: str) -> None:
        """Log an event, so that a wrong answer can be explained later."""
        with (self._site.folder / "logs" / EVENTS).open("a") as file:
            file.write(f"{monotonic_ns()} {text}\n")

    async def _calm(self, timeout_s: float) -> Calm:
        """Wait until the map is again as it was before all faults, and stays so; then count the resources of all
        processes.
        """
        began_ns = monotonic_ns()
        deadline_ns = began_ns + round(timeout_s * NS_PER_S)
        right_since_ns: int | None = None
        trouble = ""
        while right_since_ns is None or monotonic_ns() - right_since_ns < SETTLED_S * NS_PER_S:
            if monotonic_ns() > deadline_ns:
                trouble = await self._trouble()
                break
            now = await self._site.voxels()
            if now is None or (self._map is not None and now != self._map):
                right_since_ns = None
            else:
                self._map = now
                right_since_ns = right_since_ns or monotonic_ns()
            await asyncio.sleep(LOOK_S)
        end_ns = right_since_ns or monotonic_ns()
        await asyncio.sleep(QUIET_S)
        for _ in range(CALM_LOOKS):
            self._usage.look(calm=True)
            await asyncio.sleep(LOOK_S)
        calm = Calm((end_ns - self._began_ns) / NS_PER_S, (end_ns - began_ns) / NS_PER_S, trouble)
        self.found.calms.append(calm)
        return calm

    async def _trouble(self) -> str:
        """Return the difference to the map before all faults, in words."""
        answer = self._site.poller.answers[-1]
        if answer.now_ns is None:
            return "the master does not answer"
        if not answer.complete:
            return "; ".join(answer.reasons)
        now = await self._site.voxels()
        if now is None or self._map is None:
            return "the map does not stay complete"
        (lattice, voxels, witnesses), (usual, were, witnessed) = now, self._map
        if lattice != usual:
            return f"the lattice is {lattice}, it was {usual}"
        return f"{len(voxels)} voxels ({sum(witnesses)} witnesses), {len(were)} ({sum(witnessed)}) before all faults"

    async def _judge(self) -> None:
        while True:
            await asyncio.sleep(JUDGE_S)
            self._site.judge()


class _Beside:
    """Work in parallel to a block. Its failure is raised at the end of the block."""

    def __init__(self, *works: Coroutine[Any, Any, None]) -> None:
        self._works = works

    async def __aenter__(self) -> None:
        self._tasks = [asyncio.ensure_future(work) for work in self._works]

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        for outcome in await asyncio.gather(*self._tasks, return_exceptions=True):
            if isinstance(outcome, Exception):
                raise outcome


def results(found: Found) -> dict[str, Result]:
    """Return the tables of events, rounds and resources."""
    counts = Counter(strike.name for strike in found.strikes)
    held_s: defaultdict[str, float] = defaultdict(float)
    for strike in found.strikes:
        held_s[strike.name] += strike.hold_s
    faults = Result(
        "Events",
        ("fault", "times", "s in all"),
        tuple((name, counts[name], round(float(held_s[name]), 1)) for name in KINDS if counts[name]),
    )
    wrongs = tuple(found.wrongs[:SHOWN])
    lost = [calm for calm in found.calms if calm.trouble]
    calms = Result(
        "State after each round",
        ("round", "at s", "right again after s", "what was not"),
        tuple((n, calm.at_s, calm.recovered_s, calm.trouble or "-") for n, calm in enumerate(found.calms, 1)),
        (
            Mark("wrong answers", float(len(found.wrongs)), at_most=0.0, why="; ".join(wrongs) or None),
            Mark(
                f"rounds after which the map was not what it was within {CALM_S:g} s",
                float(len(lost)),
                at_most=0.0,
                why="; ".join(calm.trouble for calm in lost) or None,
            ),
            Mark("processes that ended by themselves", float(len(found.ended)), at_most=0.0),
            Mark(
                "logs with a traceback",
                float(len(found.tracebacks)),
                at_most=0.0,
                why="; ".join(found.tracebacks) or None,
            ),
        ),
        (f"{found.judged} answers and messages were held against what stood in the cell.", *wrongs, *found.ended,
         *found.tracebacks),
    )  # fmt: skip
    judged = [each for each in found.lifetimes if each.seconds >= LIFETIME_MIN_S]
    return {"faults": faults, "calms": calms, "processes": _process_result(judged, len(found.lifetimes))}


def _process_result(judged: Sequence[Lifetime], count: int) -> Result:
    rows = [
        (
            each.name, each.seconds, *each.quarters_mib(), each.samples[-1].threads, each.threads_grown,
            each.samples[-1].handles, each.handles_grown, "GREW" if each.memory_grew else "flat",
        )
        for each in judged
    ]  # fmt: skip
    columns = (
        "process", "lived s", "MiB in 1st quarter", "2nd", "3rd", "4th", "threads", "more", "handles", "more ",
        "memory",
    )  # fmt: skip
    marks = (
        Mark("processes whose memory grew", float(sum(each.memory_grew for each in judged)), at_most=0.0),
        Mark("threads that a process has more", float(max((each.threads_grown for each in judged), default=0)), SPARE),
        Mark("handles that a process has more", float(max((each.handles_grown for each in judged), default=0)), SPARE),
    )
    remarks = (
        f"{count} processes lived, {len(judged)} of them for {LIFETIME_MIN_S:g} s and more. Memory: the median of its "
        f"last quarter is at most {GROWTH_SHARE_MAX:g} times that of its second, and {GROWTH_MIB_MAX:g} MiB.",
        f"more: threads and handles at the last calm moment beyond the most of any in the first half of these; {SPARE} "
        "are spare, for pools that were never full at once and connections that a unit keeps or not.",
    )
    return Result("Resources of the processes", columns, tuple(rows), marks, remarks)


async def soak(folder: Path, seed: int, seconds: float) -> Found:
    """Run a whole soak on a site of its own.

    Raises:
        CellwatchError: the soak could not start.
    """
    async with Processes(folder / "logs", without=(UNIT_PREFIX, MASTER_PREFIX)) as processes:
        return await Soak(SoakSite(folder, processes), seed, seconds).run()


@contextmanager
def _folder() -> Iterator[Path]:
    """Return a folder that is kept if something in it needs inspection."""
    folder = Path(tempfile.mkdtemp(prefix="cellwatch-soak-"))
    try:
        yield folder
    except BaseException:
        print(f"logs: {folder}/logs", file=sys.stderr, flush=True)
        raise


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a mark is missed."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    try:
        seeded = () if options.seed is not None else ("--seed", str(random.SystemRandom().randrange(10**6)))
        confine("qualification.soak", (*arguments, *seeded), options.inside)
        seconds = 60.0 * options.minutes if options.seconds is None else options.seconds
        print(f"A cell for {seconds:g} s; the same again with --seed {options.seed}", file=sys.stderr, flush=True)
        with _folder() as folder:
            found = asyncio.run(soak(folder, options.seed, seconds))
    except CellwatchError as error:
        print(f"make soak: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:
        return 130
    told = results(found)
    print("\n\n".join(map(str, told.values())))
    marks = [mark for result in told.values() for mark in result.marks]
    document: dict[str, Any] = {
        "title": "A cell to which all sorts of things happen at once",
        "seed": options.seed,
        "seconds": seconds,
        "faults_count": len(found.strikes),
        "answers_judged": found.judged,
        "recovered_s_max": max((calm.recovered_s for calm in found.calms), default=None),
        **{name: result.document() for name, result in told.items()},
        "passed": all(mark.met for mark in marks),
    }
    write("soak", document, options.results)
    print(line(document))
    if document["passed"]:
        shutil.rmtree(folder, ignore_errors=True)
        return 0
    print(f"logs: {folder}/logs", file=sys.stderr, flush=True)
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make soak", description="Run a cell with random failures.")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"duration of the faults ({MINUTES:g})")
    parser.add_argument("--seconds", type=float, help="the same duration in seconds")
    parser.add_argument("--seed", type=int, help="seed of the faults and their times; default: random")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for soak.json")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
