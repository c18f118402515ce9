# SPDX-License-Identifier: Apache-2.0
"""Every name and path of the project in a string, a unit file, a script or a page exists.

A moved module causes no error where only its name is written: a service that cannot start, or a wrong page.
"""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.project_files import project_files

CHECKOUT = Path(__file__).resolve().parent.parent
PACKAGES = ("shared", "geometry", "edge_unit", "master_server", "simulation", "benchmarks", "qualification", "tests")
PACKAGE = "|".join(PACKAGES)
DOTTED = re.compile(rf"(?<![\w./@:-])(?:{PACKAGE})(?:\.[A-Za-z_]\w*)+")
# Not `../shared/data`, which lies beside a checkout, nor a part of a longer path.
FOLDERS = (*PACKAGES, "deploy", "assets", "docs", "examples", "scripts", r"\.ci")
PATH = re.compile(rf"(?<![\w./<{{$*-])(?:{'|'.join(FOLDERS)})(?:/[\w.*-]+)+/?")
RUN_AS_MODULE = re.compile(rf"""-m["']?[,\s]\s*["']?((?:{PACKAGE})(?:\.\w+)*)(?![\w.])""")
IMPORTED = re.compile(rf"^[ >.]*from ((?:{PACKAGE})[\w.]*) import ([\w, ]+)$", re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)\s#]+)(?:#[\w-]+)?\)")

WRITTEN_ELSEWHERE = (
    "benchmarks/REPORT.md",
    "constraints.txt",
    "deploy/image/locks/",
    "tests/test_layout.py",
    "tests/test_references.py",
    "tests/test_shape.py",
    "LICENSE",
)
"""Made by a program, or about names that are wrong on purpose."""
BESIDE = CHECKOUT.parent / "shared" / "data"
"""Recorded data, which is in no checkout."""


@cache
def tracked() -> tuple[Path, ...]:
    """Return every text file of the project."""
    files = []
    for file in project_files(CHECKOUT):
        if file.relative_to(CHECKOUT).as_posix().startswith(WRITTEN_ELSEWHERE):
            continue
        try:
            file.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # a picture
            continue
        files.append(file)
    return tuple(files)


def texts(file: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of everything that no interpreter checks: all of a page or script, strings of Python."""
    if file.suffix != ".py":
        yield 1, file.read_text(encoding="utf-8")
        return
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def found(pattern: re.Pattern[str]) -> Iterator[tuple[str, re.Match[str]]]:
    """Yield each match of `pattern` in any text, with its place as `file:line`."""
    for file in tracked():
        for first_line, text in texts(file):
            for match in pattern.finditer(text):
                line = first_line + text.count("\n", 0, match.start())
                yield f"{file.relative_to(CHECKOUT)}:{line}", match


@cache
def names_in(file: Path) -> frozenset[str]:
    """Return all names that a module or a class in it binds, including its imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.alias):
            names.add((node.asname or node.name).split(".")[0])
    return frozenset(names)


