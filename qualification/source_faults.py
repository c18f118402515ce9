# SPDX-License-Identifier: Apache-2.0
"""`make source-faults`: test a RealSense source with camera failures, with objects of the real SDK.

Cameras are recordings on the SDK's context, plugged in and out; capture processes are stopped and killed. For each
fault the command measures the time until the state was reported, and until frames flowed again. It prints the table
and, at the end, all figures as one line of JSON. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import shutil
import signal
import statistics
import sys
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import yaml

from benchmarks.reporting.report import Mark, Result, line, write
from edge_unit.sources.realsense.bag_writer import record_images
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSourceConfig
from edge_unit.sources.status import SourceStatus
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, SourceError
from shared.waiting import within
from simulation.cameras.pluggable import command, plug

WIDTH, HEIGHT, FPS, FRAMES = 848, 480, 30, 60
SERIAL = "CAMERA1"

NOTICED_MS_MAX = 1000.0
BACK_S_MAX = 5.0

CALM_S = 0.5
"""Seconds of frames before each fault."""

GIVE_UP_S = 30.0


@dataclass(frozen=True)
class Outcome:
    """Times of one fault: until it was reported, and from the possible recovery until frames flowed again; NaN if none
    are expected.
    """

    noticed_ms: float
    back_s: float
    told: str


@dataclass
class Watched:
    """A source with all its frames and status reports."""

    source: RealsenseSource
    sockets: Path
    recording: Path
    numbers: list[int] = field(default_factory=list)
    taken_ns: list[int] = field(default_factory=list)
    told: list[SourceStatus] = field(default_factory=list)

    async def read(self) -> None:
        """Read frames until they end."""
        async for frame in self.source.frames():
            self.numbers.append(frame.frame_number)
            self.taken_ns.append(monotonic_ns())

    async def listen(self) -> None:
        """Read the status reports."""
        self.told.append(self.source.status)
        while True:
            self.told.append(await self.source.next_status(self.told[-1]))

    async def until(self, look: Callable[[], bool]) -> None:
        """Wait until `look` is true at a change of status.

        Raises:
            SourceError: it does not become true.
        """

        async def wait() -> None:
            while not look():
                await self.source.next_status(self.source.status)

        if not await within(GIVE_UP_S, wait()):
            raise SourceError(f"after {GIVE_UP_S:g} s still {self.source.status}")

    async def trouble(self) -> None:
        """Wait until the source reports a failure."""
        await self.until(lambda: self.source.status.trouble is not None)

    async def live(self) -> None:
        """Wait until frames come."""
        await self.until(lambda: self.source.status.state == "live")

    def noticed_ms(self, since_ns: int) -> float:
        """Return the milliseconds from `since_ns` to the first reported failure."""
        return min(s.since_ns - since_ns for s in self.told if s.trouble and s.since_ns >= since_ns) / NS_PER_MS

    def back_s(self, since_ns: int, told_ns: int) -> float:
        """Return the seconds from `since_ns` to the first frame taken after `told_ns`."""
        return min(at_ns - since_ns for at_ns in self.taken_ns if at_ns > told_ns) / NS_PER_S


Fault = Callable[[Watched], Awaitable[Outcome]]


async def unplugged(watched: Watched) -> Outcome:
    """Unplug the camera, and plug it in again after its absence was reported."""
    out_ns = monotonic_ns()
    plug(watched.sockets, [])
    await watched.until(lambda: watched.source.status.state == "absent")
    absent = watched.source.status
    in_ns = monotonic_ns()
    plug(watched.sockets, [watched.recording])
    await watched.live()
    await asyncio.sleep(CALM_S)
    return Outcome(watched.noticed_ms(out_ns), watched.back_s(in_ns, in_ns), absent.reason)


async def unplugged_for_a_moment(watched: Watched) -> Outcome:
    """Unplug the camera and plug it in again 0.1 s later, like a loose plug."""
    out_ns = monotonic_ns()
    plug(watched.sockets, [])
    await asyncio.sleep(0.1)
    plug(watched.sockets, [watched.recording])
    return await _told_and_back(watched, out_ns)


async def killed(watched: Watched) -> Outcome:
    """Kill the capture process, like a crash of the SDK."""
    return await _signalled(watched, signal.SIGKILL)


async def stopped(watched: Watched) -> Outcome:
    """Stop the capture process, like a call of the SDK that does not return."""
    return await _signalled(watched, signal.SIGSTOP)


async def _signalled(watched: Watched, number: signal.Signals) -> Outcome:
    assert watched.source.pid is not None
    since_ns = monotonic_ns()
    os.kill(watched.source.pid, number)
    return await _told_and_back(watched, since_ns)


async def _told_and_back(watched: Watched, since_ns: int) -> Outcome:
    await watched.trouble()
    told = watched.source.status
    await watched.live()
    await asyncio.sleep(CALM_S)
    return Outcome(watched.noticed_ms(since_ns), watched.back_s(since_ns, told.since_ns), told.reason)


FAULTS: tuple[tuple[str, Fault], ...] = (
    ("unplugged, plugged in again", unplugged),
    ("loose plug: gone for 0.1 s", unplugged_for_a_moment),
    ("capture process killed (SIGKILL)", killed),
    ("capture process hangs (SIGSTOP)", stopped),
)


async def flowing(fault: Fault, recording: Path, folder: Path) -> Outcome:
    """Run a fault of a camera that delivers frames.

    Raises:
        SourceError: the camera does not recover, or a frame came twice.
    """
    sockets = folder / "sockets"
    plug(sockets, [recording])
    watched = Watched(
        RealsenseSource(RealsenseSourceConfig(serial=SERIAL, fps=FPS), command(sockets)), sockets, recording
    )
    async with _running(watched):
        await watched.live()
        await asyncio.sleep(CALM_S)
        outcome = await fault(watched)
    if watched.numbers != sorted(set(watched.numbers)):
        raise SourceError("a frame was delivered twice")
    return outcome


@asynccontextmanager
async def _running(watched: Watched) -> AsyncIterator[None]:
    listening = asyncio.create_task(watched.listen())
    await watched.source.open()
    reading = asyncio.create_task(watched.read())
    try:
        yield
    finally:
        await watched.source.close()
        listening.cancel()
        await asyncio.gather(reading, listening, return_exceptions=True)


async def absent_at_start(recording: Path, folder: Path) -> Outcome:
    """Start a unit without its serial, and plug the camera in after its absence was reported."""
    sockets = folder / "sockets"
    plug(sockets, [])
    source = RealsenseSource(RealsenseSourceConfig(serial=SERIAL), command(sockets))
    began_ns = monotonic_ns()
    opening = asyncio.create_task(source.open())
    status = source.status
    while status.state != "absent":
        status = await source.next_status(status)
    in_ns = monotonic_ns()
    plug(sockets, [recording])
    await opening
    async for _ in source.frames():
        break
    back_s = (monotonic_ns() - in_ns) / NS_PER_S
    await source.close()
    return Outcome((status.since_ns - began_ns) / NS_PER_MS, back_s, status.reason)


async def cut_in_half(recording: Path, folder: Path) -> Outcome:
    """Open a recording cut in half. It is refused, because it cannot recover."""
    half = folder / "half.db3"
    half.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    source = RealsenseSource(RealsenseSourceConfig(recording=half))
    began_ns = monotonic_ns()
    try:
        await source.open()
    except SourceError as error:
        return Outcome((monotonic_ns() - began_ns) / NS_PER_MS, float("nan"), str(error).split(": ", 1)[1])
    raise SourceError(f"{half}: expected the recording to be refused, but it was opened")


async def started(recording: Path, folder: Path) -> float:
    """Return the seconds from the start to the first frame of a connected camera."""
    sockets = folder / "sockets"
    plug(sockets, [recording])
    source = RealsenseSource(RealsenseSourceConfig(serial=SERIAL), command(sockets))
    began_ns = monotonic_ns()
    await source.open()
    async for _ in source.frames():
        break
    began_s = (monotonic_ns() - began_ns) / NS_PER_S
    await source.close()
    return began_s


def record(folder: Path) -> Path:
    """Record two seconds of a camera at 848x480."""
    images = folder / "images"
    (images / "depth").mkdir(parents=True)
    columns = np.arange(WIDTH, dtype=np.uint16)
    for number in range(FRAMES):
        depth = np.tile(1000 + columns + 3 * number, (HEIGHT, 1)).astype(np.uint16)
        cv2.imwrite(str(images / "depth" / f"{number:03}.png"), depth)
    k = [424.0, 0.0, (WIDTH - 1) / 2, 0.0, 424.0, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0]
    (images / "camera_info.yaml").write_text(yaml.safe_dump({"width": WIDTH, "height": HEIGHT, "k": k}))
    recording = folder / "camera.db3"
    record_images(RecordedSourceConfig(folder=images, serial=SERIAL), recording, FPS)
    return recording


async def run(recording: Path, folder: Path, repeats: int) -> Result:
    """Run every fault `repeats` times."""
    starts = [await started(recording, folder) for _ in range(repeats)]
    outcomes = {name: [await flowing(fault, recording, folder) for _ in range(repeats)] for name, fault in FAULTS}
    outcomes["serial absent at the start, then there"] = [
        await absent_at_start(recording, folder) for _ in range(repeats)
    ]
    outcomes["recording cut in half"] = [await cut_in_half(recording, folder) for _ in range(repeats)]
    every = [outcome for those in outcomes.values() for outcome in those]
    return Result(
        f"A RealSense source in trouble: median of {repeats} (and the worst)",
        ("fault", "told_ms", "told_ms_worst", "back_s", "back_s_worst", "told"),
        tuple(_row(name, those) for name, those in outcomes.items()),
        (
            Mark("told_ms_max", max(outcome.noticed_ms for outcome in every), at_most=NOTICED_MS_MAX),
            Mark("back_s_max", max(o.back_s for o in every if o.back_s == o.back_s), at_most=BACK_S_MAX),
        ),
        (
            f"From nothing to the first frame: {statistics.median(starts):.2f} s (worst {max(starts):.2f}).",
            "told_ms: from the fault until it was told. back_s: until frames flowed again, from the fault or from",
            "when the camera was plugged in; nan where none are to come. No frame was delivered twice.",
        ),
    )


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str | float, ...]:
    noticed, back = [o.noticed_ms for o in outcomes], [o.back_s for o in outcomes]
    return name, statistics.median(noticed), max(noticed), statistics.median(back), max(back), outcomes[0].told


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a mark is missed."""
    parser = argparse.ArgumentParser(prog="make source-faults", description="Measure the recovery of a failing camera.")
    parser.add_argument("--repeats", type=int, default=3, help="repeats of each fault (default 3)")
    options = parser.parse_args(arguments)
    folder = Path(tempfile.mkdtemp(prefix="cellwatch-faults-"))
    try:
        result = asyncio.run(run(record(folder), folder, options.repeats))
    except CellwatchError as error:
        print(f"make source-faults: {error}", file=sys.stderr)
        return 1
    finally:
        shutil.rmtree(folder)
    print(result)
    document = result.document()
    write("source_faults", document)
    print(line(document))
    return 0 if all(mark.met for mark in result.marks) else 1


if __name__ == "__main__":
    sys.exit(main())
