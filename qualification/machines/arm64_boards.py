# SPDX-License-Identifier: Apache-2.0
"""One arm64 board in QEMU, every instruction emulated. It boots an image as it is, and its writes are discarded.

Boards of one image differ as hardware does: each has its own network address, and its kernel command line names its
camera of the simulated cell.
"""

from __future__ import annotations

import subprocess
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from qualification.machines.containers import BRIDGE, MachineError
from qualification.networks import run
from shared.clock import monotonic_ns

COMMAND = "qemu-system-aarch64"

EMULATOR_TOOLS = {COMMAND: "qemu-system-arm", "dnsmasq": "dnsmasq-base", "ip": "iproute2"}
"""Commands that boards and their network need, and the package of each."""

CPU = "cortex-a76"
"""The oldest CPU that runs kernels compiled for all boards."""

CORES, MEMORY_MB = 2, 1536

ADDRESS = "52:54:00:cc:00:{:02x}"
"""Network address. The board's name comes from the last three bytes."""

FIRST_ADDRESS = 0x10

CAMERA = "CELLWATCH_UNIT_SOURCE__CAMERA"
"""See `shared.configuration`."""

TAIL_LINES = 60
"""Lines of a console that are printed when a board does not report."""


@dataclass(eq=False)
class Board:
    """A board. Entering the context switches it on; leaving the context cuts its power."""

    number: int
    image: Path
    console: Path
    """Output of its serial line: the kernel's messages and the journal."""
    switched_on_ns: int = field(default=0, init=False)
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)
    _stack: ExitStack = field(default_factory=ExitStack, init=False)

    @property
    def address(self) -> str:
        """Return the address of its network card."""
        return ADDRESS.format(FIRST_ADDRESS + self.number)

    @property
    def name(self) -> str:
        """Return the host name that the board must generate by itself."""
        return "cellwatch-" + self.address.replace(":", "")[-6:]

    def command(self) -> list[str]:
        """Return the command line of QEMU."""
        words = (
            "console=ttyAMA0", "rw", "quiet", "net.ifnames=0", "panic=-1",
            "systemd.journald.forward_to_console=1", f"systemd.setenv={CAMERA}={self.number}",
        )  # fmt: skip
        return [
            COMMAND, "-accel", "tcg,thread=multi", "-machine", "virt", "-cpu", CPU, "-smp", str(CORES),
            "-m", str(MEMORY_MB), "-nographic", "-no-reboot",
            "-kernel", str(self.image / "kernel"), "-initrd", str(self.image / "initrd"), "-append", " ".join(words),
            "-drive", f"file={self.image / 'disk.img'},if=none,id=d0,format=raw,snapshot=on",
            "-device", "virtio-blk-pci,drive=d0",
            "-netdev", f"tap,id=n0,ifname=tap{self.number},script=no,downscript=no",
            "-device", f"virtio-net-pci,netdev=n0,romfile=,mac={self.address}",
        ]  # fmt: skip

    def __enter__(self) -> Board:
        run("ip", "tuntap", "add", f"tap{self.number}", "mode", "tap")
        run("ip", "link", "set", f"tap{self.number}", "master", BRIDGE, "up")
        log = self._stack.enter_context(self.console.open("wb"))
        self.switched_on_ns = monotonic_ns()
        self._process = subprocess.Popen(self.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._stack.close()

    def require_running(self) -> None:
        """Raise MachineError if the board went off by itself: its kernel panicked, or QEMU rejects its image."""
        assert self._process is not None
        if self._process.poll() is not None:
            raise MachineError(f"{self.name}: went off by itself, code {self._process.returncode}")

    def tail(self) -> str:
        """Return the end of its console."""
        text = self.console.read_text(errors="replace") if self.console.exists() else ""
        return "\n".join(text.replace("\r", "").splitlines()[-TAIL_LINES:])
