# SPDX-License-Identifier: Apache-2.0
"""`make faults`: test the map while processes, clocks, networks and disks fail.

Each fault hits a real master with two real units and a robot's controller. At that moment a thing appears in a place
that only the affected unit can see. An observer polls the map every 10 ms, and no answer may call that place free once
its last view is stale. The command prints the table and, at the end, all figures as one line of JSON. The exit code is
1 when a mark is missed. `ARGS="unit-killed"` runs one fault by name.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import shutil
import signal
import sys
import tempfile
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.reporting.report import Mark, Result, line, write
from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from qualification.fault_site.clock import WallClock, monotonic_elsewhere
from qualification.fault_site.site import ADDRESSES, SERIALS, FaultError, Site, registered, until
from qualification.fault_site.watch import (
    NOTICED_S_MAX,
    POLL_S,
    RECOVERED_S_MAX,
    SLACK_S,
    STALE_AFTER_S,
    Verdict,
    in_force,
    judge,
)
from qualification.networks import UNIT_IP, Cable, Proxy, confine, run
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError
from simulation.fleet.fleet import MASTER_PREFIX
from simulation.fleet.processes import Processes

HOLD_S = 1.5
"""Duration of a fault after it is noticeable: long enough for retries to reach their longest back-off."""

FIRST, SECOND = 0, 1

HOUR_S = 3600

TMPFS_BYTES = 2**20


@dataclass
class Course:
    """Times of a fault's begin and end, and notes on it."""

    cause_ns: int = 0
    noticeable_ns: int = 0
    """Set if it differs from the begin of the fault."""
    gone_ns: int = 0
    lost: list[str] = field(default_factory=list)
    figures: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """`names` must stand in the map's reason. None: there is nothing to notice, and the map stays good."""

    name: str
    what: str
    names: str | None
    strike: Callable[[Site, Course], Awaitable[None]]
    blind: bool = True


async def hold(seconds: float = HOLD_S) -> None:
    """Keep the fault for this time."""
    await asyncio.sleep(NOTICED_S_MAX + seconds)


async def ordinary(site: Site) -> None:
    """Start all processes on this machine, each with an address of its own."""
    await site.start_master()
    await site.start_robot()
    for index in (FIRST, SECOND):
        await site.start_unit(index)
    await site.calm()


def begin(course: Course) -> None:
    """Record the begin of the fault."""
    course.cause_ns = monotonic_ns()


async def again(site: Site, course: Course, **how: Any) -> None:
    """Start the first unit again. The cause is gone when the unit has registered."""
    started_ns = monotonic_ns()
    unit = await site.start_unit(FIRST, **how)
    await until(lambda: registered(unit), "the unit registers again")
    course.gone_ns = monotonic_ns()
    course.figures["process_start_s"] = (course.gone_ns - started_ns) / NS_PER_S


# ---------------------------------------------------------------------- processes


async def unit_killed(site: Site, course: Course, **how: Any) -> None:
    """Kill a unit while a thing appears before it, and start it again with `how`."""
    await ordinary(site)
    begin(course)
    await site.kill(site.units[FIRST])
    site.newcomer()
    await hold(0.0)
    await again(site, course, **how)
    await site.settled()


async def unit_frozen(site: Site, course: Course) -> None:
    """Stop a unit. After it continues, it must not report its old frame."""
    await ordinary(site)
    begin(course)
    site.units[FIRST].process.send_signal(signal.SIGSTOP)
    site.newcomer()
    await hold()
    course.gone_ns = monotonic_ns()
    site.units[FIRST].process.send_signal(signal.SIGCONT)
    await site.settled()


async def robot_silent(site: Site, course: Course) -> None:
    """Stop the robot's controller."""
    await ordinary(site)
    begin(course)
    site.robot.process.send_signal(signal.SIGSTOP)
    site.newcomer()
    await hold()
    course.gone_ns = monotonic_ns()
    site.robot.process.send_signal(signal.SIGCONT)
    await site.settled()


async def master_killed(site: Site, course: Course) -> None:
    """Kill the master, and start it again at the same port."""
    await ordinary(site)
    begin(course)
    await site.kill(site.master)
    site.newcomer()
    await hold()
    await site.start_master()
    course.gone_ns = monotonic_ns()
    await site.settled()


