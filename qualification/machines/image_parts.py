# SPDX-License-Identifier: Apache-2.0
"""The image that `make image-test` boots, built as a board's is. Compiled kernels are kept between runs.

Emulated compilation takes ten times as long as on this computer. So kernels are compiled when the image is made, and
only when they differ from those of earlier runs.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from geometry.compilation import kernel_state
from qualification.networks import run
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import ConfigError

CHECKOUT = Path(__file__).resolve().parents[2]

CELL = CHECKOUT / "assets" / "cells" / "demo"

DEPLOY = Path("deploy/image")

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "cellwatch" / "image-test"
"""Outside of the checkout, so that a fresh checkout uses the kernels of an older one."""

CACHED_MAX = 3
"""Number of kernel states that are kept."""

PYTHON = "3.11"
"""Version of Debian 12."""

COMPILED_BY = ("geometry/compilation/prebuilt.py", "edge_unit/daemon/warm_up.py")
"""Files that decide which kernels are compiled, and for which processor."""

COMPILERS = ("llvmlite", "numba", "numpy")

CONFIGURATION = """\
token_file: /etc/cellwatch/unit.token
source: {kind: simulated, cell: /etc/cellwatch/cell/cell.yaml, cameras: 2, fps: 2}
"""
"""Neither master nor address, as on any board. Each board gets its camera at power-on."""

BINFMT = Path("/proc/sys/fs/binfmt_misc")

BUILD_TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "arch-test": "arch-test",
    "update-binfmts": "binfmt-support",
    "qemu-aarch64-static": "qemu-user-static",
    "depmod": "kmod",
    "cpio": "cpio",
    "sfdisk": "fdisk",
    "mke2fs": "e2fsprogs",
    "systemctl": "systemd",
}
"""Commands that the build needs, and the package of each."""


def state_to_compile(checkout: Path, lock: Iterable[str]) -> str:
    """Return a state that changes whenever other kernels are to be compiled. `lock` are lines as `numba==0.68.1
    --hash=...`.
    """
    digest = hashlib.sha256(f"{PYTHON} {kernel_state.state_of_kernels(checkout)}".encode())
    for name in COMPILED_BY:
        digest.update(f"{name}\0".encode())
        digest.update((checkout / name).read_bytes())
    for requirement in sorted(lock):
        if requirement.split("==")[0] in COMPILERS:
            digest.update(f"{requirement.strip()}\n".encode())
    return digest.hexdigest()[:16]


def build(parts: Path, cache: Path) -> dict[str, Any]:
    """Build wheels and image into `parts`. Return the duration of each step, and the sizes.

    Raises:
        ConfigError: binaries of another processor cannot run here, or the kernels could not be compiled.
        CalledProcessError: a step failed and has printed the reason.
    """
    cache = cache.expanduser()
    seconds: dict[str, float] = {}
    environment = {**os.environ, "PYTHON": sys.executable}

    def step(name: str, *command: str | Path) -> None:
        began_ns = monotonic_ns()
        subprocess.run(
            [str(word) for word in command], check=True, cwd=CHECKOUT, stdout=subprocess.DEVNULL, env=environment
        )
        seconds[name] = round((monotonic_ns() - began_ns) / NS_PER_S, 1)
        print(f"  {name}: {seconds[name]:g} s", flush=True)

    parts = parts.resolve()
    run_foreign_binaries()
    wheels, image, token, configuration = (parts / n for n in ("wheels", "image", "unit.token", "unit.yaml"))
    token.write_text(os.urandom(32).hex() + "\n")
    configuration.write_text(CONFIGURATION)
    options = ("--python", PYTHON, "--arch", "aarch64", "--extras", "edge,sim", "--out", wheels)
    step("wheels", DEPLOY / "wheelhouse", *options)
    kernels = cache / state_to_compile(CHECKOUT, (wheels / "lock.txt").read_text().splitlines())
    cached = kernels.is_dir()
    if cached:
        print(f"  kernels: reused from an earlier run, in {kernels}", flush=True)
    else:
        print(f"  kernels: compiled with the image, by emulation, which takes minutes; kept in {kernels}", flush=True)
        cache.mkdir(parents=True, exist_ok=True)
    ours = ("--wheelhouse", wheels, "--token", token, "--config", configuration, "--cell", CELL)
    step(
        "image", DEPLOY / "build-image", "--ci", "--out", image, "--",
        *ours, "--kernels" if cached else "--keep-kernels", kernels,
    )  # fmt: skip
    if not kernels.is_dir():
        raise ConfigError("kernels: expected to be compiled with the image, found none; see the output above")
    os.utime(kernels)
    forget_all_but_newest(cache, CACHED_MAX)
    return {
        "image_mb": round((image / "disk.img").stat().st_blocks * 512 / 1e6),
        "payload_mb": round(sum(wheel.stat().st_size for wheel in wheels.glob("*.whl")) / 1e6, 1),
        "kernels_of_an_earlier_run": cached,
        "seconds_to_build": seconds,
    }


def run_foreign_binaries() -> None:
    """Register QEMU with the kernel for arm64 binaries, unless the kernel runs or passes them already.

    Raises:
        ConfigError: the registration failed.
    """
    if os.uname().machine == "aarch64" or (BINFMT / "qemu-aarch64").exists():
        return
    if not (BINFMT / "register").exists():
        run("mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT))
    run("update-binfmts", "--enable", "qemu-aarch64")
    if not (BINFMT / "qemu-aarch64").exists():
        raise ConfigError(f"{BINFMT}: expected qemu-aarch64 after update-binfmts --enable, found none")


def forget_all_but_newest(cache: Path, count: int) -> None:
    """Keep the `count` most recently used folders, and delete the others."""
    folders = sorted((path for path in cache.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for folder in folders[:-count]:
        shutil.rmtree(folder)
