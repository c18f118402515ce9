# SPDX-License-Identifier: Apache-2.0
"""Text files as editors and other programs write them: their bytes as text, tables, and YAML whose numbers are numbers.

YAML is read by its version 1.2 (core schema), which is how people read it. Version 1.1, PyYAML's own, takes `1e-3` for
text, `027312070353` for an octal number, `12:30` for 750, and `no` for false.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

MAX_TEXT_FILE_BYTES = 64 * 2**20
"""Of one text file: an hour of joints at 125 Hz has 40 MB; a wrong file must not fill the memory."""

MAX_DIGITS = 100
"""Of a whole number in YAML; int() refuses thousands of them by an error of its own."""

_BRACKETS = re.compile(r"[\[\]()]")
"""Around the rows of a table that numpy or Python printed."""

_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
"""Byte-order marks, with which editors on Windows begin a file, and the encoding that each stands for."""


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, or in UTF-16 with a byte-order mark; line ends become newlines.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no text in these encodings, or too long; says how to save it.
    """
    if path.stat().st_size > MAX_TEXT_FILE_BYTES:
        raise ValueError(f"expected a text file of at most {MAX_TEXT_FILE_BYTES} bytes, got {path.stat().st_size}")
    return decode_text(path.read_bytes())


def decode_text(content: bytes) -> str:
    """Decode the bytes of a text file in UTF-8, or in UTF-16 with a byte-order mark; line ends become newlines.

    Raises:
        ValueError: it is no text in these encodings; says how to save it.
    """
    encoding = next((name for mark, name in _BOMS if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"expected text in UTF-8, got other bytes at position {error.start}; save the file as UTF-8"
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_numbers(text: str) -> NDArray[np.float64]:
    """Parse a table of numbers (rows, columns) as spreadsheets, numpy and other programs print it.

    Columns are parted by semicolons, commas, tabs or spaces, one of them in a row; decimals have a point. Brackets,
    comments after `#` and one row of headings are passed over.

    Raises:
        ValueError: there is no number, a row has another length, or a value is no finite number; names the line.
    """
    rows: list[list[float]] = []
    headed = False
    for number, line in enumerate(text.split("\n"), start=1):
        words = _columns(line.partition("#")[0])
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            if rows or headed or any(char.isdigit() for char in words[0][:1]):
                raise ValueError(
                    f"line {number}: expected numbers with a decimal point, got {line.strip()[:60]!r}"
                ) from error
            headed = True
            continue
        if rows and len(row) != len(rows[0]):
            raise ValueError(f"line {number}: expected {len(rows[0])} numbers as in the first row, got {len(row)}")
        rows.append(row)
    if not rows:
        raise ValueError("expected rows of numbers, got none")
    table = np.array(rows)
    if not np.isfinite(table).all():
        raise ValueError("expected finite numbers, got NaN or infinity")
    return table


def _columns(line: str) -> list[str]:
    """Part a row at its strongest separator: a comma inside a column of a row with semicolons is a decimal comma."""
    row = _BRACKETS.sub(" ", line).strip()
    separator = next((mark for mark in (";", ",", "\t") if mark in row), None)
    columns = [column.strip() for column in row.split(separator)]
    return columns[:-1] if columns and not columns[-1] else columns


def parse_yaml(text: str) -> Any:
    """Parse one YAML document by version 1.2; digits after a leading zero stay text, as in serial numbers.

    Raises:
        yaml.YAMLError: it is no YAML, or a key stands twice in one mapping (the first would be lost).
        RecursionError: it is nested too deeply.
    """
    return yaml.load(text, Loader=_Loader)


def parse_yaml_documents(text: str) -> list[Any]:
    """Parse the YAML documents of a stream, which `---` parts; else as `parse_yaml`.

    Raises:
        yaml.YAMLError: one of them is no YAML.
        RecursionError: one is nested too deeply.
    """
    return list(yaml.load_all(text, Loader=_Loader))


class _Loader(yaml.SafeLoader):
    """The core schema of YAML 1.2, with each key once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            text = str(key.value)
            if text in seen:
                raise yaml.constructor.ConstructorError(
                    "while reading a mapping", node.start_mark, f"duplicate key {text}", key.start_mark
                )
            seen.add(text)
        return super().construct_mapping(node, deep)

    def construct_whole_number(self, node: yaml.ScalarNode) -> int:
        """Construct a decimal whole number; PyYAML's own would read underscores and colons into it."""
        text = self.construct_scalar(node)
        if len(text) > MAX_DIGITS:
            raise yaml.constructor.ConstructorError(
                None, None, f"expected a number of at most {MAX_DIGITS} digits, got {len(text)}", node.start_mark
            )
        return int(text)


# Not PyYAML's own, which is 1.1.
_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    # Neither leading zeros nor hexadecimal: nobody writes a number so here, but serial numbers and names look like it.
    ("tag:yaml.org,2002:int", r"[-+]?(?:0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "tag:yaml.org,2002:float",
        r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)\.[0-9]*)(?:[eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("tag:yaml.org,2002:merge", r"<<", ["<"]),
):
    _Loader.add_implicit_resolver(_tag, re.compile(rf"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_whole_number)
