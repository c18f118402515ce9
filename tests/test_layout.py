# SPDX-License-Identifier: Apache-2.0
"""Structure of the project: listings give the flow, imports follow it, and no file names a machine."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.project_files import project_files

CHECKOUT = Path(__file__).resolve().parent.parent
PACKAGES = ("shared", "geometry", "edge_unit", "master_server", "simulation", "benchmarks", "qualification")
WALLS = {  # package: the packages that it imports, and no others of the project
    "shared": set(),
    "geometry": {"shared"},
    "edge_unit": {"shared", "geometry", "simulation"},
    "master_server": {"shared"},
    "simulation": {"shared", "geometry", "edge_unit"},
    "benchmarks": {"shared", "geometry", "edge_unit", "master_server", "simulation"},
    "qualification": {"shared", "geometry", "edge_unit", "master_server", "simulation", "benchmarks"},
}
KERNELS = ("geometry", "kernels")
KERNEL_IMPORTS = {"__future__", "collections", "math", "numba", "numpy", "typing"}
CLOCK = ("shared", "clock")
MODULES_MAX = 16
"""Modules in a folder. A folder with more needs subfolders."""
LARGE = {("shared",), KERNELS}
"""Folders that may hold more: the shared contract is one list, and so are the kernels."""
BEFORE_SETTLED = (("geometry",), ("geometry", "compilation"))
"""Imported before the folder of compiled kernels is settled, so their re-exports would be defined too early."""
MIRRORED = PACKAGES
"""Packages whose tests lie in folders of the same names."""
WALL_CLOCK_CALLS = {"now", "utcnow", "today"}
LISTED = re.compile(r"^ {4}(\w+/?) +\S", re.MULTILINE)
# In brackets, so that this file does not match itself.
MACHINE = re.compile(
    r"(?<![\w.$}])/(?:(?:[h]ome|[U]sers)/\w|[r]oot/)"
    r"|[p]ypi\.org|python[h]osted|[n]pmjs\.(?:org|com)|deb\.[d]ebian\.org"
)

Module = tuple[str, ...]
Check = Callable[[Path], Iterator[str]]


def listing(package: Path) -> list[str]:
    """Return the names of a package's modules as its docstring lists them; sub-packages end in a slash."""
    source = package / "__init__.py"
    tree = ast.parse(source.read_text()) if source.is_file() else ast.Module([], [])
    return LISTED.findall(ast.get_docstring(tree, clean=False) or "")


def modules(root: Path) -> Iterator[tuple[Path, Module]]:
    """Yield every Python file of the packages and its dotted name; an `__init__` has that of its folder."""
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            parts = file.relative_to(root).with_suffix("").parts
            yield file, parts[:-1] if parts[-1] == "__init__" else parts


def imports(file: Path, module: Module) -> Iterator[tuple[int, Module]]:
    """Yield line and dotted name of every import of a file, at its top or inside a function."""
    for node in ast.walk(ast.parse(file.read_text(), str(file))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, tuple(alias.name.split("."))) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            folder = module if file.name == "__init__.py" else module[:-1]
            base = folder[: len(folder) + 1 - node.level] if node.level else ()
            base += tuple(node.module.split(".")) if node.module else ()
            yield from ((node.lineno, (*base, alias.name)) for alias in node.names)


def check_listings(root: Path) -> Iterator[str]:
    """Check that each package's docstring lists exactly its modules."""
    folders = {folder for file, _ in modules(root) for folder in file.parents if folder.is_relative_to(root)}
    for folder in sorted(folders - {root}):
        listed = listing(folder)
        present = {file.stem for file in folder.glob("*.py")} - {"__init__"}
        present |= {f"{below.name}/" for below in folders if below.parent == folder}
        where = f"{folder.relative_to(root)}/__init__.py:1"
        yield from (f"{where}: does not list {name}" for name in sorted(present - set(listed)))
        yield from (f"{where}: lists {name}, which is not there" for name in listed if name not in present)
        yield from (f"{where}: lists {name} twice" for name in sorted(set(listed)) if listed.count(name) > 1)


def check_order(root: Path) -> Iterator[str]:
    """Check that no module imports one that is listed below it."""
    for file, module in modules(root):
        for line, target in imports(file, module):
            same = next((i for i, (a, b) in enumerate(zip(module, target, strict=False)) if a != b), 0)
            if same == 0:
                continue
            order = [name.rstrip("/") for name in listing(root.joinpath(*module[:same]))]
            if not {module[same], target[same]} <= set(order):
                continue
            if order.index(target[same]) > order.index(module[same]):
                below = ".".join(target[: same + 1])
                yield f"{file.relative_to(root)}:{line}: imports {below}, which is listed below {module[same]}"


