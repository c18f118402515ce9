# SPDX-License-Identifier: Apache-2.0
"""Kernels compiled on another computer: used if the processor fits, compiled again if not."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from geometry.compilation import cache as jit_cache
from geometry.compilation import prebuilt
from geometry.compilation.prebuilt import TARGETS, VARIABLE, Target, carried, link, target_of
from tests.edge_unit.scenes import CHECKOUT

X86_64_V3 = next(target for target in TARGETS if target.name == "x86-64-v3")
HERE = target_of(platform.machine())

needs_target = pytest.mark.skipif(HERE is None or not HERE.runs_here(), reason="this processor is none of the targets")

COMPILE = """
import sys
from pathlib import Path
import geometry
from geometry.compilation import prebuilt
from geometry.compilation.cache import settle, settle_for
if sys.argv[1] == "carry":
    settle_for(prebuilt.target_of(sys.argv[3]), Path(sys.argv[2]))
elif sys.argv[1] == "lesser":
    prebuilt.CPUINFO = Path(sys.argv[2])
    settle()
import numba
@numba.njit(cache=True)
def twice(x):
    return 2 * x
assert twice(21) == 42
stats = twice.stats
print(sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""


def compile_one(tmp_path: Path, *arguments: str, **variables: str) -> str:
    """Compile a kernel in a new process; return the numbers of cache hits and of compilations."""
    script = tmp_path / "compile.py"
    script.write_text(COMPILE)
    left_out = (*jit_cache.VARIABLES, VARIABLE, "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
    environment = {name: text for name, text in os.environ.items() if name not in left_out}
    environment |= {"CELLWATCH_JIT_CACHE": str(tmp_path / "own"), "PYTHONPATH": str(CHECKOUT)}
    done = subprocess.run(
        [sys.executable, str(script), *arguments],
        env={**environment, **variables},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@needs_target
def test_kernels_of_one_computer_are_used_on_others(tmp_path: Path) -> None:
    folder = tmp_path / "carried"
    assert compile_one(tmp_path, "carry", str(folder), platform.machine()) == "0 1"
    assert compile_one(tmp_path, "use", **{VARIABLE: str(folder)}) == "1 0"
    assert not [path for path in (tmp_path / "own").rglob("*.nb?") if not path.is_symlink()]
    # A lost kernel is compiled in place of its link.
    own = next((tmp_path / "own").rglob("*.nbi"))
    own.unlink()
    own.symlink_to(tmp_path / "gone")
    assert compile_one(tmp_path, "use", **{VARIABLE: str(folder)}) == "0 1"
    assert compile_one(tmp_path, "use", **{VARIABLE: str(folder)}) == "1 0"
    assert not own.is_symlink()
    assert compile_one(tmp_path, "use") == "0 1"


@needs_target
def test_a_processor_without_the_features_compiles_its_own_kernels(tmp_path: Path) -> None:
    folder = tmp_path / "carried"
    compile_one(tmp_path, "carry", str(folder), platform.machine())
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("flags\t: fpu sse2\nFeatures\t: fp asimd\n")
    assert compile_one(tmp_path, "lesser", str(cpuinfo), **{VARIABLE: str(folder)}).split()[1] == "1"


def test_every_core_must_have_the_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    monkeypatch.setattr(prebuilt, "CPUINFO", cpuinfo)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    able = " ".join(X86_64_V3.flags)
    lesser = " ".join(X86_64_V3.flags - {"avx2"})
    for cores, runs in (((able, able + " avx512f"), True), ((able, lesser), False), ((), False)):
        cpuinfo.write_text("".join(f"processor\t: {n}\nflags\t\t: {flags}\n\n" for n, flags in enumerate(cores)))
        assert X86_64_V3.runs_here() is runs
    cpuinfo.unlink()
    assert not X86_64_V3.runs_here()
    cpuinfo.write_text(f"flags\t\t: {able}\n")
    assert X86_64_V3.runs_here()
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert not X86_64_V3.runs_here()


def test_only_existing_kernels_of_this_state_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target("any", platform.machine(), "any-cpu", frozenset())
    monkeypatch.setattr(prebuilt, "TARGETS", (target,))
    monkeypatch.setattr(prebuilt, "_flags", lambda _machine: frozenset())
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    monkeypatch.delenv(VARIABLE, raising=False)
    kernels = tmp_path / "any" / "kernels-state"
    kernels.mkdir(parents=True)
    assert carried("state") is None
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert carried("other") is None
    assert carried("state") == (target, kernels)
    # A process configured for another processor compiles for it.
    monkeypatch.setenv("NUMBA_CPU_NAME", "host")
    assert carried("state") is None


def test_links_are_made_once_and_for_each_release(tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    folders = []
    for release in ("first", "second"):
        kernels = tmp_path / release / "kernels-state"
        (kernels / "module").mkdir(parents=True)
        (kernels / "module" / "kernel.nbi").write_text(release)
        folders.append(link(kernels, own))
        assert (folders[-1] / "module" / "kernel.nbi").read_text() == release
    assert sorted(own.iterdir()) == sorted(folders)
    compiled = folders[0] / "module" / "kernel.nbi"
    compiled.unlink()
    compiled.write_text("compiled here")
    assert link(tmp_path / "first" / "kernels-state", own) == folders[0]
    assert compiled.read_text() == "compiled here"
