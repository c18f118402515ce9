# SPDX-License-Identifier: Apache-2.0
"""Customisation of a small root file system to a unit; no network, no board, nothing emulated."""

from __future__ import annotations

import base64
import ensurepip
import hashlib
import os
import re
import shutil
import struct
import subprocess
import tempfile
import zipfile
from pathlib import Path

import pytest

from geometry.compilation.kernel_state import FOLDERS, state_of_kernels

CHECKOUT = Path(__file__).resolve().parents[2]
IMAGE = CHECKOUT / "deploy" / "image"
SCRIPTS = sorted(path for path in IMAGE.iterdir() if path.is_file())
LOCKS = sorted((IMAGE / "locks").glob("*.txt"))

TOKEN = "unit-token-0123456789abcdef"
AARCH64, X86_64 = 183, 62

KERNELS = ""

needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("systemd-sysusers") is None, reason="needs root and systemd's tools"
)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_sound(script: Path) -> None:
    first = script.read_text().splitlines()[0]
    shell = "bash" if first.endswith("bash") else "sh"
    assert script.stat().st_mode & 0o111
    assert subprocess.run([shell, "-n", str(script)], check=False).returncode == 0
    if shutil.which("shellcheck"):
        checked = subprocess.run(["shellcheck", "-x", str(script)], capture_output=True, text=True, check=False)
        assert checked.returncode == 0, checked.stdout