async def camera_died_meanwhile(site: Site, course: Course) -> None:
    """Kill the master, and kill a unit while the master is down."""
    await ordinary(site)
    begin(course)
    await site.kill(site.master)
    await site.kill(site.units[FIRST])
    site.newcomer()
    await site.start_master()
    # From here on the master answers, and must report the camera as missing.
    course.noticeable_ns = monotonic_ns()
    await hold()
    await again(site, course)
    await site.settled()


# ---------------------------------------------------------------------- clocks


def wall_clock(index: int | None, by_s: int) -> Callable[[Site, Course], Awaitable[None]]:
    """Return a fault: the wall clock of a unit (None: of the master) jumps."""

    async def strike(site: Site, course: Course) -> None:
        clock = WallClock(site.folder / "clock")
        await site.start_master(clock.environment if index is None else None)
        await site.start_robot()
        for each in (FIRST, SECOND):
            await site.start_unit(each, variables=clock.environment if each == index else None)
        await site.calm()
        begin(course)
        clock.jump(by_s)
        site.newcomer()
        course.gone_ns = course.cause_ns
        await hold()
        await site.settled()

    return strike


def monotonic_clock(by_s: int) -> Callable[[Site, Course], Awaitable[None]]:
    """Return a fault: a unit restarts with another origin of its monotonic clock, like that of another board."""
    return partial(unit_killed, under=monotonic_elsewhere(by_s))


# ---------------------------------------------------------------------- networks


async def network_cut(site: Site, course: Course) -> None:
    """Pull the cable of a unit in its own network namespace."""
    cable = Cable()
    try:
        site.host = "0.0.0.0"
        await site.start_master()
        await site.start_robot()
        await site.start_unit(FIRST, f"http://10.77.0.1:{site.port}", UNIT_IP, cable.under)
        await site.start_unit(SECOND)
        await site.calm()
        begin(course)
        cable.pull()
        site.newcomer()
        await hold(2.0 * HOLD_S)
        course.gone_ns = monotonic_ns()
        cable.plug()
        await site.settled()
    finally:
        cable.close()


async def by_proxy(site: Site) -> Proxy:
    """Start the units so that the first one reaches the master through a proxy."""
    await site.start_master()
    proxy = Proxy(site.port, ADDRESSES[FIRST])
    await proxy.open()
    await site.start_robot()
    await site.start_unit(FIRST, proxy.url)
    await site.start_unit(SECOND)
    await site.calm()
    return proxy


async def network_slow(site: Site, course: Course) -> None:
    """Delay all data of a unit by 150 to 250 ms."""
    proxy = await by_proxy(site)
    try:
        begin(course)
        proxy.delay_s, proxy.jitter_s = 0.2, 0.05
        site.newcomer()
        await hold(2.0 * HOLD_S)
        ages = [a.age_s for a in site.poller.answers if a.age_s is not None and a.got_ns > course.cause_ns]
        course.figures["oldest_view_s_max"] = max(ages)
        course.gone_ns = monotonic_ns()
        proxy.delay_s = proxy.jitter_s = 0.0
        await site.settled()
    finally:
        await proxy.close()


async def connections_cut(site: Site, course: Course) -> None:
    """Reset every connection of a unit, three times a second."""
    proxy = await by_proxy(site)
    try:
        begin(course)
        site.newcomer()
        for _ in range(10):
            proxy.cut()
            await asyncio.sleep(0.3)
        proxy.cut()
        course.gone_ns = monotonic_ns()
        await site.settled()
    finally:
        await proxy.close()


def replayed(path: str) -> Callable[[Site, Course], Awaitable[None]]:
    """Return a fault: an earlier request of a unit is sent again from its own address."""

    async def strike(site: Site, course: Course) -> None:
        proxy = await by_proxy(site)
        try:
            requests = [one for one in proxy.sent if one.startswith(f"POST {path} ".encode())]
            if not requests:
                raise FaultError(f"no POST {path} was recorded")
            site.newcomer()
            await site.settled()
            begin(course)
            answer = await send_again(requests[-1], site.port)
            course.gone_ns = monotonic_ns()
            course.figures["answered"] = answer
            await hold(0.0)
            await site.settled()
        finally:
            await proxy.close()

    return strike