def check_packages(root: Path) -> Iterator[str]:
    """Check that units and master never import each other, shared packages import neither, and no package imports a
    reader's.
    """
    for file, module in modules(root):
        for line, target in imports(file, module):
            if target[0] in {*PACKAGES, "tests"} - WALLS[module[0]] - {module[0]}:
                yield f"{file.relative_to(root)}:{line}: {module[0]} imports {target[0]}"


def check_size(root: Path) -> Iterator[str]:
    """Check that no folder holds too many modules."""
    folders: dict[Module, int] = {}
    for file, module in modules(root):
        if file.name != "__init__.py":
            folders[module[:-1]] = folders.get(module[:-1], 0) + 1
    for folder, count in sorted(folders.items()):
        if count > MODULES_MAX and folder not in LARGE:
            yield f"{'/'.join(folder)}: {count} modules, at most {MODULES_MAX}"


def check_re_exports(root: Path) -> Iterator[str]:
    """Check that a package re-exports only its own names, and that a module does not import a sibling through its
    package.
    """
    for file, module in modules(root):
        room = module if file.name == "__init__.py" else module[:-1]
        for line, target in imports(file, module):
            where = f"{file.relative_to(root)}:{line}"
            if file.name == "__init__.py":
                if target[0] in PACKAGES and target[: len(room)] != room:
                    yield f"{where}: re-exports {'.'.join(target)}, which is of another room"
                elif room in BEFORE_SETTLED and target[-1] != "settle":
                    yield f"{where}: re-exports {target[-1]} before the kernels' folder is settled"
            elif target[:-1] == room and target[-1] not in {name.rstrip("/") for name in listing(file.parent)}:
                yield f"{where}: imports {target[-1]} from the page of its own room"


def check_mirror(root: Path) -> Iterator[str]:
    """Check that tests lie in folders named after those that they test."""
    for package in MIRRORED:
        for folder in sorted({file.parent for file in (root / "tests" / package).rglob("test_*.py")}):
            tested = root / folder.relative_to(root / "tests")
            if not (tested / "__init__.py").is_file():
                yield f"{folder.relative_to(root)}: there is no {tested.relative_to(root)}"


def check_kernels(root: Path) -> Iterator[str]:
    """Check that kernels are pure functions on arrays: no I/O, no clock, no configuration."""
    for file, module in modules(root):
        for line, target in imports(file, module):
            if module[:2] == KERNELS and target[:2] != KERNELS and target[0] not in KERNEL_IMPORTS:
                yield f"{file.relative_to(root)}:{line}: a kernel imports {'.'.join(target)}"


def check_clock(root: Path) -> Iterator[str]:
    """Check that only one module reads the time, so that all others can be tested without waiting."""
    for file, module in modules(root):
        if module == CLOCK:
            continue
        where = file.relative_to(root)
        yield from (f"{where}:{n}: imports time" for n, target in imports(file, module) if target[0] == "time")
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner = ast.unparse(node.func.value)
                if node.func.attr in WALL_CLOCK_CALLS and owner.split(".")[-1] in {"datetime", "date"}:
                    yield f"{where}:{node.lineno}: calls {owner}.{node.func.attr}"


def check_machine(root: Path) -> Iterator[str]:
    """Check that no file names a home folder or the host of a package registry."""
    for file in project_files(root):
        try:
            lines = file.read_text().splitlines()
        except UnicodeDecodeError:  # a picture
            continue
        for number, text in enumerate(lines, 1):
            if found := MACHINE.search(text):
                yield f"{file.relative_to(root)}:{number}: names {found.group()}"


CHECKS: tuple[Check, ...] = (
    check_listings,
    check_order,
    check_packages,
    check_size,
    check_re_exports,
    check_mirror,
    check_kernels,
    check_clock,
    check_machine,
)


@pytest.mark.parametrize("check", CHECKS)
def test_the_project_keeps(check: Check) -> None:
    problems = list(check(CHECKOUT))
    assert not problems, f"{check.__doc__}\n" + "\n".join(problems)


def test_every_package_is_here() -> None:
    assert [name for name in PACKAGES if not (CHECKOUT / name / "__init__.py").is_file()] == []


