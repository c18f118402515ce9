# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field

from shared.configuration import assignments, load
from shared.errors import ConfigError


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")
    fps: float = Field(default=1.0, gt=0.0)
    max_size: int = 1


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str = "none"
    source: Inner = Inner()


def test_later_layers_win(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("name: file\nsource: {fps: 2, max_size: 2}\n")
    environment = {"T_SOURCE__MAX_SIZE": "3", "T_NAME": "environment", "OTHER": "x", "T_UNRELATED": "y"}
    found = load(Outer, file, environment, "T_", {"name": "flag"})
    assert found == Outer(name="flag", source=Inner(fps=2.0, max_size=3))


def test_a_file_is_optional_and_may_be_empty(tmp_path: Path) -> None:
    assert load(Outer, None, {}, "T_", {}) == Outer()
    (tmp_path / "a.yaml").write_text("# nothing\n")
    assert load(Outer, tmp_path / "a.yaml", {}, "T_", {}) == Outer()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("source: {fps: -1}", ["source.fps", "greater than 0", "got -1"]),
        ("source: {fsp: 1}", ["source.fsp", "got 1"]),
        ("[1, 2]", ["expected a mapping", "list"]),
        ("a: [", ["expected YAML"]),
        ("source: 3", ["source"]),
    ],
)
def test_errors_name_the_field_and_the_file(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(Outer, file, {}, "T_", {})
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(file), *words]:
        assert word in message


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.yaml: cannot be read"):
        load(Outer, tmp_path / "gone.yaml", {}, "T_", {})


def test_an_override_below_a_value_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected name to be a mapping"):
        load(Outer, None, {}, "T_", {"name": "x", "name.first": "y"})


def test_assignments() -> None:
    assert assignments(["a.b=1", "c=x=y"]) == {"a.b": "1", "c": "x=y"}
    with pytest.raises(ConfigError, match="--set a"):
        assignments(["a"])


def test_values_nested_too_deeply_are_refused(tmp_path: Path) -> None:
    deep = "[" * 3000 + "]" * 3000
    file = tmp_path / "a.yaml"
    file.write_text(f"name: {deep}")
    with pytest.raises(ConfigError, match=r"a\.yaml: .*expected a few levels of nesting"):
        load(Outer, file, {}, "T_", {})
    with pytest.raises(ConfigError, match=r"name: .*expected a few levels of nesting"):
        load(Outer, None, {}, "T_", {"name": deep})