async def send_again(request: bytes, port: int) -> str:
    """Send the bytes of a request from the first unit's address, and return the status of the answer."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(ADDRESSES[FIRST], 0))
    writer.write(request)
    status = (await reader.readline()).split()[1].decode()
    writer.close()
    with suppress(ConnectionError):
        await writer.wait_closed()
    return status


# ---------------------------------------------------------------------- disks


def tmpfs(folder: Path) -> Path:
    """Mount a tiny disk at `folder`, in a private mount namespace."""
    folder.mkdir(parents=True, exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", f"size={TMPFS_BYTES}", "tmpfs", str(folder))
    return folder


def fill(folder: Path) -> Path:
    """Write until the disk is full. Return the file that takes all the space."""
    path = folder / "full"
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
    return path


async def master_disk_full(site: Site, course: Course) -> None:
    """Change a setting while the disk is full; after space is free again, kill and restart the master."""
    disk = tmpfs(site.master_state)
    try:
        await ordinary(site)
        begin(course)
        full = fill(disk)
        site.newcomer()
        response = await site.operator.put("/settings", json={"margin_base_m": 0.032})
        course.figures["answered"] = str(response.status_code)
        if response.is_success:
            site.expect("settings", response.json())
        await hold()
        course.gone_ns = monotonic_ns()
        full.unlink()
        await site.settled()
        # What was acknowledged must survive a crash, too.
        await site.stop_observers()
        await site.kill(site.master)
        await site.start_master()
        course.lost = await site.lost()
    finally:
        run("umount", "--lazy", str(disk))


async def unit_disk_full(site: Site, course: Course) -> None:
    """Kill and restart a unit whose disk is full from the start."""
    disk = tmpfs(site.state_dirs[FIRST])
    try:
        fill(disk)
        await ordinary(site)
        begin(course)
        await site.kill(site.units[FIRST])
        site.newcomer()
        await hold(0.0)
        await again(site, course)
        await site.settled()
    finally:
        run("umount", "--lazy", str(disk))


# ---------------------------------------------------------------------- identities


async def units_swapped(site: Site, course: Course) -> None:
    """Restart both units with each other's address; then an operator sets the poses of the cameras."""
    await swap_addresses(site, course)
    for unit in [await site.start_unit(index) for index in (FIRST, SECOND)]:
        await until(partial(registered, unit), "the swapped units register")
    await hold()
    course.gone_ns = monotonic_ns()
    await set_and_expect_poses(site)


async def address_taken(site: Site, course: Course) -> None:
    """Restart the first unit with the address of the second, which is off; then an operator sets its pose."""
    await swap_addresses(site, course)
    unit = await site.start_unit(FIRST)
    await until(partial(registered, unit), "the unit registers with the other's address")
    await site.set_poses()
    await hold()
    unit = await site.start_unit(SECOND)
    await until(partial(registered, unit), "the other unit registers")
    course.gone_ns = monotonic_ns()
    await set_and_expect_poses(site)


async def swap_addresses(site: Site, course: Course) -> None:
    """Kill both units. Each restart then uses the other's address."""
    await ordinary(site)
    begin(course)
    for unit in site.units:
        await site.kill(unit)
    site.newcomer()
    site.addresses.reverse()


async def set_and_expect_poses(site: Site) -> None:
    """Set the poses of the cameras as an operator. The master must keep them from now on."""
    await site.set_poses()
    acknowledged = await site.acknowledged()
    for serial in SERIALS:
        site.expect(serial, acknowledged[serial])
    await site.settled()


async def token_revoked(site: Site, course: Course) -> None:
    """Replace the units' token at the master and at the second unit. The first unit gets it later."""
    await ordinary(site)
    token = "another-token-of-the-units-0123456789abcdef"
    replace(site.tokens[SECOND], token)
    begin(course)
    replace(site.unit_token, token)
    site.newcomer()
    await hold()
    course.gone_ns = monotonic_ns()
    replace(site.tokens[FIRST], token)
    await site.settled()


def replace(path: Path, text: str) -> None:
    """Write a file atomically."""
    written = path.with_suffix(".new")
    written.write_text(text + "\n")
    written.chmod(0o600)
    written.rename(path)


