# SPDX-License-Identifier: Apache-2.0
"""`make rehearsal`: boot, break and recover three units and a master as machines, without a board.

Each machine is a container with systemd, the services of `deploy/systemd` and the root file system that
`deploy/image/customize-rootfs` made; the three units share the same one. The command measures the seconds from power-on
of a unit to its first merged voxel, with the kernels that its image carries and without, and the time for which each
fault keeps a unit from being live. It prints the table and, at the end, all figures as one line of JSON. The exit code
is 1 when a mark is missed. Needs root.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reporting.report import Mark, Result, line, write
from edge_unit.uplink.master_discovery import FILE_NAME
from qualification.machines import hanging_unit
from qualification.machines.containers import Machine, MachineError, confine, make_network, until, why_not
from qualification.networks import run
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, ConfigError
from simulation.fleet.processes import raise_when_stopped

ROOTS = Path("out/rehearsal")
"""Folder to which `deploy/image/rehearsal-roots` writes."""

MASTER_IP, MASTER_URL = "10.77.0.1", "http://10.77.0.1:8420"

UNIT, MASTER = "edge-unit.service", "master-server.service"

FIRST_S_MAX, WARM_S_MAX = 10.0, 5.0
"""From power-on to the first voxel: at the first boot of a board, with an empty cache, and at later ones."""

WATCHDOG_S = 10.0
"""The value in the unit files."""

RESTART_S_MAX = 8.0
"""Time for systemd to restart a service, including a second of waiting, and for a unit with compiled kernels to be
live.
"""

UNITS = 3

BOOT_S_MAX = 400.0
"""Timeout of a boot: a unit that compiles everything on a very busy computer."""

FULL_BYTES = 64 * 1024 * 1024
"""Size of a disk that is filled. State and settings of a unit take a hundredth of it."""

HANGING_SERVICE = """
[Service]
ExecStart=
ExecStart=/usr/bin/python3 /opt/hanging-unit/hanging_unit.py
"""


@dataclass
class Site:
    """A master, three units, and a client that polls their states."""

    master: Machine
    units: list[Machine]
    operator: httpx.Client
    rows: list[dict[str, Any]] = field(default_factory=list)

    def states(self) -> dict[str, dict[str, Any]]:
        """Return one row per unit by its address; empty if the master does not answer."""
        try:
            answer = self.operator.get("/units")
        except httpx.HTTPError:
            return {}
        return {row["ip"]: row for row in answer.json()} if answer.status_code == 200 else {}

    def live(self, unit: Machine) -> bool:
        """Return True if the master has the unit live, and the unit has reported a voxel."""
        row = self.states().get(unit.ip)
        return row is not None and row["state"] == "live" and row["voxels"] > 0

    def until_live(self, unit: Machine, timeout_s: float = BOOT_S_MAX) -> int:
        """Wait until the unit is live, and return the time."""
        try:
            until(lambda: self.live(unit), f"{unit.name} live", timeout_s)
        except MachineError as error:
            raise MachineError(f"{error}: {self.states().get(unit.ip)}\n{unit.journal(UNIT)}") from error
        return monotonic_ns()

    def until_not_live(self, unit: Machine) -> None:
        """Wait until the master has noticed that the unit is not live."""
        until(lambda: not self.live(unit), f"{unit.name} not live any more", BOOT_S_MAX)


# ---------------------------------------------------------------- switched on


def switch_on(site: Site) -> dict[str, Any]:
    """Boot one unit like a board by itself: with the kernels of its image, again, and without any."""
    unit, bare = site.units[0], site.units[-1]
    carried_s = _first_voxel_s(site, unit)
    compiled = unit.run("find", "/var/cache/private", "-name", "*.nbc", "-type", "f").split()
    unit.cut_power()
    site.until_not_live(unit)
    warm_s = _first_voxel_s(site, unit)
    return {
        "carried_s": round(carried_s, 2),
        "compiled": len(compiled),
        "warm_s": round(warm_s, 2),
        "cold_s": round(_first_voxel_s(site, bare), 2),
    }


def _first_voxel_s(site: Site, unit: Machine) -> float:
    began_ns = unit.power_on()
    return (site.until_live(unit) - began_ns) / NS_PER_S


def join(site: Site) -> dict[str, Any]:
    """Boot the other units from the same root file system. Every machine must generate its own name."""
    for unit in site.units[1:-1]:
        unit.power_on()
    for unit in site.units[1:]:
        site.until_live(unit)
    names = [unit.run("hostname").strip() for unit in site.units]
    keys = [unit.run("cat", "/etc/ssh/ssh_host_ed25519_key.pub").strip() for unit in site.units]
    ids = [unit.run("cat", "/etc/machine-id").strip() for unit in site.units]
    masters = [json.loads(unit.run("cat", f"/var/lib/cellwatch-unit/{FILE_NAME}")) for unit in site.units]
    return {
        "machines_posting": sum(site.live(unit) for unit in site.units),
        "distinct_names": len(set(names)),
        "distinct_host_keys": len(set(keys)),
        "distinct_machine_ids": len(set(ids)),
        "found_by_mdns": sum(master["found_by"].startswith("announced") for master in masters),
        "names": names,
    }


# ---------------------------------------------------------------- what fails


@dataclass(frozen=True)
class Fault:
    """`strike` causes the fault. It may return a function that ends it; the time counts from then on."""

    name: str
    what: str
    back_s_max: float
    strike: Callable[[Site], Callable[[], object] | None]
    prepare: Callable[[Site], None] | None = None


def unit_crashes(site: Site) -> None:
    """The kernel kills the process."""
    site.units[0].kill(UNIT, signal.SIGSEGV)


def unit_stands_still(site: Site) -> None:
    """The process gets no CPU, like one that waits for a dead disk."""
    site.units[0].kill(UNIT, signal.SIGSTOP)


def let_frames_hang(site: Site) -> None:
    """Install the unit variant that hangs on demand."""
    unit = site.units[0]
    drop_in = "/run/systemd/system/edge-unit.service.d"
    unit.run("sh", "-c", f"mkdir -p {drop_in} && cp /opt/hanging-unit/hang.conf {drop_in}/ && systemctl daemon-reload")
    unit.run("systemctl", "restart", UNIT)
    site.until_not_live(unit)


def frame_hangs(site: Site) -> None:
    """The event loop runs and talks to the master, but the filter thread does not return."""
    unit = site.units[0]
    pid = unit.show(UNIT, "MainPID")
    # The watchdog kills the hanging process. The cause of the hang is gone when the next process starts.
    unit.run("touch", "/run/hang")
    until(lambda: unit.show(UNIT, "MainPID") != pid, "the watchdog", BOOT_S_MAX)
    unit.run("rm", "/run/hang")


def master_crashes(site: Site) -> None:
    """The kernel kills the process."""
    site.master.kill(MASTER, signal.SIGSEGV)


def master_stands_still(site: Site) -> None:
    """The process gets no CPU."""
    site.master.kill(MASTER, signal.SIGSTOP)


def master_loses_power(site: Site) -> Callable[[], object]:
    """The whole machine is off, longer than the longest timeout of a unit."""
    site.master.cut_power()
    return site.master.power_on


def unit_loses_power(site: Site) -> Callable[[], object]:
    """The whole machine is off."""
    site.units[0].cut_power()
    return site.units[0].power_on


def disk_is_full(site: Site) -> None:
    """No byte is left for state or kernels, and the service is restarted."""
    unit = site.units[0]
    for folder in ("state", "cache"):
        disk = os.statvfs(unit.folder / folder)
        with (unit.folder / folder / "full").open("wb") as file:
            file.write(bytes(disk.f_bavail * disk.f_frsize))
    unit.run("systemctl", "restart", UNIT)


FAULTS = (
    Fault("unit-crashes", "SIGSEGV", RESTART_S_MAX, unit_crashes),
    Fault("unit-stands-still", "SIGSTOP: the watchdog strikes", WATCHDOG_S + RESTART_S_MAX, unit_stands_still),
    Fault(
        "frame-hangs",
        "one thread hangs: the watchdog strikes",
        WATCHDOG_S + RESTART_S_MAX,
        frame_hangs,
        let_frames_hang,
    ),
    Fault("unit-loses-power", "and is switched on again", RESTART_S_MAX, unit_loses_power),
    Fault("master-crashes", "SIGSEGV", RESTART_S_MAX, master_crashes),
    Fault("master-stands-still", "SIGSTOP: the watchdog strikes", WATCHDOG_S + RESTART_S_MAX, master_stands_still),
    Fault("master-loses-power", "and is switched on again", RESTART_S_MAX, master_loses_power),
    Fault("disk-is-full", "at the unit, which is started anew", RESTART_S_MAX, disk_is_full),
)


def strike(site: Site, fault: Fault) -> dict[str, Any]:
    """Run one fault, from its beginning until the first unit is live again."""
    unit = site.units[0]
    if fault.prepare is not None:
        fault.prepare(site)
    site.until_live(unit)
    began_ns = monotonic_ns()
    undo = fault.strike(site)
    if fault.strike is not frame_hangs:
        site.until_not_live(unit)
    if undo is not None:
        began_ns = monotonic_ns()
        undo()
    back_s = (site.until_live(unit) - began_ns) / NS_PER_S
    return {"fault": fault.name, "what": fault.what, "back_s": round(back_s, 2), "back_s_max": fault.back_s_max}


# ---------------------------------------------------------------- all of it


@contextmanager
def site_of(roots: Path, folder: Path) -> Iterator[Site]:
    """Start a master, and prepare three units that are still off."""
    hanging = folder / "hanging-unit"
    hanging.mkdir()
    shutil.copy(hanging_unit.__file__, hanging)
    (hanging / "hang.conf").write_text(HANGING_SERVICE)
    nothing = folder / "nothing"
    nothing.mkdir()
    with ExitStack() as stack:
        master = stack.enter_context(Machine("master", roots / "master", MASTER_IP, folder / "master"))
        # The token in the units' image is this master's.
        state = folder / "master" / "state" / "cellwatch-master"
        state.mkdir(mode=0o700)
        (state / "unit.token").write_text((roots / "unit.token").read_text())
        (state / "unit.token").chmod(0o600)
        units = []
        for number in range(UNITS):
            name = f"unit{number + 1}"
            for part in ("state", "cache"):
                (folder / name / part).mkdir(parents=True, mode=0o700)
                size = FULL_BYTES if part == "state" else 8 * FULL_BYTES
                run("mount", "-t", "tmpfs", "-o", f"size={size},mode=0700", "tmpfs", str(folder / name / part))
                stack.callback(run, "umount", "--lazy", str(folder / name / part))
            config = (roots / "unit.yaml").read_text().replace("cameras: 3", f"cameras: 3, camera: {number}")
            (folder / name / "unit.yaml").write_text(config)
            binds = [f"{hanging}:/opt/hanging-unit", f"{folder / name}/unit.yaml:/etc/cellwatch/unit.yaml"]
            if number == UNITS - 1:
                # This unit's image carries no kernels.
                release = (roots / "unit" / "opt" / "cellwatch" / "current").readlink()
                binds.append(f"{nothing}:/opt/cellwatch/{release}/kernels")
            unit = Machine(name, roots / "unit", f"10.77.0.{11 + number}", folder / name, tuple(binds))
            units.append(stack.enter_context(unit))
        master.power_on()
        token = state / "operator.token"
        until(lambda: token.exists() and token.read_text().strip(), "the master", BOOT_S_MAX)
        headers = {"Authorization": f"Bearer {token.read_text().strip()}"}
        operator = stack.enter_context(httpx.Client(base_url=MASTER_URL, headers=headers, trust_env=False, timeout=2.0))
        site = Site(master, units, operator)
        until(lambda: _answers(operator), "the master's answer", BOOT_S_MAX)
        yield site


def _answers(operator: httpx.Client) -> bool:
    try:
        return operator.get("/healthz").status_code == 200
    except httpx.HTTPError:
        return False


def rehearse(roots: Path, folder: Path, faults: Sequence[Fault]) -> dict[str, Any]:
    """Boot, run each fault, and return the figures."""
    make_network()
    with site_of(roots, folder) as site:
        document: dict[str, Any] = {"load": os.getloadavg()[0], "switch_on": switch_on(site)}
        print(f"  first voxel: {document['switch_on']}", flush=True)
        document["join"] = join(site)
        print(f"  three from one root: {document['join']}", flush=True)
        document["faults"] = []
        for fault in faults:
            document["faults"].append(strike(site, fault))
            print(f"  {document['faults'][-1]}", flush=True)
        document["stop_s"] = round(stop_s(site.units[0]), 2)
    return document


def stop_s(unit: Machine) -> float:
    """Return the seconds that the service takes to stop cleanly."""
    began_ns = monotonic_ns()
    unit.run("systemctl", "stop", UNIT)
    took_s = (monotonic_ns() - began_ns) / NS_PER_S
    if (result := unit.show(UNIT, "Result")) != "success":
        raise MachineError(f"{unit.name}: stopped with {result}, expected success")
    return took_s


def marks(document: dict[str, Any]) -> list[Mark]:
    """Return the marks."""
    on, joined = document["switch_on"], document["join"]
    return [
        Mark("seconds from power-on to the first voxel, first boot", on["carried_s"], at_most=FIRST_S_MAX),
        Mark("kernels compiled at the first boot", on["compiled"], at_most=0),
        Mark("seconds from power-on to the first voxel, later boots", on["warm_s"], at_most=WARM_S_MAX),
        Mark("units that report", joined["machines_posting"], at_least=3),
        Mark("distinct host names", joined["distinct_names"], at_least=3),
        Mark("units that found their master by multicast DNS", joined["found_by_mdns"], at_least=3),
        Mark("seconds to stop", document["stop_s"], at_most=2.0),
        *(Mark(f"{row['fault']}: seconds until live", row["back_s"], row["back_s_max"]) for row in document["faults"]),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a mark is missed."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    try:
        if (reason := why_not()) is not None:
            raise ConfigError(reason)
        if not options.inside:
            if not (options.roots / "unit" / "opt").exists():
                subprocess.run(["deploy/image/rehearsal-roots", str(options.roots)], check=True)
            confine("qualification.boot", arguments)
        raise_when_stopped()
        chosen = [fault for fault in FAULTS if not options.names or fault.name in options.names]
        with tempfile.TemporaryDirectory() as folder:
            document = rehearse(options.roots.resolve(), Path(folder), chosen)
    except (CellwatchError, subprocess.CalledProcessError) as error:
        print(f"make rehearsal: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:
        return 130
    found = marks(document)
    on = document["switch_on"]
    starts = Result(
        "Seconds from power-on to the first voxel in the map",
        ("first boot, carried kernels", "later boots", "nothing compiled"),
        ((on["carried_s"], on["warm_s"], on["cold_s"]),),
    )
    columns = ("fault", "what", "back_s", "back_s_max")
    faults = Result(
        "Seconds from a fault until the first unit is live again",
        columns,
        tuple(tuple(row[name] for name in columns) for row in document["faults"]),
        tuple(found),
    )
    print(starts, faults, sep="\n")
    document["tables"] = [starts.document(), faults.document()]
    if not options.names and not options.no_results:
        write("boot", document)
    print(line(document))
    return 0 if all(mark.met for mark in found) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make rehearsal", description=(__doc__ or "").split("\n\n")[1])
    names = [fault.name for fault in FAULTS]
    parser.add_argument("names", nargs="*", choices=[*names, []], metavar="NAME", help=", ".join(names))
    parser.add_argument("--roots", type=Path, default=ROOTS, help="root file systems (default: out/rehearsal)")
    parser.add_argument("--no-results", action="store_true", help="do not write out/results")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
