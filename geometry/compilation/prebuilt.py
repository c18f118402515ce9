# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that came with the release, for a named processor that many boards have in common.

numba keeps a kernel under the name of the processor that it was compiled for, and asks the environment for that name
before it asks the processor. So what was compiled under a name on one computer is found under the same name on all.
They lie in `$CELLWATCH_CARRIED_KERNELS/TARGET/kernels-STATE`, read-only; each kernel is used through a link in the
folder that numba may write, and one that fits no more is compiled anew in the link's place.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "CELLWATCH_CARRIED_KERNELS"

PREFIX = "kernels-"
"""Of the folders' names; the rest is a digest of the source, and where they were carried from if they were."""

PARTIAL = f"partial-{PREFIX}"
"""Of a folder of links that is being made; by its name it is none of the states that are kept."""

CPUINFO = Path("/proc/cpuinfo")

FLAGS_LINES = {"aarch64": "Features", "x86_64": "flags"}
"""What the line is called in which Linux tells the abilities of a processor."""


@dataclass(frozen=True)
class Target:
    """A kind of processor, as Linux and as the compiler know it."""

    name: str
    machine: str
    cpu: str
    flags: frozenset[str]
    """What it must be able to do, in the words of /proc/cpuinfo."""

    def runs_here(self) -> bool:
        """Whether every core of this computer can do what the kernels may ask for."""
        return platform.machine() == self.machine and self.flags <= _flags(self.machine)

    def choose(self) -> None:
        """Have numba compile for it, and find what was compiled for it, from now on."""
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = self.cpu, ""
        if "numba" in sys.modules:
            # It reads the variables only when it is imported.
            import numba

            numba.config.CPU_NAME, numba.config.CPU_FEATURES = self.cpu, ""  # type: ignore[attr-defined]  # set from outside


ARMV8_2_A = "fp asimd aes pmull sha1 sha2 crc32 atomics fphp asimdhp asimdrdm lrcpc dcpop asimddp"
X86_64_V3 = "cx16 lahf_lm popcnt pni ssse3 sse4_1 sse4_2 avx avx2 bmi1 bmi2 f16c fma abm movbe xsave"

TARGETS = (
    # Jetson Orin (Cortex-A78AE) and Thor (Neoverse V3AE) can do all that a Cortex-A76 can; emulators know it as well.
    Target("armv8.2-a", "aarch64", "cortex-a76", frozenset(ARMV8_2_A.split())),
    Target("x86-64-v3", "x86_64", "x86-64-v3", frozenset(X86_64_V3.split())),
)


def target_of(machine: str) -> Target | None:
    """What kernels are compiled for that go to boards with such a processor; None where there is nothing in common."""
    return next((target for target in TARGETS if target.machine == machine), None)


def carried(state: str) -> tuple[Target, Path] | None:
    """The kernels of this `state` that came with the release and fit this processor, if any did."""
    folder = os.environ.get(VARIABLE)
    target = target_of(platform.machine())
    if not folder or target is None or os.environ.get("NUMBA_CPU_NAME", target.cpu) != target.cpu:
        return None
    kernels = Path(folder) / target.name / f"{PREFIX}{state}"
    return (target, kernels.resolve()) if kernels.is_dir() and target.runs_here() else None


def link(kernels: Path, parent: Path) -> Path:
    """A folder in `parent` with a link to each of the `kernels`; it is there as a whole or not at all.

    Raises:
        OSError: it cannot be made.
    """
    place = hashlib.sha256(bytes(kernels)).hexdigest()[:8]
    folder = parent / f"{kernels.name}-{place}"
    if not folder.is_dir():
        with tempfile.TemporaryDirectory(prefix=PARTIAL, dir=parent) as partial:
            whole = Path(partial) / "whole"
            whole.mkdir()
            for file in kernels.glob("*/*"):
                (whole / file.parent.name).mkdir(exist_ok=True)
                (whole / file.parent.name / file.name).symlink_to(file)
            try:
                whole.rename(folder)
            except OSError:
                # Another process may have been sooner, with the same links.
                if not folder.is_dir():
                    raise
    return folder


def _flags(machine: str) -> frozenset[str]:
    """What all cores can do."""
    try:
        lines = CPUINFO.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return frozenset()
    name = FLAGS_LINES[machine]
    cores = [frozenset(line.split(":", 1)[1].split()) for line in lines if line.split(":", 1)[0].strip() == name]
    return frozenset.intersection(*cores) if cores else frozenset()
