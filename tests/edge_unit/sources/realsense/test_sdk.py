# SPDX-License-Identifier: Apache-2.0
"""The RealSense SDK finds its libusb on a machine without one, and reports it if there is none at all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HIDDEN = """
import ctypes, os, sys
whole = ctypes.CDLL
def without(name, *rest, **options):
    if str(name) in {hidden}:
        raise OSError(f"{{name}}: cannot open shared object file")
    return whole(name, *rest, **options)
ctypes.CDLL = without
"""
"""For a process of its own: a library that is loaded by one of these names is not there."""


def run(script: str, hidden: str = "()", path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A process that ends without the SDK's destructors, which are known to abort."""
    environment = {"PYTHONPATH": str(path or ""), "PATH": ""}
    command = (sys.executable, "-c", HIDDEN.format(hidden=hidden) + script + "\nsys.stdout.flush()\nos._exit(0)")
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)


LOADED = """
from edge_unit.sources.realsense.sdk import LIBUSB_OF, rs
maps = open("/proc/self/maps").read().split()
rs.context().query_devices()
print(LIBUSB_OF, *sorted({path for path in maps if "libusb" in path}), sep="\\n")
"""


def test_without_the_systems_libusb_that_of_the_package_is_the_only_one() -> None:
    ended = run(LOADED, "('libusb-1.0.so.0',)")
    assert ended.returncode == 0, ended.stderr
    whose, *libraries = ended.stdout.splitlines()
    assert whose == "libusb-package"
    assert [Path(library).parts[-2:] for library in libraries] == [("libusb_package", "libusb-1.0.so")]


def test_one_libusb_is_loaded_whichever_there_is() -> None:
    ended = run(LOADED)
    assert ended.returncode == 0, ended.stderr
    whose, *libraries = ended.stdout.splitlines()
    assert len(libraries) == 1
    assert ("libusb_package" in libraries[0]) == (whose == "libusb-package")


ASKED = """
import asyncio
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from shared.errors import SourceError
try:
    asyncio.run(RealsenseSource(RealsenseSourceConfig()).open())
except SourceError as error:
    print(error)
"""


def test_without_the_sdk_the_error_names_the_packages_to_install(tmp_path: Path) -> None:
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('no such SDK')")
    ended = run(ASKED, path=tmp_path)
    assert ended.stdout.startswith("the RealSense SDK cannot be loaded: no such SDK; install the packages ")
    assert "pip install 'cellwatch[realsense]'" in ended.stdout


def test_without_libusb_the_error_names_both_ways_to_get_it(tmp_path: Path) -> None:
    # A package without a library, before the real one on the path; the process that captures has the same path.
    (tmp_path / "libusb_package").mkdir()
    (tmp_path / "libusb_package" / "__init__.py").touch()
    (tmp_path / "sitecustomize.py").write_text(HIDDEN.format(hidden="('libusb-1.0.so.0',)"))
    ended = run(ASKED, path=tmp_path)
    assert ended.stdout.startswith(
        "the RealSense SDK cannot be loaded: libusb-1.0 is neither in the system nor in the package libusb-package ("
    )
    assert "pip install 'cellwatch[realsense]'" in ended.stdout
    assert "apt-get install libusb-1.0-0" in ended.stdout
