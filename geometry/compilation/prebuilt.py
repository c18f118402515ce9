# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels shipped with a release, for a named processor that many boards share.

numba stores a kernel under the name of its target processor, and takes that name from the environment before it asks
the processor. So kernels compiled under a name on one computer are found under the same name on all. They are in
`$CELLWATCH_CARRIED_KERNELS/TARGET/kernels-STATE`, read-only. Each kernel is used through a link in the folder that
numba can write; a kernel that no longer fits is compiled again in place of its link.
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
"""Prefix of the folders' names; the digest of the source follows, and a digest of the origin for shipped kernels."""

PARTIAL = f"partial-{PREFIX}"
"""Prefix of an incomplete folder of links; the name excludes it from the states that are kept."""

CPUINFO = Path("/proc/cpuinfo")

FLAGS_LINES = {"aarch64": "Features", "x86_64": "flags"}
"""Name of the line of /proc/cpuinfo with the features of the processor."""


@dataclass(frozen=True)
class Target:
    """A kind of processor, with its names in Linux and in the compiler."""

    name: str
    machine: str
    cpu: str
    flags: frozenset[str]
    """Required features, as named in /proc/cpuinfo."""

    def runs_here(self) -> bool:
        """Return True if every core of this computer has the required features."""
        return platform.machine() == self.machine and self.flags <= _flags(self.machine)

    def choose(self) -> None:
        """Make numba compile for this target from now on, and find kernels compiled for it."""
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = self.cpu, ""
        if "numba" in sys.modules:
            # numba reads the variables only at its import.
            import numba

            numba.config.CPU_NAME, numba.config.CPU_FEATURES = self.cpu, ""  # type: ignore[attr-defined]  # set from outside


ARMV8_2_A = "fp asimd aes pmull sha1 sha2 crc32 atomics fphp asimdhp asimdrdm lrcpc dcpop asimddp"
X86_64_V3 = "cx16 lahf_lm popcnt pni ssse3 sse4_1 sse4_2 avx avx2 bmi1 bmi2 f16c fma abm movbe xsave"

TARGETS = (
    # Jetson Orin (Cortex-A78AE) and Thor (Neoverse V3AE) have all features of a Cortex-A76; emulators support it too.
    Target("armv8.2-a", "aarch64", "cortex-a76", frozenset(ARMV8_2_A.split())),
    Target("x86-64-v3", "x86_64", "x86-64-v3", frozenset(X86_64_V3.split())),
)


def target_of(machine: str) -> Target | None:
    """Return the target for boards with such a processor, or None if they share none."""
    return next((target for target in TARGETS if target.machine == machine), None)


def carried(state: str) -> tuple[Target, Path] | None:
    """Return the target and the folder of shipped kernels of this `state`, if they exist and fit this processor."""
    folder = os.environ.get(VARIABLE)
    target = target_of(platform.machine())
    if not folder or target is None or os.environ.get("NUMBA_CPU_NAME", target.cpu) != target.cpu:
        return None
    kernels = Path(folder) / target.name / f"{PREFIX}{state}"
    return (target, kernels.resolve()) if kernels.is_dir() and target.runs_here() else None


def link(kernels: Path, parent: Path) -> Path:
    """Create a folder in `parent` with a link to each of the `kernels`, atomically, and return it.

    Raises:
        OSError: the folder cannot be created.
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
                # Another process may have created the same links before.
                if not folder.is_dir():
                    raise
    return folder


def _flags(machine: str) -> frozenset[str]:
    """Return the features that all cores have."""
    try:
        lines = CPUINFO.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return frozenset()
    name = FLAGS_LINES[machine]
    cores = [frozenset(line.split(":", 1)[1].split()) for line in lines if line.split(":", 1)[0].strip() == name]
    return frozenset.intersection(*cores) if cores else frozenset()
