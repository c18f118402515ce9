# SPDX-License-Identifier: Apache-2.0
"""The process that reads a cell's folder from a zip, and its refusals."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from master_server.cells import unpacking
from shared.cell import Cell
from shared.errors import CellError

CHECKOUT = Path(__file__).resolve().parents[3]
DEMO = CHECKOUT / "assets" / "cells" / "demo"
CELL = "name: small\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n"


def zipped(path: Path, files: dict[str, str | bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def read(archive: Path, folder: Path) -> tuple[int, str]:
    """Run the process on an archive; return its exit code and output."""
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, "-m", "master_server.cells.unpacking", str(archive), str(folder)],
        cwd=folder, env={"PYTHONPATH": str(CHECKOUT), "SECRET": str(folder.parent)}, capture_output=True, text=True,
        timeout=60.0, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    return done.returncode, done.stdout.strip()


@pytest.mark.parametrize("top", ["", "mycell/"])
def test_the_demo_cell_is_unchanged_by_unpacking(tmp_path: Path, top: str) -> None:
    files: dict[str, str | bytes] = {f"{top}{file.name}": file.read_bytes() for file in DEMO.glob("*.*")}
    out = tmp_path / "out"
    assert read(zipped(tmp_path / "cell.zip", files), out) == (0, "")
    document = json.loads((out / unpacking.DOCUMENT).read_text())
    meshes = {file.name: file.read_bytes() for file in (out / unpacking.MESHES).iterdir()}
    assert Cell.from_document(document, meshes).version == Cell.load(DEMO / "cell.yaml").version


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"readme.txt": "no cell"}, "zip: expected cell.yaml at its root or in its one top folder, got none"),
        ({"a/cell.yaml": CELL, "b/cell.yaml": CELL}, "got 2 folders with one"),
        ({"cell.yaml": CELL + "statik: []\n"}, "cell.yaml: statik: expected a key out of"),
        ({"cell.yaml": CELL.replace("small", "[1") + "x: 1\n"}, "cell.yaml: line"),
        (
            {"cell.yaml": CELL + "static: [{name: a, mesh: a.stl}, {name: b, mesh: a.stl}]\n", "a.stl": b"solid no"},
            "cell.yaml: static[0].mesh: a.stl: expected",
        ),
        ({"cell.yaml": CELL + "static: [{name: a, mesh: ../../secret.stl}]\n"}, "lies outside of the cell's folder"),
        ({"cell.yaml": CELL + "static: [{name: a, mesh: $SECRET/secret.stl}]\n"}, "outside of the cell's folder"),
        ({"../cell.yaml": CELL}, "zip: ../cell.yaml: expected a path inside of the folder, got one that leaves it"),
        ({"/cell.yaml": CELL}, "got one that leaves it"),
        ({"a\\..\\cell.yaml": CELL}, "got one that leaves it"),
    ],
)
def test_an_invalid_cell_is_reported_in_one_sentence(tmp_path: Path, files: dict[str, str | bytes], said: str) -> None:
    (tmp_path / "secret.stl").write_bytes((DEMO / "tray.stl").read_bytes())
    code, words = read(zipped(tmp_path / "cell.zip", files), tmp_path / "out")
    assert code == 1
    assert said in words
    assert "\n" not in words
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cell.zip", "out", "secret.stl"]


def test_links_are_refused(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("cell.yaml")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "cell.zip", "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(CellError, match=r"cell.yaml: expected a plain file, got a link"):
        unpacking.unpack(tmp_path / "cell.zip", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("bound", "words"),
    [
        ("MAX_FILES", "expected at most 1 files"),
        ("MAX_FILE_BYTES", "expected at most 0 MiB in one file"),
        ("MAX_UNPACKED_BYTES", "expected at most 0 MiB unpacked"),
    ],
)
def test_sizes_and_counts_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str, words: str) -> None:
    archive = zipped(tmp_path / "cell.zip", {"cell.yaml": CELL, "more": b"0" * 100})
    unpacking.unpack(archive, tmp_path / "fits")
    monkeypatch.setattr(unpacking, bound, 1)
    with pytest.raises(CellError, match=words):
        unpacking.unpack(archive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_zip_is_reported_in_one_sentence(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "cell.zip", {"cell.yaml": CELL, "more": bytes(range(256)) * 10})
    data = archive.read_bytes()
    for damaged in (data[:100], b"", data[:50] + b"\xff" * 30 + data[80:]):
        archive.write_bytes(damaged)
        with pytest.raises(CellError, match="got a damaged one"):
            unpacking.unpack(archive, tmp_path / "out")


def test_an_entry_that_claims_less_than_it_holds_is_cut_off(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "cell.zip", {"bomb": b"0" * 10_000_000})
    data = archive.read_bytes()
    archive.write_bytes(data.replace((10_000_000).to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    with pytest.raises(CellError, match="got a damaged one"):
        unpacking.unpack(archive, tmp_path / "out")
    assert (tmp_path / "out" / "bomb").stat().st_size <= 1000
