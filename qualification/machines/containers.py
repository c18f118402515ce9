# SPDX-License-Identifier: Apache-2.0
"""Machines that boot systemd from one read-only root file system, each in a network namespace of its own.

They are containers of systemd-nspawn on a bridge. Everything runs in unnamed namespaces, including one of processes.
The kernel removes everything in them when their first process ends, for any reason.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import psutil

from qualification.networks import allowed, run
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError

BRIDGE = "cells0"

OBSERVER_IP = "10.77.0.254"
"""Address of the test itself on the bridge."""

POLL_S = 0.05

POWER_ON_S = 30.0
"""Time limit for a container to have its network on a busy computer."""

COMMAND_S = 20.0
"""Time limit of a command in a machine."""

TOOLS = {"systemd-nspawn": "systemd-container", "nsenter": "util-linux", "ip": "iproute2"}
"""Commands that containers and their network need, and the package of each."""

NAMESPACES = ("unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")

PERSISTENT = {"state": "/var/lib/private", "cache": "/var/cache/private"}
"""Folders that survive a power cut. systemd keeps the folders of services with dynamic users there."""

Found = TypeVar("Found")


class MachineError(CellwatchError):
    """A machine did not do something in time."""


def until(look: Callable[[], Found], what: str, timeout_s: float, every_s: float = POLL_S) -> Found:
    """Return the first true result of `look`, which is called every `every_s`.

    Raises:
        MachineError: not within `timeout_s`.
    """
    deadline_ns = monotonic_ns() + round(timeout_s * NS_PER_S)
    while True:
        found = look()
        if found:
            return found
        if monotonic_ns() > deadline_ns:
            raise MachineError(f"{what}: not within {timeout_s:g} s")
        threading.Event().wait(every_s)


def why_not() -> str | None:
    """Return the reason, in one sentence, for which no machine can run here; None if machines can run."""
    if os.geteuid() != 0:
        return "only root may run containers"
    if (missing := missing_packages(TOOLS)) is not None:
        return missing
    if not allowed(NAMESPACES):
        return "the kernel does not allow network, mount and process namespaces"
    if (trouble := container_trouble()) is not None:
        return f"systemd-nspawn starts no container here: {trouble}"
    bridge = ("unshare", "--net", "ip", "link", "add", BRIDGE, "type", "bridge")
    if subprocess.run(bridge, capture_output=True, check=False).returncode:
        return "the kernel has no bridge"
    return None


def missing_packages(tools: Mapping[str, str]) -> str | None:
    """Return a sentence with the command that installs all missing packages; None if none is missing."""
    packages = sorted({package for command, package in tools.items() if shutil.which(command) is None})
    return f"missing: apt-get install {' '.join(packages)}" if packages else None


def container_trouble() -> str | None:
    """Return the reason for which the smallest container cannot run `true`; None if it can."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("bin", "lib", "lib64", "sbin"):
            (Path(folder) / name).symlink_to(f"usr/{name}")
        (Path(folder) / "usr").mkdir()
        probe = ("systemd-nspawn", "--quiet", "--register=no", "--keep-unit", f"--directory={folder}", "--bind-ro=/usr")
        done = subprocess.run(
            (*NAMESPACES, *probe, "--machine=probe", "--private-network", "--console=pipe", "/usr/bin/true"),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
    return done.stderr.strip() if done.returncode else None


def confine(module: str, arguments: Sequence[str], namespaces: Sequence[str] = NAMESPACES) -> None:
    """Replace this process with `python -m module --inside arguments`, in namespaces of its own."""
    os.execvp(namespaces[0], (*namespaces, sys.executable, "-m", module, "--inside", *arguments))


def make_network() -> None:
    """Make a bridge in the network namespace of this process.

    Raises:
        ConfigError: the kernel has no bridge.
    """
    run("ip", "link", "set", "lo", "up")
    run("ip", "link", "add", BRIDGE, "type", "bridge")
    run("ip", "address", "add", f"{OBSERVER_IP}/24", "dev", BRIDGE)
    run("ip", "link", "set", BRIDGE, "up")


@dataclass(eq=False)
class Machine:
    """One container. Leaving the context cuts its power."""

    name: str
    root: Path
    ip: str
    folder: Path
    binds: tuple[str, ...] = ()
    volatile: bool = True
    """If True, writes outside of `PERSISTENT` are lost when its power is cut, and its root stays unchanged."""
    _nspawn: subprocess.Popen[bytes] | None = field(default=None, init=False)
    _leader: int = field(default=0, init=False)

    def __enter__(self) -> Machine:
        self.folder.mkdir(parents=True, exist_ok=True)
        for name in PERSISTENT:
            # Folder modes as systemd sets them.
            (self.folder / name).mkdir(mode=0o700, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.cut_power()

    def power_on(self) -> int:
        """Switch the machine on and return the time (CLOCK_MONOTONIC). It has its address soon after.

        Raises:
            MachineError: it does not boot.
            ConfigError: its network cannot be set up.
        """
        volatile = ["--volatile=overlay"] if self.volatile else []
        binds = [f"--bind={self.folder / name}:{path}" for name, path in PERSISTENT.items()]
        binds += [f"--bind-ro={bind}" for bind in self.binds]
        began_ns = monotonic_ns()
        with (self.folder / "console.log").open("ab") as log:
            self._nspawn = subprocess.Popen(
                [
                    "systemd-nspawn", "--quiet", "--register=no", "--keep-unit", f"--machine={self.name}",
                    f"--directory={self.root}", *volatile, "--boot", "--console=read-only",
                    f"--network-bridge={BRIDGE}", *binds,
                ],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        self._leader = until(self._find_leader, f"{self.name}: its network", POWER_ON_S)
        network = ("nsenter", f"--net=/proc/{self._leader}/ns/net", "--", "ip")
        run(*network, "address", "add", f"{self.ip}/24", "dev", "host0")
        run(*network, "link", "set", "host0", "up")
        return began_ns

    def cut_power(self) -> None:
        """End the machine at once, without any signal to its processes."""
        if self._nspawn is not None:
            nspawn, self._nspawn = self._nspawn, None
            if self._leader:
                # The kernel ends every process of the machine with its first one.
                with suppress(ProcessLookupError):
                    os.kill(self._leader, signal.SIGKILL)
                with suppress(subprocess.TimeoutExpired):
                    nspawn.wait(COMMAND_S)
            nspawn.kill()
            nspawn.wait()
            self._leader = 0
            # The cable ends with the namespace, which the kernel removes a moment later.
            until(lambda: not Path(f"/sys/class/net/vb-{self.name}").exists(), f"{self.name}: its end", COMMAND_S)

    def run(self, *command: str, timeout_s: float = COMMAND_S) -> str:
        """Run a command in the machine and return its output.

        Raises:
            MachineError: the command failed, or did not end.
        """
        inside = ("nsenter", f"--target={self._leader}", "--all", "--", *command)
        try:
            done = subprocess.run(inside, capture_output=True, text=True, timeout=timeout_s, check=False)
        except subprocess.TimeoutExpired as error:
            raise MachineError(f"{self.name}: {' '.join(command)} did not end within {timeout_s:g} s") from error
        if done.returncode:
            raise MachineError(f"{self.name}: {' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
        return done.stdout

    def show(self, service: str, name: str) -> str:
        """Return a property of a service."""
        return self.run("systemctl", "show", "--value", f"--property={name}", service).strip()

    def kill(self, service: str, number: signal.Signals) -> None:
        """Send a signal to the main process of a service."""
        self.run("systemctl", "kill", f"--signal={number.name}", "--kill-who=main", service)

    def journal(self, service: str) -> str:
        """Return the log of a service since the machine was switched on."""
        return self.run("journalctl", "--no-pager", "--quiet", "--output=short-monotonic", f"--unit={service}")

    def _find_leader(self) -> int:
        assert self._nspawn is not None
        if self._nspawn.poll() is not None:
            raise MachineError(f"{self.name}: systemd-nspawn ended: {(self.folder / 'console.log').read_text()}")
        for child in psutil.Process(self._nspawn.pid).children():
            # The container's first process. Those before it share our network, or end at once.
            there = ("nsenter", f"--net=/proc/{child.pid}/ns/net", "--", "ip", "link", "show", "host0")
            if not subprocess.run(there, capture_output=True, check=False).returncode:
                return child.pid
        return 0
