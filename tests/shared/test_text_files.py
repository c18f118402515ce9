# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from shared.text_files import (
    MAX_DIGITS,
    MAX_TEXT_FILE_BYTES,
    decode_text,
    parse_numbers,
    parse_yaml,
    parse_yaml_documents,
    read_text,
)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1e-3", 0.001),
        ("1E-3", 0.001),
        ("1e+0", 1.0),
        (".001", 0.001),
        ("+0.5", 0.5),
        ("-1.", -1.0),
        ("12", 12),
        ("-0", 0),
        (".inf", float("inf")),
        ("true", True),
        ("~", None),
        ("", None),
        # Text, whatever YAML 1.1 makes of it.
        ("027312070353", "027312070353"),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("0x1F", "0x1F"),
        ("no", "no"),
        ("on", "on"),
        ("2026-01-01", "2026-01-01"),
        ("0,001", "0,001"),
        ("'12'", "12"),
    ],
)
def test_a_scalar_is_what_a_person_reads(written: str, value: Any) -> None:
    found = parse_yaml(f"key: {written}\n")["key"]
    assert found == value
    assert type(found) is type(value)


def test_a_key_that_stands_twice_is_refused_in_any_document() -> None:
    for text in ("a: 1\na: 2\n", "b: {a: 1, a: 2}\n"):
        with pytest.raises(yaml.YAMLError, match="duplicate key a"):
            parse_yaml(text)
        with pytest.raises(yaml.YAMLError, match="duplicate key a"):
            parse_yaml_documents(f"c: 1\n---\n{text}")


def test_thousands_of_digits_are_refused_as_yaml() -> None:
    with pytest.raises(yaml.YAMLError, match=f"at most {MAX_DIGITS} digits, got 5000"):
        parse_yaml("a: " + "1" * 5000)


def test_nothing_but_data_is_made() -> None:
    with pytest.raises(yaml.YAMLError):
        parse_yaml("!!python/object/apply:os.getcwd []")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_text_of_other_systems_is_read(tmp_path: Path, encoding: str, newline: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_bytes(f"name: Halle Süd{newline}size: 1e-3{newline}".encode(encoding))
    assert parse_yaml(read_text(file)) == {"name": "Halle Süd", "size": 0.001}


def test_other_bytes_are_refused_and_how_to_save_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="position 1; save the file as UTF-8"):
        decode_text("xü".encode("latin-1"))
    large = tmp_path / "large.csv"
    with large.open("wb") as file:
        file.truncate(MAX_TEXT_FILE_BYTES + 1)
    with pytest.raises(ValueError, match="at most"):
        read_text(large)


@pytest.mark.parametrize(
    "text",
    [
        "1,2.5\n-3,4e-1\n",
        "1;2.5\n-3;4e-1\n",
        "1\t2.5\n-3\t4e-1\n",
        "1 2.5\n  -3   4e-1\n",
        "1, 2.5,\n-3, 4e-1,\n",
        "[[ 1.  2.5]\n [-3. 0.4]]\n",
        "j1,j2\n1,2.5\n\n-3,4e-1\n",
        "# joints of the arm\n1,2.5  # at rest\n-3,0.4\n",
    ],
)
def test_tables_of_other_programs_are_read(text: str) -> None:
    np.testing.assert_array_equal(parse_numbers(text), ((1.0, 2.5), (-3.0, 0.4)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,5;2,5\n", "line 1: expected numbers with a decimal point"),
        ("1,5 2,5\n", "line 1: expected numbers with a decimal point"),
        ("1,5\t2,5\n", "line 1: expected numbers with a decimal point"),
        ("1,2\n3\n", "line 2: expected 2 numbers as in the first row, got 1"),
        ("1,2\na,b\n", "line 2: expected numbers"),
        ("a,b\nc,d\n1,2\n", "line 2: expected numbers"),
        ("1,,2\n", "line 1: expected numbers"),
        ("nan,1\n", "expected finite numbers"),
        ("# nothing\n", "expected rows of numbers, got none"),
    ],
)
def test_a_table_that_could_mean_two_things_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        parse_numbers(text)