def leads_somewhere(dotted: str) -> bool:
    """Return True if `dotted` is a module, or a name in one."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = CHECKOUT.joinpath(*parts[:length])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if not (file.is_file() or place.is_dir()):
            continue
        rest = parts[length:]
        if not rest or rest == ["py"]:
            return True
        known = names_in(file) if file.is_file() else frozenset()
        return rest[0] in known or rest[0] in dir(builtins) or rest[0].startswith("__")
    return False


def can_be_run(dotted: str) -> bool:
    """Return True if `python -m dotted` finds a module that can run."""
    place = CHECKOUT.joinpath(*dotted.split("."))
    file = place / "__main__.py" if place.is_dir() else place.with_suffix(".py")
    return file.is_file() and (file.name == "__main__.py" or "__main__" in file.read_text(encoding="utf-8"))


def test_every_dotted_name_leads_somewhere() -> None:
    wrong = {f"{where}: {match[0]}" for where, match in found(DOTTED) if not leads_somewhere(match[0])}
    assert not wrong, "\n".join(sorted(wrong))


def test_every_path_leads_somewhere() -> None:
    wrong = set()
    for where, match in found(PATH):
        path = match[0].rstrip(".")
        if not any(CHECKOUT.glob(path.rstrip("/"))) and path.rstrip("/") != "shared/data":
            wrong.add(f"{where}: {path}")
    assert not wrong, "\n".join(sorted(wrong))


def test_every_module_that_is_run_can_be() -> None:
    run = [(where, match[1]) for where, match in found(RUN_AS_MODULE)]
    for file in tracked():
        if file.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Tuple | ast.List):
                elements = node.elts
            elif isinstance(node, ast.Call):
                elements = node.args
            else:
                continue
            words = [element.value if isinstance(element, ast.Constant) else None for element in elements]
            for flag, module in pairwise(words):
                if flag == "-m" and isinstance(module, str) and module.split(".")[0] in PACKAGES:
                    run.append((f"{file.relative_to(CHECKOUT)}:{node.lineno}", module))
    assert len(run) > 40
    wrong = [f"{where}: -m {module}" for where, module in run if not can_be_run(module)]
    assert not wrong, "\n".join(wrong)


def test_every_import_in_a_string_or_a_page_can_be_made() -> None:
    wrong = [
        f"{where}: from {match[1]} import {name.strip()}"
        for where, match in found(IMPORTED)
        for name in match[2].split(",")
        if not leads_somewhere(f"{match[1]}.{name.strip().split(' as ')[0]}")
    ]
    assert not wrong, "\n".join(wrong)


def test_every_path_relative_to_a_module_exists() -> None:
    """`Path(__file__)` and paths derived from it: a moved module changes them."""
    reckoned = 0
    wrong = []
    for file in tracked():
        if file.suffix != ".py":
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Name) and node.id == "__file__"):
                continue
            whole: ast.AST = node
            while isinstance(parent := parents[whole], ast.Call | ast.Attribute | ast.Subscript | ast.BinOp):
                if isinstance(parent, ast.Call) and whole in parent.args and ast.unparse(parent.func) != "Path":
                    break
                if isinstance(parent, ast.Attribute) and parent.attr in {"read_text", "read_bytes", "glob", "rglob"}:
                    break
                whole = parent
            code = compile(ast.Expression(whole), str(file), "eval")  # type: ignore[arg-type]  # an expression by now
            place = eval(code, {"Path": Path, "__file__": str(file)})
            reckoned += 1
            if not place.exists() and "out" not in place.relative_to(CHECKOUT).parts:
                wrong.append(f"{file.relative_to(CHECKOUT)}:{node.lineno}: {place}")
            elif not place.is_relative_to(CHECKOUT) and place != BESIDE:
                wrong.append(f"{file.relative_to(CHECKOUT)}:{node.lineno}: {place} is outside of the checkout")
    assert reckoned > 20
    assert not wrong, "\n".join(wrong)


def test_every_link_of_a_page_leads_somewhere() -> None:
    pages = [file for file in tracked() if file.suffix == ".md"]
    assert pages
    wrong = [
        f"{page.relative_to(CHECKOUT)}: {link}"
        for page in pages
        for link in LINK.findall(page.read_text(encoding="utf-8"))
        if not (page.parent / link).exists()
    ]
    assert not wrong, "\n".join(wrong)


def test_commands_and_wheel_name_existing_modules() -> None:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    for command, entry in project["project"]["scripts"].items():
        module, _, function = entry.partition(":")
        assert leads_somewhere(f"{module}.{function}"), command
    wheel = set(project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    packages = {file.parent.name for file in CHECKOUT.glob("*/__init__.py")}
    assert packages == set(PACKAGES) - {"tests"}
    assert wheel == packages - {"benchmarks", "qualification"}
    assert set(project["tool"]["ruff"]["lint"]["isort"]["known-first-party"]) == packages | {"tests"}
    types = re.search(
        r"^TYPED := .*addsuffix /__init__.py,([\w ]+)\)", (CHECKOUT / "Makefile").read_text(), re.MULTILINE
    )
    assert types is not None
    assert set(types[1].split()) == packages


@pytest.mark.parametrize(
    ("pattern", "text", "expected"),
    [
        (DOTTED, "see edge_unit.gone.Thing.", False),
        (DOTTED, "see edge_unit.pipeline.DepthPipeline.", True),
        (DOTTED, "edge_unit.pipeline.gone", False),
        (DOTTED, "shared.clock.monotonic_ns()", True),
        (RUN_AS_MODULE, "python -m simulation.demo", True),
        (RUN_AS_MODULE, "python3 -m edge_unit run", True),
        (RUN_AS_MODULE, "-m edge_unit.pipeline", False),
    ],
)
def test_wrong_names_are_found(pattern: re.Pattern[str], text: str, expected: bool) -> None:
    match = pattern.search(text)
    assert match is not None
    dotted = match[match.lastindex or 0]
    assert (can_be_run if pattern is RUN_AS_MODULE else leads_somewhere)(dotted) is expected
