# SPDX-License-Identifier: Apache-2.0
"""`make fresh-machine`: run both commands of the README on Debians that have only Python, its venv and make.

An unprivileged user runs `make demo` and `make test` in a checkout, in one root file system after the other. A test
that needs more than wheels (a browser, git, machines that boot) must skip with its reason; the reasons are printed.
`--smoke` runs a short demo, and the tests that depend on the tools of such a machine. It uses an environment with
compiled kernels that is kept for the next run. The time to make this environment and to fetch Debian does not count.
The command prints one line of JSON at the end, also when it fails. Needs root.

Exit code 1: a command failed. 3: Debian or the wheels cannot be fetched.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from benchmarks.reporting.report import Mark, Result, line, write
from qualification.machines.containers import confine, container_trouble, missing_packages
from qualification.machines.fresh_debian import (
    NAMESPACES,
    REPORTS,
    SUITES,
    TOOLS,
    FreshDebian,
    Lent,
    Unreachable,
    is_unreachable,
    lend,
    settle_in,
)
from qualification.networks import allowed
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, ConfigError
from simulation.fleet.processes import raise_when_stopped

SOURCE = Path(__file__).resolve().parents[1]

FOLDER = Path("out/fresh-machine")

DEMO_S, SMOKE_DEMO_S = 20, 8
"""Seconds of the demo's frames that count."""

UNITS = 4
"""Number of units of a demo by default."""

SMOKE_ENVIRONMENT = "make .venv/ready && .venv/bin/python -m simulation.fleet.warm_up"
"""First command of the smoke part. Its wheels and compiled kernels are kept."""

ENVIRONMENT_S_MAX = 900.0
"""Time limit to fetch and install the wheels, some 50 s from a cache, and to compile the kernels."""

DEMO_S_MAX = 300.0
"""Time limit to compile the kernels from nothing, and to run the demo."""

TEST_S_MAX = 3600.0
"""Time limit of all tests, which take some 10 minutes on two idle processors."""

SMOKE_TEST_S_MAX = 300.0

SMOKE_TESTS = (
    "tests/test_layout.py",
    "tests/edge_unit/sources/realsense/test_sdk.py",
    "tests/edge_unit/sources/realsense/test_live_camera.py",
    "tests/geometry/kernels/test_voxelize.py",
)
"""Tests that need git, libusb or compiled kernels, which such a machine lacks or makes itself."""

REPORT = f"$(mktemp ../{REPORTS}/XXXXXX)"
"""A file for each run of pytest; `make test` runs it more than once."""

DECIDES_ENVIRONMENT = ("pyproject.toml", "constraints.txt", "Makefile", "scripts/find-python")
"""Files whose change requires another environment."""

TAIL_LINES = 30
"""Lines of a log that are printed when its command failed."""


@dataclass(frozen=True)
class Row:
    """Results of one root file system."""

    debian: str
    python: str
    demo_ok: bool = False
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0


@dataclass
class Tests:
    """Counts of pytest."""

    passed: int = 0
    failed: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    """Number of skipped tests by reason."""
    names: list[str] = field(default_factory=list)
    """Names of the failed tests."""


def counted(reports: Path, code: int | None) -> Tests:
    """Return the counts of the `--junitxml` reports in a folder, for a command that ended with `code`."""
    tests = Tests()
    for report in sorted(reports.glob("*")):
        try:
            cases = list(ElementTree.parse(report).getroot().iter("testcase"))
        except ElementTree.ParseError:
            # pytest writes the report last. A failure before that shows in the exit code.
            continue
        for case in cases:
            skipped = case.find("skipped")
            if case.find("failure") is not None or case.find("error") is not None:
                tests.failed += 1
                tests.names.append(f"{case.get('classname')}::{case.get('name')}")
            elif skipped is not None:
                tests.skipped[skipped.get("message", "")] += 1
            else:
                tests.passed += 1
    if code != 0 and not tests.failed:
        tests.failed = 1
        tests.names.append("no test: lint, or the command itself" if code is not None else "no test: it did not end")
    return tests


