# SPDX-License-Identifier: Apache-2.0
"""`make image-test`: boot two arm64 boards from the same image in QEMU, and let them report to a master.

It covers the first boot of a board, except for its boot firmware, its kernel and its camera: firmware and kernel are
QEMU's and Debian's, and the camera is simulated. The boards are not configured with a name, an address or the place of
their master. The command prints one line of JSON at the end, also when it fails. Needs root.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reporting.report import Mark, Result, line, write
from qualification.machines.arm64_boards import EMULATOR_TOOLS, Board
from qualification.machines.containers import BRIDGE, NAMESPACES, MachineError, confine, missing_packages, until
from qualification.machines.image_parts import BUILD_TOOLS, CACHE, CELL, build
from qualification.networks import allowed, run
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, ConfigError
from simulation.fleet.processes import raise_when_stopped

PARTS = Path("out/image-test")

MASTER_IP = "10.77.0.1"

BOARDS = 2

MASTER_S = 60.0
"""Time limit for the master to start on a busy computer."""

CHECK_EVERY_S = 0.5
"""Time between two checks, which leaves the processor to the boards."""

WAIT_S = 400.0
"""Time limit for all boards to report, from power-on."""


class Watch:
    """State of the boards so far, also if the test fails."""

    def __init__(self, boards: Sequence[Board], leases: Path, operator: httpx.Client) -> None:
        self._boards = boards
        self._leases = leases
        self._operator = operator
        self.registered_s: dict[str, float] = {}
        self.first_voxel_s: dict[str, float] = {}

    def names(self) -> dict[str, str]:
        """Return the host name by which each address sent its request."""
        lines = self._leases.read_text().splitlines() if self._leases.exists() else []
        return {fields[2]: fields[3] for fields in map(str.split, lines) if len(fields) >= 4}

    def all_report(self) -> bool:
        """Check once, and return True if every board has reported a voxel."""
        for board in self._boards:
            board.require_running()
        began_ns = self._boards[0].switched_on_ns
        elapsed_s = round((monotonic_ns() - began_ns) / NS_PER_S, 1)
        for row in self._rows():
            for happened, when_s in ((True, self.registered_s), (row["voxels"] > 0, self.first_voxel_s)):
                if happened and row["ip"] not in when_s:
                    when_s[row["ip"]] = elapsed_s
                    what = "its first voxel" if when_s is self.first_voxel_s else "registered"
                    print(f"  {self.names().get(row['ip'], row['ip'])}: {what} after {elapsed_s:g} s", flush=True)
        return len(self.first_voxel_s) == len(self._boards)

    def document(self) -> dict[str, Any]:
        """Return the figures. Seconds are those of the last board, None while one is missing."""
        names = self.names()
        whole = len(self.first_voxel_s) == len(self._boards)
        return {
            "machines_posting": len(self.first_voxel_s),
            "distinct_names": len(set(names.values()) & {board.name for board in self._boards}),
            "names": sorted(set(names.values())),
            "seconds_power_on_to_registered": sorted(self.registered_s.values()),
            "seconds_power_on_to_first_voxel": max(self.first_voxel_s.values()) if whole else None,
        }

    def _rows(self) -> list[dict[str, Any]]:
        try:
            answer = self._operator.get("/units")
        except httpx.HTTPError:
            return []
        return list(answer.json()) if answer.status_code == 200 else []


Start = Callable[..., None]


@contextmanager
def processes(logs: Path) -> Iterator[Start]:
    """Start processes, each with a log of its own. They end with the context."""
    with ExitStack() as stack:

        def start(name: str, *command: str) -> None:
            log = stack.enter_context((logs / f"{name}.log").open("wb"))
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.kill)

        yield start


def boot(parts: Path, wait_s: float, document: dict[str, Any]) -> None:
    """Boot all boards, and wait until each has reported a voxel. `document` gets the figures, also partial ones.

    Raises:
        MachineError: a board does not report within `wait_s`.
        ConfigError: the network cannot be made.
    """
    logs, state = parts / "logs", parts / "master"
    for folder in (logs, state):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(mode=0o700)
    shutil.copy(parts / "unit.token", state / "unit.token")
    (state / "unit.token").chmod(0o600)
    run("ip", "link", "set", "lo", "up")
    # All ports receive all multicast, because no machine here snoops for subscriptions.
    run("ip", "link", "add", BRIDGE, "type", "bridge", "mcast_snooping", "0")
    run("ip", "address", "add", f"{MASTER_IP}/24", "dev", BRIDGE)
    run("ip", "link", "set", BRIDGE, "up")
    leases = logs / "leases"
    with processes(logs) as start, ExitStack() as stack:
        start(
            "dnsmasq", "dnsmasq", "--no-daemon", "--port=0", f"--interface={BRIDGE}", "--bind-interfaces",
            "--user=root", "--dhcp-range=10.77.0.50,10.77.0.90,1h", f"--dhcp-leasefile={leases}",
            "--conf-file=/dev/null",
        )  # fmt: skip
        start(
            "master", sys.executable, "-m", "master_server", "--cell", str(CELL / "cell.yaml"),
            "--host", MASTER_IP, "--state-dir", str(state),
        )  # fmt: skip
        token = state / "operator.token"
        until(lambda: token.exists() and bool(token.read_text().strip()), "the master", MASTER_S)
        headers = {"Authorization": f"Bearer {token.read_text().strip()}"}
        operator = stack.enter_context(
            httpx.Client(base_url=f"http://{MASTER_IP}:8420", headers=headers, trust_env=False, timeout=10.0)
        )
        boards = [
            stack.enter_context(Board(number, parts / "image", logs / f"board{number}.log")) for number in range(BOARDS)
        ]
        watch = Watch(boards, leases, operator)
        try:
            until(watch.all_report, f"{BOARDS} boards that report voxels", wait_s, CHECK_EVERY_S)
        except MachineError:
            for board in boards:
                print(f"---- the end of {board.name}'s console\n{board.tail()}", file=sys.stderr, flush=True)
            raise
        finally:
            document.update(watch.document())


def why_not(building: bool = False) -> str | None:
    """Return the reason, in one sentence, for which the test cannot run here, with all missing packages; None if it
    can.
    """
    if os.geteuid() != 0:
        return "networks and images: expected to run as root"
    if not allowed(NAMESPACES):
        return "the kernel does not allow network, mount and process namespaces"
    return missing_packages(EMULATOR_TOOLS | (BUILD_TOOLS if building else {}))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a board does not report, or two boards have the same name."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    began_ns = monotonic_ns()
    built = options.parts / "built.json"
    document: dict[str, Any] = {
        "machines_posting": 0,
        "distinct_names": 0,
        "seconds_power_on_to_first_voxel": None,
        "image_mb": None,
        "payload_mb": None,
    }
    try:
        if (reason := why_not(building=not options.inside and not options.no_build)) is not None:
            raise ConfigError(reason)
        if not options.inside:
            if not options.no_build:
                options.parts.mkdir(parents=True, exist_ok=True)
                built.write_text(json.dumps(build(options.parts, options.cache) | {"began_ns": began_ns}))
            confine("qualification.image", arguments)
        raise_when_stopped()
        if built.exists():
            document |= json.loads(built.read_text())
            build_began_ns = document.pop("began_ns")
            began_ns = began_ns if options.no_build else build_began_ns
        boot(options.parts.resolve(), options.wait_s, document)
    except (CellwatchError, subprocess.CalledProcessError) as error:
        document["error"] = str(error)
        print(f"make image-test: {error}", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        document["error"] = "interrupted"
    document["seconds"] = round((monotonic_ns() - began_ns) / NS_PER_S, 1)
    document["load"] = round(os.getloadavg()[0], 1)
    result = result_of(document)
    print(result)
    if not options.no_results:
        write("image", document | {"table": result.document()})
    print(line(document))
    return 0 if all(mark.met for mark in result.marks) else 1


def result_of(document: dict[str, Any]) -> Result:
    """Return the table and marks. A step that was not reached has no figure."""
    figures = (
        ("from power-on to the first voxel, s", document.get("seconds_power_on_to_first_voxel")),
        ("image, MB", document.get("image_mb")),
        ("release in the image, MB", document.get("payload_mb")),
        ("total with the build, s", document.get("seconds")),
    )
    return Result(
        f"{BOARDS} arm64 boards of one image, every instruction emulated",
        ("what", "figure"),
        tuple((name, float("nan") if value is None else float(value)) for name, value in figures),
        (
            Mark("boards that report", float(document["machines_posting"]), at_least=BOARDS),
            Mark("distinct names", float(document["distinct_names"]), at_least=BOARDS),
        ),
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make image-test", description=(__doc__ or "").split("\n\n")[1])
    parser.add_argument(
        "--parts", type=Path, default=PARTS, help=f"folder of the image and the logs (default: {PARTS})"
    )
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"compiled kernels (default: {CACHE})")
    parser.add_argument("--no-build", action="store_true", help="boot the existing image")
    parser.add_argument(
        "--wait-s", type=float, default=WAIT_S, help=f"time limit for the boards to report (default {WAIT_S:g})"
    )
    parser.add_argument("--no-results", action="store_true", help="do not write out/results")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
