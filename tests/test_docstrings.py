# SPDX-License-Identifier: Apache-2.0
"""Docstrings begin with an imperative or a noun phrase, never with a question word."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from tests.project_files import project_files

CHECKOUT = Path(__file__).resolve().parent.parent
QUESTION = re.compile(r"\s*(?:What|Whether|Who|Whose|Where|How|When|Why|Which)\b")


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring: of modules, classes and functions, and after assignments."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        for before, statement in zip([None, *body], body, strict=False):
            if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)):
                continue
            first = before is None and documented
            if isinstance(statement.value.value, str) and (first or isinstance(before, ast.Assign | ast.AnnAssign)):
                yield statement.lineno, statement.value.value


def questions(root: Path) -> Iterator[str]:
    """Yield `file:line: text` of each docstring that begins with a question word."""
    for file in project_files(root):
        if file.suffix == ".py":
            for line, text in docstrings(file.read_text(encoding="utf-8")):
                if QUESTION.match(text):
                    yield f"{file.relative_to(root)}:{line}: {text.strip().splitlines()[0]}"


def test_no_docstring_begins_with_a_question_word() -> None:
    found = sorted(questions(CHECKOUT))
    assert not found, f"{len(found)} docstrings:\n" + "\n".join(found)


def test_a_question_word_is_found(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text(
        '"""What one does."""\nX = 1\n"""How many."""\ndef f():\n    """Return X."""\n    y = 2\n'
        'class A:\n    """Whatever is kept."""\n    z: int = 1\n    """Where it is."""\n    def g(self):\n        """\n'
        '        Which of them.\n        """\n'
    )
    assert list(questions(tmp_path)) == [
        "one.py:1: What one does.",
        "one.py:3: How many.",
        "one.py:10: Where it is.",
        "one.py:12: Which of them.",
    ]
