# SPDX-License-Identifier: Apache-2.0
"""One arm64 board in QEMU, every instruction emulated: it boots an image as it is, and keeps nothing of what it writes.

What differs between boards of one image is given as hardware would: an address of its own on the network, and on the
kernel's command line which camera of the simulated cell hangs at it.
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
"""What boards and their network take, and the package that it is in."""

CPU = "cortex-a76"
"""The eldest that runs kernels which were compiled for boards in common."""

CORES, MEMORY_MB = 2, 1536

ADDRESS = "52:54:00:cc:00:{:02x}"
"""On the network; the last three bytes become the board's name."""

FIRST_ADDRESS = 0x10

CAMERA = "CELLWATCH_UNIT_SOURCE__CAMERA"
"""See `shared.configuration`."""

TAIL_LINES = 60
"""The end of a console that is shown when a board does not report."""


@dataclass(eq=False)
class Board:
    """A board that is switched on by entering the context, and cut from power by leaving it."""

    number: int
    image: Path
    console: Path
    """What it writes to its serial line: the kernel's messages and the journal."""
    switched_on_ns: int = field(default=0, init=False)
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)
    _stack: ExitStack = field(default_factory=ExitStack, init=False)

    @property
    def address(self) -> str:
        """Of its network card."""
        return ADDRESS.format(FIRST_ADDRESS + self.number)

    @property
    def name(self) -> str:
        """The host name that it must come to by itself."""
        return "cellwatch-" + self.address.replace(":", "")[-6:]

    def command(self) -> list[str]:
        """How QEMU is called."""
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
        """Raises MachineError when it went off by itself: its kernel panicked, or QEMU does not like its image."""
        assert self._process is not None
        if self._process.poll() is not None:
            raise MachineError(f"{self.name}: went off by itself, code {self._process.returncode}")

    def tail(self) -> str:
        """The end of what it wrote."""
        text = self.console.read_text(errors="replace") if self.console.exists() else ""
        return "\n".join(text.replace("\r", "").splitlines()[-TAIL_LINES:])
