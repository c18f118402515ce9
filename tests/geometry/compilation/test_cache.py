# SPDX-License-Identifier: Apache-2.0
"""The folder of compiled kernels, tested in separate processes, since importing the package chooses it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from geometry.compilation import cache as jit_cache
from geometry.compilation.prebuilt import PARTIAL
from shared.errors import JitCacheError

COMPILE = """
import logging, sys
logging.basicConfig(level=logging.WARNING, format="%(message)s")
import geometry
from geometry.compilation.cache import settle
if len(sys.argv) > 1:
    settle(sys.argv[1])
import numba
@numba.njit(cache=True)
def twice(x):
    return 2 * x
assert twice(21) == 42
print(numba.config.CACHE_DIR)
"""


def compile_with(tmp_path: Path, *arguments: str, **variables: str) -> tuple[str, str]:
    """Compile a kernel in a new process; return the folder that numba uses, and the log."""
    script = tmp_path / "compile.py"
    script.write_text(COMPILE)
    environment = {name: text for name, text in os.environ.items() if name not in jit_cache.VARIABLES}
    done = subprocess.run(
        [sys.executable, str(script), *arguments],
        env={**environment, "TMPDIR": str(tmp_path), **variables},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=True,
    )
    return done.stdout.strip(), done.stderr.strip()


def test_the_default_is_the_folder_of_numba(tmp_path: Path) -> None:
    found, logged = compile_with(tmp_path)
    assert Path(found).parent in jit_cache._numba_choices()
    assert logged == ""


@pytest.mark.parametrize("variable", jit_cache.VARIABLES)
def test_a_folder_from_the_environment(tmp_path: Path, variable: str) -> None:
    folder = str(tmp_path / "kernels")
    found, logged = compile_with(tmp_path, **{variable: folder})
    assert Path(found).parent == Path(folder)
    assert logged == ""
    assert any((tmp_path / "kernels").rglob("*.nbi"))


def test_a_folder_from_the_configuration_wins(tmp_path: Path) -> None:
    chosen = str(tmp_path / "chosen")
    found, logged = compile_with(tmp_path, chosen, CELLWATCH_JIT_CACHE=str(tmp_path / "other"))
    assert str(Path(found).parent) == chosen
    assert logged == ""


def test_an_unwritable_folder_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    wanted = str(tmp_path / "file" / "kernels")
    for arguments, variables in (((wanted,), {}), ((), {"NUMBA_CACHE_DIR": wanted})):
        found, logged = compile_with(tmp_path, *arguments, **variables)
        assert Path(found).parent.parent == tmp_path
        assert wanted in logged
        assert "CELLWATCH_JIT_CACHE" in logged
        assert logged.count("\n") == 0
        assert Path(found).parent.stat().st_mode & 0o777 == 0o700


def test_without_a_writable_folder_a_private_one_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for variable in jit_cache.VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(jit_cache, "_numba_choices", lambda: [tmp_path / "file" / "a", tmp_path / "file" / "b"])
    monkeypatch.setattr(jit_cache, "_use", lambda folder: folder)
    monkeypatch.setattr(jit_cache.tempfile, "tempdir", str(tmp_path))
    (tmp_path / "file").write_text("")
    first = jit_cache.settle()
    assert first == jit_cache.settle()
    assert f"{tmp_path}/file/a nor {tmp_path}/file/b cannot be written" in caplog.text


def test_a_temporary_folder_that_others_may_have_filled_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jit_cache.tempfile, "tempdir", str(tmp_path))
    open_to_all = tmp_path / f"cellwatch-jit-{os.getuid()}"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    assert jit_cache._private_folder() != open_to_all
    open_to_all.rmdir()
    open_to_all.symlink_to(tmp_path)
    assert not jit_cache._private_folder().is_symlink()


def test_an_error_names_the_lack_of_any_writable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(jit_cache.tempfile, "tempdir", str(tmp_path / "file"))
    with pytest.raises(JitCacheError, match="not even a temporary one"):
        jit_cache._private_folder()


def test_each_state_of_the_kernels_has_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """numba does not detect a change of a kernel or a constant in another file."""
    monkeypatch.setattr(jit_cache.os, "environ", dict(os.environ))
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)
    folders = []
    for state in range(jit_cache.STATES_MAX + 2):
        monkeypatch.setattr(jit_cache, "state_of_kernels", lambda state=state: f"{state:012x}")
        folders.append(jit_cache.settle(tmp_path / "cache"))
        os.utime(folders[-1], (state, state))
        assert jit_cache.settle(folders[-1]) == folders[-1]
        os.utime(folders[-1], (state, state))
    assert len(set(folders)) == len(folders)
    assert sorted((tmp_path / "cache").iterdir()) == sorted(folders[-jit_cache.STATES_MAX :])


def test_incomplete_links_of_a_power_cut_do_not_displace_kept_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jit_cache.os, "environ", dict(os.environ))
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)
    kept = []
    for state in range(jit_cache.STATES_MAX):
        monkeypatch.setattr(jit_cache, "state_of_kernels", lambda state=state: f"{state:012x}")
        kept.append(jit_cache.settle(tmp_path / "cache"))
        os.utime(kept[-1], (1000 + state, 1000 + state))
    left, being_made = (tmp_path / "cache" / f"{PARTIAL}{name}" for name in ("left", "being_made"))
    left.mkdir()
    os.utime(left, (1, 1))
    being_made.mkdir()
    jit_cache.settle(tmp_path / "cache")
    assert sorted((tmp_path / "cache").iterdir()) == sorted([*kept, being_made])


DAMAGE = {
    "emptied": lambda content: b"",
    "cut": lambda content: content[: len(content) * 2 // 3],
    "zeros": lambda content: bytes(len(content)),
    "something else": lambda content: b"<html>" + content,
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_a_damaged_kernel_is_compiled_again(tmp_path: Path, kind: str, damage: str) -> None:
    folder, logged = compile_with(tmp_path, str(tmp_path / "cache"))
    assert logged == ""
    (file,) = Path(folder).glob(f"*/*.{kind}")
    whole = file.read_bytes()
    file.write_bytes(DAMAGE[damage](whole))
    found, logged = compile_with(tmp_path, str(tmp_path / "cache"))
    assert found == folder
    assert logged == f"{file}: damaged; its kernel will be compiled again"
    assert len(file.read_bytes()) > len(whole) // 2
    assert compile_with(tmp_path, str(tmp_path / "cache")) == (folder, "")
