# SPDX-License-Identifier: Apache-2.0
"""Size of classes and functions: attributes of a class, parameters of a function."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent

PACKAGES = ("edge_unit", "master_server")

ATTRIBUTES_MAX = 15
"""Own attributes of a class: fields in its body and those that its methods set. A class with more should be split."""

PARAMETERS_MAX = 10
"""Parameters of a function, besides `self` or `cls`. Kernels lie in a package of their own."""

ALLOWED = {
    "edge_unit/config.py: UnitConfig": "one attribute for each name that may stand in a unit's configuration",
    "edge_unit/sources/realsense/capture_link.py: Opened": "what one process tells another once, field by field",
    "edge_unit/sources/realsense/capture_supervisor.py: CaptureSupervisor": "one process: its session and frames",
}
"""`file: name` of larger classes and functions, and the reason."""


def attributes(found: ast.ClassDef) -> set[str]:
    """Return the fields in the body of a class, and the attributes that its own methods set."""
    fields = [node for node in found.body if isinstance(node, ast.AnnAssign)]
    names = {
        node.target.id
        for node in fields
        if isinstance(node.target, ast.Name) and not ast.unparse(node.annotation).startswith("ClassVar")
    }
    for method in found.body:
        if isinstance(method, (ast.FunctionDef, ast.AsyncFunctionDef)):
            names |= {
                node.attr
                for node in ast.walk(method)
                if isinstance(node, ast.Attribute)
                and isinstance(node.ctx, ast.Store)
                and isinstance(node.value, ast.Name)
                and node.value.id == "self"
            }
    return names


def parameters(found: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Return all parameters of a function except `self` or `cls`."""
    taken = (*found.args.posonlyargs, *found.args.args, *found.args.kwonlyargs)
    return [one.arg for one in taken if one.arg not in {"self", "cls"}]


def too_large(root: Path) -> Iterator[tuple[str, str]]:
    """Yield `file: name` and the size of everything that exceeds its limit."""
    for file in sorted(file for package in PACKAGES for file in (root / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(), str(file))):
            if isinstance(node, ast.ClassDef):
                count, most, what = len(attributes(node)), ATTRIBUTES_MAX, "attributes"
            elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                count, most, what = len(parameters(node)), PARAMETERS_MAX, "parameters"
            else:
                continue
            if count > most:
                yield f"{file.relative_to(root)}: {node.name}", f"{count} {what}, at most {most}"


def test_nothing_is_larger_than_a_reader_can_keep_in_mind() -> None:
    assert {name: size for name, size in too_large(CHECKOUT) if name not in ALLOWED} == {}


def test_every_exception_is_needed() -> None:
    assert sorted(set(ALLOWED) - {name for name, _ in too_large(CHECKOUT)}) == []


FIELDS = "\n".join(f"    field_{n}: int" for n in range(ATTRIBUTES_MAX))
SET = "\n".join(f"        self.part_{n}, self.piece_{n} = 1, self.other_{n}" for n in range(ATTRIBUTES_MAX // 2))
TAKEN = ", ".join(f"p{n}" for n in range(PARAMETERS_MAX))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (f"class A:\n{FIELDS}\n    shared: ClassVar[int]\n    NAME = 1\n    def f(self): self.field_1 = 2", []),
        (f"class A:\n{FIELDS}\n    def f(self): self.more += 1", [("A", "16 attributes, at most 15")]),
        (f"class A:\n    def f(self):\n{SET}\n        self.one = self.two = 0", [("A", "16 attributes, at most 15")]),
        (f"class A:\n    def f(self, {TAKEN}): ...\n    class B:\n        def g(cls, *, {TAKEN}, q): ...", [
            ("g", "11 parameters, at most 10"),
        ]),
        (f"async def f({TAKEN}, q=1, *rest): ...", [("f", "11 parameters, at most 10")]),
    ],
)  # fmt: skip
def test_too_large_classes_and_functions_are_found(
    source: str, expected: list[tuple[str, str]], tmp_path: Path
) -> None:
    file = tmp_path / PACKAGES[0] / "one.py"
    file.parent.mkdir()
    file.write_text(source)
    assert [(name.split(": ")[1], size) for name, size in too_large(tmp_path)] == expected
