# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from geometry.compilation import cache, kernel_state
from geometry.compilation.kernel_state import FOLDERS, PLACE, state_of_kernels
from shared.errors import JitCacheError

CHECKOUT = Path(__file__).resolve().parents[3]
KERNEL_FILES = sorted(file.relative_to(PLACE) for folder in FOLDERS for file in (PLACE / folder).glob("*.py"))


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Copy all files with kernels, and the module that computes their digest."""
    for folder in (*FOLDERS, "geometry/compilation"):
        shutil.copytree(PLACE / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_a_change_of_any_kernel_file_changes_the_digest(place: Path) -> None:
    assert len(KERNEL_FILES) > 20
    states = {state_of_kernels(place)}
    for file in KERNEL_FILES:
        (place / file).write_text((place / file).read_text() + "# changed\n")
        states.add(state_of_kernels(place))
    assert len(states) == 1 + len(KERNEL_FILES)


def test_a_renamed_kernel_changes_the_digest(place: Path) -> None:
    before = state_of_kernels(place)
    (place / KERNEL_FILES[0]).rename((place / KERNEL_FILES[0]).with_name("renamed.py"))
    assert state_of_kernels(place) != before


def test_a_copy_has_the_digest_of_its_source_at_any_path(place: Path) -> None:
    assert state_of_kernels(place) == state_of_kernels()


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_without_kernels_is_an_error(place: Path, folder: str) -> None:
    (place / folder).rename(place / "elsewhere")
    with pytest.raises(FileNotFoundError, match=f"{folder}: expected the kernels' source"):
        state_of_kernels(place)


def test_without_kernels_no_folder_is_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "state_of_kernels", lambda: state_of_kernels(tmp_path))
    with pytest.raises(JitCacheError, match="expected the kernels' source"):
        cache.settle(tmp_path / "cache")


def test_a_release_prints_its_digest_with_nothing_installed(place: Path) -> None:
    script = [sys.executable, "-I", "-S", "-B", str(place / "geometry/compilation/kernel_state.py")]
    done = subprocess.run(script, capture_output=True, text=True, timeout=30.0, check=True)
    assert done.stdout.strip() == state_of_kernels()
    shutil.rmtree(place / FOLDERS[0])
    refused = subprocess.run(script, capture_output=True, text=True, timeout=30.0, check=False)
    assert refused.returncode == 1
    assert refused.stderr.startswith("kernel_state: ")
    assert FOLDERS[0] in refused.stderr


def test_every_file_with_kernels_counts() -> None:
    uses_numba = re.compile(r"^(?:import numba|from numba|from geometry\.kernels\.jit) ?", re.MULTILINE)
    having = {
        file.relative_to(CHECKOUT)
        for package in ("shared", "geometry", "edge_unit", "master_server", "simulation", "benchmarks", "qualification")
        for file in (CHECKOUT / package).rglob("*.py")
        if uses_numba.search(file.read_text(encoding="utf-8"))
    }
    assert having <= set(KERNEL_FILES)
    assert Path("geometry/kernels/voxelize.py") in having


def test_the_digest_has_the_stated_length() -> None:
    assert re.fullmatch(rf"[0-9a-f]{{{kernel_state.DIGITS}}}", state_of_kernels())
