# SPDX-License-Identifier: Apache-2.0
"""Parts of `make image-test` without QEMU, and the whole test if an image exists."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest

from edge_unit.config import ENVIRONMENT_PREFIX, UnitConfig
from edge_unit.sources.simulated import SimulatedSourceConfig
from geometry.compilation.kernel_state import FOLDERS
from qualification import image as image_test
from qualification.image import Watch, main, why_not
from qualification.machines.arm64_boards import Board
from qualification.machines.containers import MachineError
from qualification.machines.image_parts import COMPILED_BY, forget_all_but_newest, state_to_compile
from shared.configuration import load

CHECKOUT = Path(__file__).parents[2]
PARTS = Path(os.environ.get("CELLWATCH_IMAGE_TEST", CHECKOUT / "out" / "image-test"))

LOCK = ("numba==0.68.1 --hash=sha256:00", "numpy==2.4.6 --hash=sha256:11", "httpx==0.28.1 --hash=sha256:22")


def boards(tmp_path: Path) -> list[Board]:
    return [Board(number, tmp_path / "image", tmp_path / f"{number}.log") for number in range(2)]


# ---------------------------------------------------------------- boards


def test_boards_differ_by_address_and_camera_and_by_nothing_else(tmp_path: Path) -> None:
    first, second = (board.command() for board in boards(tmp_path))
    changed = [(a, b) for a, b in zip(first, second, strict=True) if a != b]
    for (ours, theirs), (was, becomes) in zip(
        changed, (("CAMERA=0", "CAMERA=1"), ("tap0", "tap1"), ("cc:00:10", "cc:00:11")), strict=True
    ):
        assert ours.replace(was, becomes) == theirs


def test_the_camera_of_a_board_is_valid_for_a_unit(tmp_path: Path) -> None:
    words = boards(tmp_path)[1].command()
    told = next(word for word in words[words.index("-append") + 1].split() if word.startswith("systemd.setenv="))
    name, value = told.removeprefix("systemd.setenv=").split("=")
    config = tmp_path / "unit.yaml"
    config.write_text("source: {kind: simulated, cameras: 2}\n")
    source = load(UnitConfig, config, {name: value}, ENVIRONMENT_PREFIX, {}).source
    assert isinstance(source, SimulatedSourceConfig)
    assert source.camera == 1


def test_a_board_is_expected_under_the_name_that_its_first_boot_gives_it(tmp_path: Path) -> None:
    board = boards(tmp_path)[1]
    card = tmp_path / "net" / "eth0"
    (card / "device").mkdir(parents=True)
    (card / "address").write_text(board.address + "\n")
    functions = (CHECKOUT / "deploy/image/first-boot").read_text().split("\nif [ ! -s /etc/hostname ]")[0]
    script = f"{functions}\nNETWORK={tmp_path / 'net'}\nown_name\n"
    named = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True)
    assert named.stdout.strip() == board.name


def test_a_board_that_goes_off_is_reported_with_its_console(tmp_path: Path) -> None:
    board = boards(tmp_path)[0]
    board.console.write_text("".join(f"line {number}\r\n" for number in range(200)))
    board._process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
    board._process.wait()
    with pytest.raises(MachineError, match=f"{board.name}: went off by itself, code 3"):
        board.require_running()
    assert board.tail().splitlines()[-1] == "line 199"
    assert len(board.tail().splitlines()) < 100


# ---------------------------------------------------------------- findings


class Running(Board):
    """A board that is always on."""

    def require_running(self) -> None:
        """Do nothing: the board runs."""


def watch_of(tmp_path: Path, rows: list[dict[str, Any]], leases: str) -> Watch:
    (tmp_path / "leases").write_text(leases)
    transport = httpx.MockTransport(lambda _: httpx.Response(200, json=rows))
    client = httpx.Client(transport=transport, base_url="http://10.77.0.1:8420")
    return Watch(
        [Running(number, tmp_path, tmp_path / "log") for number in range(2)],
        tmp_path / "leases",
        client,
    )


def lease(ip: str, name: str) -> str:
    return f"1700000000 52:54:00:cc:00:10 {ip} {name} ff:00\n"


def test_seconds_are_those_of_the_last_board_and_none_while_one_is_missing(tmp_path: Path) -> None:
    rows = [{"ip": "10.77.0.50", "voxels": 7}, {"ip": "10.77.0.51", "voxels": 0}]
    leases = lease("10.77.0.50", "cellwatch-cc0010") + lease("10.77.0.51", "cellwatch-cc0011")
    watch = watch_of(tmp_path, rows, leases)
    assert not watch.all_report()
    found = watch.document()
    assert (found["machines_posting"], found["distinct_names"]) == (1, 2)
    assert found["seconds_power_on_to_first_voxel"] is None
    assert len(found["seconds_power_on_to_registered"]) == 2
    rows[1]["voxels"] = 3
    assert watch.all_report()
    found = watch.document()
    assert found["machines_posting"] == 2
    assert found["seconds_power_on_to_first_voxel"] == max(watch.first_voxel_s.values())


@pytest.mark.parametrize(
    ("first", "second", "distinct"),
    [
        ("cellwatch-cc0010", "cellwatch-cc0011", 2),
        ("cellwatch-cc0010", "cellwatch-cc0010", 1),
        ("debian", "debian", 0),
        ("cellwatch-cc0010", "*", 1),
    ],
)
def test_only_names_that_boards_made_of_their_own_addresses_count(
    tmp_path: Path, first: str, second: str, distinct: int
) -> None:
    watch = watch_of(tmp_path, [], lease("10.77.0.50", first) + lease("10.77.0.51", second))
    assert watch.document()["distinct_names"] == distinct


def test_the_last_line_is_json_whatever_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(image_test, "why_not", lambda building: "there is no QEMU here")
    assert main(["--parts", str(tmp_path), "--no-results"]) == 1
    out, err = capsys.readouterr()
    document = json.loads(out.splitlines()[-1])
    assert document["error"] == "there is no QEMU here"
    assert document["machines_posting"] == document["distinct_names"] == 0
    assert {"seconds_power_on_to_first_voxel", "image_mb", "payload_mb"} <= set(document)
    assert "there is no QEMU here" in err


def test_all_packages_that_are_missing_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(image_test, "allowed", lambda unshare: True)
    monkeypatch.setenv("PATH", "")
    packages = "dnsmasq-base iproute2 qemu-system-arm"
    assert why_not() == f"missing: apt-get install {packages}"
    reason = why_not(building=True) or ""
    assert set(reason.removeprefix("missing: apt-get install ").split()) == {
        *packages.split(),
        *(
            "arch-test",
            "binfmt-support",
            "cpio",
            "e2fsprogs",
            "fdisk",
            "kmod",
            "mmdebstrap",
            "qemu-user-static",
            "systemd",
        ),
    }


# ---------------------------------------------------------------- kernels of an earlier run


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """Copy all files that decide which kernels are compiled."""
    for name in (*FOLDERS, *COMPILED_BY):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (CHECKOUT / name).is_dir() else shutil.copy
        copy(CHECKOUT / name, tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("name", [f"{FOLDERS[0]}/voxelize.py", *COMPILED_BY])
def test_a_change_of_a_kernel_is_another_state(sources: Path, name: str) -> None:
    before = state_to_compile(sources, LOCK)
    (sources / name).write_text("two")
    assert state_to_compile(sources, LOCK) != before


def test_another_compiler_is_another_state_and_another_client_is_not(sources: Path) -> None:
    before = state_to_compile(sources, LOCK)
    assert state_to_compile(sources, reversed(LOCK)) == before
    assert state_to_compile(sources, (*LOCK[:2], "httpx==0.29.0 --hash=sha256:33")) == before
    assert state_to_compile(sources, ("numba==0.68.2 --hash=sha256:44", *LOCK[1:])) != before


def test_kernels_that_were_used_last_are_kept(tmp_path: Path) -> None:
    for age, name in enumerate(("newest", "middle", "oldest")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "kernel.nbc").write_text("")
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    forget_all_but_newest(tmp_path, 2)
    assert {path.name for path in tmp_path.iterdir()} == {"newest", "middle"}


# ---------------------------------------------------------------- the whole test


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(700)
@pytest.mark.skipif(why_not() is not None, reason=f"no boards can be emulated here: {why_not()}")
@pytest.mark.skipif(
    not (PARTS / "image" / "disk.img").exists(), reason="there is no image: `make image-test` builds it"
)
def test_two_boards_of_one_image_find_a_master_and_report() -> None:
    command = [sys.executable, "-m", "qualification.image", "--parts", str(PARTS), "--no-build", "--no-results"]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=680, check=False)
    document = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 0, (document, done.stderr[-4000:])
    assert document["machines_posting"] == document["distinct_names"] == 2