def demo_trouble(code: int | None, said: str) -> str | None:
    """Return the failure of a demo; None if it ended by itself and had frames of all units."""
    if code is None:
        return "it did not end"
    if code:
        return f"it ended with {code}"
    try:
        figures = json.loads(said.strip().splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        return "its last line is not JSON"
    if figures["failures"]:
        return "; ".join(figures["failures"])
    if len(figures["fps_per_unit"]) != UNITS or min(figures["fps_per_unit"]) <= 0.0:
        return f"expected frames of {UNITS} units, got {figures['fps_per_unit']} a second"
    return None


class Visit:
    """A new user on one fresh machine."""

    def __init__(self, machine: FreshDebian, logs: Path, lent: Lent, smoke: bool) -> None:
        self._machine = machine
        self._logs = logs
        self._lent = lent
        self._smoke = smoke
        beside = SOURCE.parent / "shared"
        self._beside = beside.resolve() if beside.is_dir() else None

    def pay(self) -> Row:
        """Run both commands.

        Raises:
            Unreachable: Debian or the wheels cannot be fetched.
            ConfigError: the folder is no checkout.
        """
        machine, began_ns = self._machine, monotonic_ns()
        made = machine.install()
        self._say(f"Debian {'fetched' if made else 'already present'}", began_ns)
        environment = hashlib.sha256()
        for name in DECIDES_ENVIRONMENT:
            environment.update((SOURCE / name).read_bytes())
        kept = machine.home / "environment"
        ready = kept.is_file() and kept.read_text() == environment.hexdigest() and not made
        machine.check_out(SOURCE, anew=not self._smoke or not ready)
        if self._smoke and not ready:
            if self._run("environment", SMOKE_ENVIRONMENT, ENVIRONMENT_S_MAX)[0] == 0:
                kept.write_text(environment.hexdigest())
            else:
                self._show("environment")
        began_ns = monotonic_ns()
        seconds = SMOKE_DEMO_S if self._smoke else DEMO_S
        command = f"make demo ARGS='--seconds {seconds} --json --no-browser'"
        code, said = self._run("demo", command, ENVIRONMENT_S_MAX + DEMO_S_MAX)
        if (trouble := demo_trouble(code, said)) is not None:
            print(f"  {machine.suite}: make demo: {trouble}", flush=True)
            self._show("demo")
        tests = self._test()
        return Row(
            machine.suite,
            SUITES[machine.suite],
            trouble is None,
            tests.passed,
            tests.failed,
            tests.skipped.total(),
            round((monotonic_ns() - began_ns) / NS_PER_S, 1),
        )

    def _test(self) -> Tests:
        reports = self._machine.home / REPORTS
        for old in reports.glob("*"):
            old.unlink()
        if self._smoke:
            command = f".venv/bin/python -m pytest -q --junitxml={REPORT} {' '.join(SMOKE_TESTS)}"
            code, _ = self._run("test", command, SMOKE_TEST_S_MAX)
        else:
            report = REPORT.replace("$", "$$")
            code, _ = self._run("test", f"make test ARGS='--junitxml={report}'", TEST_S_MAX)
        tests = counted(reports, code)
        for reason, count in sorted(tests.skipped.items()):
            print(f"  {self._machine.suite}: {count} skipped: {reason}", flush=True)
        for name in tests.names:
            print(f"  {self._machine.suite}: failed: {name}", flush=True)
        if tests.failed:
            self._show("test")
        return tests

    def _run(self, name: str, command: str, timeout_s: float) -> tuple[int | None, str]:
        began_ns = monotonic_ns()
        log = self._logs / f"{self._machine.suite}-{name}.log"
        code, said = self._machine.run(command, log, timeout_s, self._lent, self._beside)
        self._say(f"{command}: {'not ended' if code is None else f'exit code {code}'}", began_ns)
        if code != 0 and is_unreachable(log):
            raise Unreachable(f"the wheels cannot be fetched: see {log}")
        return code, said

    def _say(self, what: str, began_ns: int) -> None:
        print(f"  {self._machine.suite}: {what} after {(monotonic_ns() - began_ns) / NS_PER_S:.1f} s", flush=True)

    def _show(self, name: str) -> None:
        log = self._logs / f"{self._machine.suite}-{name}.log"
        lines = log.read_text(errors="replace").splitlines()[-TAIL_LINES:]
        print(f"---- the end of {log}", *lines, sep="\n", file=sys.stderr, flush=True)


def why_not() -> str | None:
    """Return the reason, in one sentence, for which the test cannot run here; None if it can."""
    if os.geteuid() != 0:
        return "only root may make root file systems"
    if (missing := missing_packages(TOOLS)) is not None:
        return missing
    if not allowed(NAMESPACES):
        return "the kernel does not allow mount and process namespaces"
    if (trouble := container_trouble()) is not None:
        return f"systemd-nspawn starts no container here: {trouble}"
    return None


def result_of(rows: Sequence[Row], smoke: bool) -> Result:
    """Return the table and marks."""
    columns = ("debian", "python", "passed", "failed", "skipped", "seconds")
    return Result(
        f"README's commands where there are only Python, its venv and make{', the smoke part' if smoke else ''}",
        columns,
        tuple(tuple(getattr(row, name) for name in columns) for row in rows),
        tuple(
            mark
            for row in rows
            for mark in (
                Mark(f"{row.debian}: the demo shows its cell", float(row.demo_ok), at_least=1),
                Mark(f"{row.debian}: tests that pass", float(row.passed), at_least=1),
                Mark(f"{row.debian}: tests that fail", float(row.failed), at_most=0),
            )
        ),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run. The exit code is 1 when a command failed, 3 when Debian or the wheels cannot be fetched."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    rows: list[Row] = []
    status = 0
    try:
        if not options.inside:
            if (reason := why_not()) is not None:
                raise ConfigError(reason)
            confine("qualification.fresh_machine", arguments, NAMESPACES)
        raise_when_stopped()
        settle_in()
        folder = options.folder.resolve()
        logs = folder / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        lent = lend(os.environ, Path.home())
        for suite in options.roots:
            rows.append(Visit(FreshDebian(suite, folder), logs, lent, options.smoke).pay())
    except CellwatchError as error:
        print(f"make fresh-machine: {error}", file=sys.stderr, flush=True)
        status = 3 if isinstance(error, Unreachable) else 1
    except KeyboardInterrupt:
        status = 130
    document: dict[str, Any] = {"roots": [asdict(row) for row in rows]}
    if rows:
        result = result_of(rows, options.smoke)
        print(result)
        if not status and not all(mark.met for mark in result.marks):
            status = 1
        if not options.smoke and not options.no_results:
            write("fresh_machine", document | {"table": result.document()})
    print(line(document))
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make fresh-machine", description=(__doc__ or "").split("\n\n")[1])
    parser.add_argument("--roots", nargs="+", choices=tuple(SUITES), default=tuple(SUITES), help="default: all")
    parser.add_argument(
        "--smoke", action="store_true", help="a short demo and a few tests, in an environment that is kept"
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help=f"roots, wheels, logs (default: {FOLDER})")
    parser.add_argument("--no-results", action="store_true", help="do not write out/results")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