ONE = f"({ADDRESSES[FIRST]})"

FAULTS: tuple[Fault, ...] = (
    Fault("unit-killed", "a unit is killed and started again", ONE, unit_killed),
    Fault("unit-frozen", "a unit is stopped (SIGSTOP, SIGCONT)", ONE, unit_frozen),
    Fault("wall-clock-ahead", "a unit's wall clock jumps 1 h ahead", None, wall_clock(FIRST, HOUR_S), False),
    Fault("wall-clock-back", "a unit's wall clock jumps 1 h back", None, wall_clock(FIRST, -HOUR_S), False),
    Fault("master-wall-clock", "the master's wall clock jumps 1 h back", None, wall_clock(None, -HOUR_S), False),
    Fault("monotonic-elsewhere", "a unit's monotonic clock starts 11 days ahead", ONE, monotonic_clock(10**6)),
    Fault("network-cut", "a unit's network cable is pulled, and plugged in", f"({UNIT_IP})", network_cut),
    Fault("network-slow", "a unit's data is delayed by 200 ms (+-50)", None, network_slow, False),
    Fault("connections-cut", "a unit's connections are reset, 3 times a second", None, connections_cut, False),
    Fault("master-killed", "the master is killed and started again", "", master_killed),
    Fault("camera-died-meanwhile", "... and a unit dies while it is down", ONE, camera_died_meanwhile),
    Fault("master-disk-full", "the master's disk is full", None, master_disk_full, False),
    Fault("unit-disk-full", "a unit restarts on a full disk", ONE, unit_disk_full),
    Fault("units-swapped", "two units come back with each other's address", ONE, units_swapped),
    Fault("address-taken", "a unit comes back with the address of one that is gone", ONE, address_taken),
    Fault("update-replayed", "an old update of a unit is sent again", None, replayed("/update"), False),
    Fault("registration-replayed", "an old registration of a unit is sent again", None, replayed("/initialize"), False),
    Fault("token-revoked", "the units' token is replaced; a unit learns it later", ONE, token_revoked),
    Fault("robot-silent", "the robot does not report, then does again", "robot", robot_silent),
)


async def strike(fault: Fault) -> dict[str, Any]:
    """Run one fault from the first process to the last, and return its row.

    Raises:
        CellwatchError: the fault could not be measured.
    """
    folder = Path(tempfile.mkdtemp(prefix="cellwatch-faults-"))
    try:
        async with Processes(folder / "logs", without=(UNIT_PREFIX, MASTER_PREFIX)) as processes:
            site, course = Site(folder, processes), Course()
            trouble = ""
            try:
                await fault.strike(site, course)
                course.lost = course.lost or await site.lost()
            except FaultError as error:
                if not course.gone_ns:
                    raise
                trouble = str(error)
                course.lost = course.lost or await site.lost()
            finally:
                await site.stop_observers()
            return row(fault, site, course, trouble)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def row(fault: Fault, site: Site, course: Course, trouble: str) -> dict[str, Any]:
    """Return the row of a fault."""
    polled, streamed = (
        judge(
            answers,
            site.present,
            course.cause_ns,
            course.noticeable_ns or course.cause_ns,
            course.gone_ns,
            fault.names,
            fault.blind,
            len(SERIALS),
        )
        for answers in (site.poller.answers, in_force(site.subscriber.answers))
    )
    false = polled.false_free or (streamed.false_free and f"stream: {streamed.false_free}")
    return {
        "name": fault.name,
        "noticed_s": _rounded(polled.noticed_s),
        "recovered_s": _rounded(polled.recovered_s),
        "false_free": bool(false),
        "lost": len(course.lost),
        "met": met(fault, polled, course.lost) and not false,
        "told": polled.told,
        "stream_noticed_s": _rounded(streamed.noticed_s),
        "stream_recovered_s": _rounded(streamed.recovered_s),
        "complete_share": round(polled.complete_share, 3),
        "answers": len(site.poller.answers),
        "messages": len(site.subscriber.answers),
        **{name: _rounded(value) if isinstance(value, float) else value for name, value in course.figures.items()},
        **({"first_false": false} if false else {}),
        **({"forgotten": course.lost} if course.lost else {}),
        **({"trouble": trouble} if trouble else {}),
    }