BAD = {
    "shared/__init__.py": '"""Shared.\n\n    clock  time\n    cell   box\n    ghost  gone\n    clock  again\n"""',
    "shared/clock.py": "import time\nfrom . import cell",
    "shared/cell.py": "import edge_unit.config\nfrom shared.clock import now\nfrom datetime import datetime as d",
    "geometry/__init__.py": '"""Geometry.\n\n    config        what\n    compilation/  where\n'
    + '    kernels/      how\n    drawing       all\n"""',
    "geometry/config.py": "def f():\n    from geometry.kernels import project\n    from time import sleep",
    "geometry/kernels/__init__.py": '"""Kernels.\n\n    project  rays\n    density  sums\n"""',
    "geometry/kernels/project.py": "import numpy as np, math\nfrom geometry.kernels import density\nimport os.path",
    "geometry/kernels/density.py": "import numba\nfrom . import project\nfrom ..drawing import run",
    "geometry/drawing.py": "import geometry.kernels.density",
    "edge_unit/__init__.py": '"""Unit.\n\n    pipeline  all\n"""',
    "edge_unit/pipeline.py": "import geometry.kernels.density\nimport master_server.app\nx = datetime.datetime.now()",
    "edge_unit/loose/part.py": "",
    "simulation/__init__.py": '"""Simulation."""',
    "simulation/world.py": "import edge_unit.pipeline",
    "master_server/__init__.py": '"""Master.\n\n'
    + "".join(f"    m{n}  one\n" for n in range(17))
    + '    page/  room\n"""',
    **{f"master_server/m{n}.py": "" for n in range(17)},
    "master_server/page/__init__.py": '"""Page.\n\n    one  one\n    two  two\n"""\n'
    + "from master_server.page.one import name\nfrom master_server.m1 import other",
    "master_server/page/one.py": "name = 1",
    "master_server/page/two.py": "from master_server.page import name\nfrom master_server.page import one",
    "geometry/compilation/__init__.py": '"""Compiled.\n\n    cache  folder\n"""\n'
    + "from geometry.compilation.cache import settle, other",
    "geometry/compilation/cache.py": "",
    "tests/master_server/page/test_one.py": "",
    "tests/master_server/gone/test_two.py": "",
    "notes.md": "fine: ~/x, $HOME/x, a/ro" + "ot/b\nlies in /" + "home/anna/x\nfrom py" + "pi.org",
}
EXPECTED: dict[Check, list[str]] = {
    check_listings: [
        "edge_unit/__init__.py:1: does not list loose/",
        "edge_unit/loose/__init__.py:1: does not list part",
        "shared/__init__.py:1: lists ghost, which is not there",
        "shared/__init__.py:1: lists clock twice",
        "simulation/__init__.py:1: does not list world",
    ],
    check_order: [
        "shared/clock.py:2: imports shared.cell, which is listed below clock",
        "geometry/config.py:2: imports geometry.kernels, which is listed below config",
        "geometry/kernels/density.py:3: imports geometry.drawing, which is listed below kernels",
        "geometry/kernels/project.py:2: imports geometry.kernels.density, which is listed below project",
    ],
    check_packages: [
        "shared/cell.py:1: shared imports edge_unit",
        "edge_unit/pipeline.py:2: edge_unit imports master_server",
    ],
    check_size: ["master_server: 17 modules, at most 16"],
    check_re_exports: [
        "geometry/compilation/__init__.py:5: re-exports other before the kernels' folder is settled",
        "master_server/page/__init__.py:7: re-exports master_server.m1.other, which is of another room",
        "master_server/page/two.py:1: imports name from the page of its own room",
    ],
    check_mirror: ["tests/master_server/gone: there is no master_server/gone"],
    check_kernels: [
        "geometry/kernels/density.py:3: a kernel imports geometry.drawing.run",
        "geometry/kernels/project.py:3: a kernel imports os.path",
    ],
    check_clock: [
        "geometry/config.py:3: imports time",
        "edge_unit/pipeline.py:3: calls datetime.datetime.now",
    ],
    check_machine: ["notes.md:2: names /" + "home/a", "notes.md:3: names py" + "pi.org"],
}


@pytest.mark.parametrize("check", CHECKS)
def test_the_check_finds_every_fault(check: Check, tmp_path: Path) -> None:
    for name, text in BAD.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert list(check(tmp_path)) == EXPECTED[check]