def test_both_systems_of_jetsons_are_locked() -> None:
    assert [lock.name for lock in LOCKS] == ["edge-realsense-cp310-aarch64.txt", "edge-realsense-cp312-aarch64.txt"]


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: path.name)
def test_every_wheel_is_known_by_its_hash_and_none_by_its_place(lock: Path) -> None:
    lines = [line.strip(" \\") for line in lock.read_text().splitlines() if not line.startswith("#")]
    names = [line for line in lines if not line.startswith("--hash=")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", name) for name in names)
    assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", line) for line in lines if line.startswith("--hash="))
    assert len([line for line in lines if line.startswith("--hash=")]) >= len(names)
    locked = {name.split("==")[0] for name in names}
    assert {"libusb-package", "numba", "numpy", "pyrealsense2", "zeroconf", "pip"} <= locked
    pinned = (IMAGE.parents[1] / "constraints.txt").read_text()
    for name in names:
        assert name in pinned, f"{name} is not what constraints.txt has: run deploy/image/wheelhouse --lock"


class Bench:
    """A nearly empty root file system, and wheels that are as small."""

    def __init__(self, folder: Path, version: str = "3.12", machine: int = AARCH64) -> None:
        self.folder = folder
        self.root = folder / "root"
        self.wheels = folder / "wheels"
        for path in ("usr/bin", "usr/lib/aarch64-linux-gnu", "etc/systemd", "etc/ssh", "root", "var/lib/dhcp"):
            (self.root / path).mkdir(parents=True)
        self.put("usr/bin/env", "").chmod(0o755)
        interpreter = self.put(f"usr/bin/python{version}", "")
        interpreter.write_bytes(b"\x7fELF" + bytes(14) + struct.pack("<H", machine))
        (self.root / "usr/bin/python3").symlink_to(f"python{version}")
        for library in ("libudev.so.1", "libstdc++.so.6"):
            self.put(f"usr/lib/aarch64-linux-gnu/{library}", "")
        self.fill_wheelhouse(version)
        self.put_beside("unit.token", TOKEN + "\n")

    def put(self, path: str, text: str) -> Path:
        (self.root / path).write_text(text)
        return self.root / path

    def put_beside(self, name: str, text: str) -> str:
        (self.folder / name).write_text(text)
        return str(self.folder / name)

    def fill_wheelhouse(self, version: str) -> None:
        self.wheels.mkdir(exist_ok=True)
        (self.wheels / "about").write_text(f"python={version}\narch=aarch64\nextras=edge,realsense\n")
        pip = next((Path(ensurepip.__file__).parent / "_bundled").glob("pip-*.whl"))
        shutil.copy(pip, self.wheels)
        ours = self.wheels / "cellwatch-0.1.0-py3-none-any.whl"
        info = "cellwatch-0.1.0.dist-info"
        files = {
            "edge_unit/__init__.py": "",
            **self.sources(KERNELS),
            f"{info}/METADATA": "Metadata-Version: 2.1\nName: cellwatch\nVersion: 0.1.0\n",
            f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        }
        record = [f"{name},sha256={digest(text.encode())},{len(text)}" for name, text in files.items()]
        with zipfile.ZipFile(ours, "w") as wheel:
            for name, text in files.items():
                wheel.writestr(name, text)
            wheel.writestr(f"{info}/RECORD", "\n".join([*record, f"{info}/RECORD,,"]) + "\n")
        lines = []
        for wheel_file in sorted(self.wheels.glob("*.whl")):
            name, release, *_ = wheel_file.name.split("-")
            lines.append(f"{name}=={release} --hash=sha256:{hashlib.sha256(wheel_file.read_bytes()).hexdigest()}")
        (self.wheels / "lock.txt").write_text("\n".join(lines) + "\n")

    def customise(self, *options: str) -> subprocess.CompletedProcess[str]:
        command = [str(IMAGE / "customize-rootfs"), str(self.root), "--wheelhouse", str(self.wheels), *options]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    def sources(self, kernels: str) -> dict[str, str]:
        """Return the files of a release whose kernels are `kernels`."""
        state = "geometry/compilation/kernel_state.py"
        return {state: (CHECKOUT / state).read_text()} | {f"{folder}/some.py": kernels for folder in FOLDERS}

    def state(self, kernels: str) -> str:
        """Return the state of a release whose kernels are `kernels`."""
        with tempfile.TemporaryDirectory(dir=self.folder) as place:
            for name, text in self.sources(kernels).items():
                (Path(place) / name).parent.mkdir(parents=True, exist_ok=True)
                (Path(place) / name).write_text(text)
            return state_of_kernels(Path(place))

    def compile_kernels(self, source: str, python: str = "py312") -> str:
        """Write the output of `edge-unit compile-kernels` for kernels of this source."""
        state = self.state(source)
        kernels = self.folder / f"compiled-{state}-{python}"
        place = kernels / "armv8.2-a" / f"kernels-{state}" / "kernels_0123"
        place.mkdir(parents=True)
        (place / f"points.count-1.{python}.1.nbc").write_bytes(b"code")
        (place / f"points.count-1.{python}.nbi").write_bytes(b"index")
        return str(kernels)

    def tree(self) -> dict[str, tuple[int, int, bytes]]:
        """Return all files, except compiled bytecode."""
        found = {}
        for path in sorted(self.root.rglob("*")):
            if "__pycache__" not in path.parts and not path.is_dir():
                content = os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
                found[str(path.relative_to(self.root))] = path.lstat().st_mode, path.lstat().st_gid, content
        return found


def digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


@needs_root
def test_a_root_file_system_becomes_a_unit_and_nothing_of_the_builder_goes_along(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.put("etc/machine-id", "0123456789abcdef0123456789abcdef\n")
    bench.put("etc/hostname", "builder\n")
    bench.put("etc/hosts", "127.0.0.1\tlocalhost\n127.0.1.1\tbuilder\n")
    bench.put("etc/ssh/ssh_host_ed25519_key", "secret")
    bench.put("var/lib/dhcp/dhclient.leases", "lease")
    key = bench.put_beside("key.pub", "ssh-ed25519 AAAA operator\n")
    options = ("--token", str(tmp_path / "unit.token"), "--master", "http://10.0.0.2:8420", "--ssh-key", key)
    done = bench.customise(*options)
    assert done.returncode == 0, done.stderr

    etc = bench.root / "etc"
    assert (etc / "machine-id").read_text() == ""
    assert (etc / "hosts").read_text() == "127.0.0.1\tlocalhost\n"
    for gone in ("etc/hostname", "etc/ssh/ssh_host_ed25519_key", "var/lib/dhcp/dhclient.leases"):
        assert not (bench.root / gone).exists()
    assert (bench.root / "root/.ssh/authorized_keys").read_text() == "ssh-ed25519 AAAA operator\n"

    assert (etc / "cellwatch/unit.yaml").read_text().splitlines()[1:] == [
        "master_url: http://10.0.0.2:8420",
        "token_file: /etc/cellwatch/unit.token",
        "source: {kind: realsense}",
    ]
    token = etc / "cellwatch/unit.token"
    group = re.search(r"^cellwatch:[^:]*:(\d+):", (etc / "group").read_text(), re.MULTILINE)
    assert group is not None
    assert (token.read_text().strip(), token.stat().st_mode & 0o777) == (TOKEN, 0o640)
    assert (token.stat().st_uid, token.stat().st_gid) == (0, int(group.group(1)))

    assert (bench.root / "opt/cellwatch/current/site/edge_unit/__init__.py").exists()
    assert not (bench.root / "opt/cellwatch/current/site/pip").exists()
    assert (etc / "systemd/system/multi-user.target.wants/edge-unit.service").is_symlink()
    assert (etc / "systemd/system/sysinit.target.wants/cellwatch-firstboot.service").is_symlink()
    assert (etc / "udev/rules.d/70-cellwatch-realsense.rules").exists()

    before = bench.tree()
    again = bench.customise(*options)
    assert again.returncode == 0, again.stderr
    assert bench.tree() == before


@needs_root
def test_newer_wheels_are_another_release_and_the_one_before_stays(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.customise().returncode == 0
    first = os.readlink(bench.root / "opt/cellwatch/current")
    (bench.wheels / "lock.txt").write_text((bench.wheels / "lock.txt").read_text() + "\n")
    assert bench.customise().returncode == 0
    second = os.readlink(bench.root / "opt/cellwatch/current")
    assert second != first
    assert (bench.root / "opt/cellwatch" / first / "site/edge_unit").is_dir()


@needs_root
def test_a_wheel_that_is_not_the_locked_one_is_not_installed(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    with (bench.wheels / "cellwatch-0.1.0-py3-none-any.whl").open("ab") as wheel:
        wheel.write(b"more")
    done = bench.customise()
    assert done.returncode != 0
    assert "HASHES" in done.stderr
    assert not (bench.root / "opt/cellwatch/current").exists()


@needs_root
@pytest.mark.parametrize(
    ("version", "machine", "reason"),
    [
        ("3.8", AARCH64, "its Python is 3.8: expected 3.10 (JetPack 6) or 3.12 (JetPack 7)"),
        ("3.11", AARCH64, "its Python is 3.11, and pyrealsense2 exists for 3.10 (JetPack 6) and 3.12 (JetPack 7)"),
        ("3.12", X86_64, "the wheelhouse is for Python 3.12 on aarch64, the root file system has 3.12 on x86_64"),
        ("3.12", 40, "its processor is neither aarch64 nor x86_64"),
    ],
)
def test_another_system_is_refused_with_the_reason(tmp_path: Path, version: str, machine: int, reason: str) -> None:
    bench = Bench(tmp_path, version, machine)
    done = bench.customise()
    assert done.returncode == 1
    assert done.stderr.startswith(f"customize-rootfs: {reason}")
    assert not (bench.root / "opt").exists()


@needs_root
def test_missing_and_contradictory_options_are_named(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    token = bench.put_beside("bad.token", "two lines\nof text\n")
    assert "expected a token in one line" in bench.customise("--token", token).stderr
    config = bench.put_beside("unit.yaml", "source: {kind: realsense}\n")
    assert "got both" in bench.customise("--config", config, "--master", "http://10.0.0.2:8420").stderr
    assert "expected the folder with cell.yaml" in bench.customise("--role", "master").stderr
    (bench.root / "usr/lib/aarch64-linux-gnu/libudev.so.1").unlink()
    assert "libudev.so.1 is missing" in bench.customise().stderr
    assert not (bench.root / "opt").exists()


@needs_root
def test_kernels_are_carried_in_the_release_that_they_fit_and_kept_for_the_next_image(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    state = bench.state(KERNELS)
    kernel = tmp_path / "kernels" / "armv8.2-a" / f"kernels-{state}" / "kernels_0" / "voxelize.py312.1.nbc"
    kernel.parent.mkdir(parents=True)
    kernel.write_text("compiled")
    done = bench.customise("--kernels", str(tmp_path / "kernels"), "--keep-kernels", str(tmp_path / "kept"))
    assert done.returncode == 0, done.stderr
    name = kernel.relative_to(tmp_path / "kernels")
    assert (bench.root / "opt/cellwatch/current/kernels" / name).read_text() == "compiled"
    assert (tmp_path / "kept" / name).read_text() == "compiled"


@needs_root
def test_kernels_of_the_same_release_go_along(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    done = bench.customise("--kernels", bench.compile_kernels(KERNELS))
    assert done.returncode == 0, done.stderr
    carried = list((bench.root / "opt/cellwatch/current/kernels").rglob("*.nbc"))
    assert [path.read_bytes() for path in carried] == [b"code"]
    assert all(path.stat().st_mode & 0o777 == 0o644 and path.stat().st_uid == 0 for path in carried)
    for other in (bench.compile_kernels("# others\n"), bench.compile_kernels(KERNELS, "py310")):
        refused = bench.customise("--kernels", other)
        assert "its kernels are of another release or another Python" in refused.stderr
        assert refused.returncode == 1
    assert list((bench.root / "opt/cellwatch/current/kernels").rglob("*.nbc")) == carried
    assert "expected a folder that edge-unit compile-kernels filled" in bench.customise("--kernels", "nowhere").stderr


@needs_root
def test_where_they_cannot_be_compiled_the_board_does_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    done = bench.customise()
    assert done.returncode == 0
    assert "each board compiles its kernels at its first start" in done.stderr
    assert not list((bench.root / "opt/cellwatch/current").glob("kernels*"))
    assert "compiles" not in bench.customise("--kernels", "none").stderr


@needs_root
def test_a_board_that_is_master_and_unit_needs_the_wheels_of_both(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.customise().returncode == 0
    (bench.folder / "cell").mkdir()
    cell = bench.put_beside("cell/cell.yaml", "name: cell\n")
    refused = bench.customise("--role", "master", "--cell", str(Path(cell).parent))
    assert "master-server also runs there: build the wheelhouse with --extras edge,realsense,master" in refused.stderr
    assert not (bench.root / "etc/systemd/system/master-server.service").exists()


@needs_root
def test_the_tree_of_linux_for_tegra_is_customised_in_place(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    tegra = tmp_path / "Linux_for_Tegra"
    tegra.mkdir()
    bench.root = bench.root.rename(tegra / "rootfs")
    command = [str(IMAGE / "build-image"), "--l4t", str(tegra), "--", "--wheelhouse", str(bench.wheels)]
    command += ["--token", str(tmp_path / "unit.token")]
    early = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (early.returncode, "run NVIDIA's apply_binaries.sh first" in early.stderr) == (1, True)
    assert not (bench.root / "opt").exists()
    bench.put("etc/nv_tegra_release", "# R36 (release), REVISION: 4.3\n")
    (bench.root / "etc/systemd/system").mkdir(parents=True, exist_ok=True)
    bench.put("etc/systemd/system/nv-oem-config.service", "[Service]\nExecStart=/bin/true\n")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "l4t_initrd_flash.sh" in done.stdout
    assert (bench.root / "etc/systemd/system/multi-user.target.wants/edge-unit.service").is_symlink()
    assert os.readlink(bench.root / "etc/systemd/system/nv-oem-config.service") == "/dev/null"