def met(fault: Fault, verdict: Verdict, lost: Sequence[str]) -> bool:
    """Return True if all marks are met."""
    noticed = fault.names is None or (verdict.noticed_s is not None and verdict.noticed_s <= NOTICED_S_MAX)
    recovered = verdict.recovered_s is not None and verdict.recovered_s <= RECOVERED_S_MAX
    return noticed and recovered and not verdict.false_free and not lost


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


async def strike_all(faults: Sequence[Fault]) -> list[dict[str, Any]]:
    """Run one fault after the other, and print each verdict."""
    rows = []
    for fault in faults:
        rows.append(await strike(fault))
        print(f"  {fault.name}: {'met' if rows[-1]['met'] else 'MISSED'}", file=sys.stderr, flush=True)
    return rows


def result_of(rows: Sequence[dict[str, Any]]) -> Result:
    """Return the table, and the marks of all faults together."""
    what = {fault.name: fault.what for fault in FAULTS}
    columns = (
        "fault",
        "what happens",
        "noticed_s",
        "recovered_s",
        "stream: noticed_s",
        "stream: recovered_s",
        "false_free",
        "lost",
        "mark",
        "what the map told",
    )
    cells = tuple(
        (
            each["name"],
            what[each["name"]],
            _cell(each["noticed_s"]),
            _cell(each["recovered_s"]),
            _cell(each["stream_noticed_s"]),
            _cell(each["stream_recovered_s"]),
            "YES" if each["false_free"] else "no",
            str(each["lost"]),
            "met" if each["met"] else "MISSED",
            str(each.get("first_false") or each.get("trouble") or each["told"]).split(";")[0],
        )
        for each in rows
    )
    started = ", ".join(f"{each['name']} {each['process_start_s']:.3f}" for each in rows if "process_start_s" in each)
    starts = (f"From the start of a unit's process until it registered, s: {started}.",) if started else ()
    marks = (
        Mark("faults after which a mark was missed", float(sum(not each["met"] for each in rows)), at_most=0.0),
        Mark("longest time until noticed, s", _longest(rows, "noticed_s"), at_most=NOTICED_S_MAX),
        Mark("longest time until the map was right again, s", _longest(rows, "recovered_s"), at_most=RECOVERED_S_MAX),
        Mark(
            "faults after which a map called an unseen place free", float(sum(each["false_free"] for each in rows)), 0.0
        ),
        Mark("acknowledged values lost", float(sum(each["lost"] for each in rows)), at_most=0.0),
    )
    return Result("Faults, with real processes", columns, cells, marks, (*REMARKS, *starts))


def _longest(rows: Sequence[dict[str, Any]], name: str) -> float:
    """Return the longest time over the faults that have a value."""
    return max((each[name] for each in rows if each[name] is not None), default=0.0)


REMARKS = (
    "noticed_s: from the cause to the first answer that is not complete and names what is missing (-: there is nothing",
    f"to notice); at most {NOTICED_S_MAX:.3f}: {STALE_AFTER_S:g} until a view is stale, one frame period, {POLL_S:g} "
    f"between questions, {SLACK_S:g} for scheduling.",
    "recovered_s: from when the cause is gone (a process: registered, or listening) to a map that stays complete and",
    f"right; at most {RECOVERED_S_MAX:g}.",
    "false_free: an answer said, or implied, that a place which nobody sees is free.",
    "lost: ids, poses or settings that were acknowledged, and are not there any more.",
)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a mark is missed."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    try:
        confine("qualification.faults", arguments, options.inside)
        chosen = [fault for fault in FAULTS if not options.names or fault.name in options.names]
        rows = asyncio.run(strike_all(chosen))
    except CellwatchError as error:
        print(f"make faults: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:
        return 130
    result = result_of(rows)
    document = {"faults": rows}
    if not options.names:
        write("faults", result.document() | document)
    print(result)
    print(line(document))
    return 0 if all(mark.met for mark in result.marks) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make faults", description=(__doc__ or "").split("\n\n")[1])
    names = [fault.name for fault in FAULTS]
    parser.add_argument("names", nargs="*", choices=[*names, []], metavar="NAME", help=", ".join(names))
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
