# SPDX-License-Identifier: Apache-2.0
"""A configuration from a YAML file, the environment and the command line; the later one wins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ValidationError

from shared.errors import ConfigError
from shared.text_files import parse_yaml, read_text

Model = TypeVar("Model", bound=BaseModel)

SENTENCE_ITEMS = 3
"""What is wrong beyond these is only counted."""

SENTENCE_INPUT_CHARS = 60
"""Enough to recognise a value; a megabyte of it helps nobody."""

NESTING = "__"
"""`PREFIX_SOURCE__FPS=15` is `source.fps: 15`, since a single underscore is part of many names."""


def _digits_as_text(value: Any) -> Any:
    if isinstance(value, float):
        raise ValueError(f"expected text, got the number {value!r}; put it in quotes")
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Text = Annotated[str, BeforeValidator(_digits_as_text)]
"""Text that may be all digits, such as a serial number, without quotes."""


def load(
    model: type[Model],
    path: Path | None,
    environment: Mapping[str, str],
    prefix: str,
    overrides: Mapping[str, Any],
) -> Model:
    """Read a configuration `model`.

    `path` is a YAML file or None; variables of `environment` whose name starts with `prefix` come over
    it, then `overrides`, whose keys are dotted (`source.fps`). Text of the last two is read as YAML.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or a value does not fit; the text names it.
    """
    where = str(path) if path is not None else "configuration"
    merged = _read(path) if path is not None else {}
    for name, text in sorted(environment.items()):
        if name.startswith(prefix):
            dotted = name[len(prefix) :].lower().replace(NESTING, ".")
            if dotted.split(".")[0] in model.model_fields:
                _put(merged, dotted, _scalar(text, name), name)
    for dotted, value in overrides.items():
        _put(merged, dotted, _scalar(value, dotted), dotted)
    try:
        return model.model_validate(merged)
    except ValidationError as error:
        raise ConfigError(f"{where}: {sentence(error)}") from error


def assignments(items: Iterable[str]) -> dict[str, str]:
    """`["a.b=1"]` of the command line as `{"a.b": "1"}`.

    Raises:
        ConfigError: an item has no `=`.
    """
    pairs = {}
    for item in items:
        name, equals, value = item.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set {item}: expected name=value")
        pairs[name] = value
    return pairs


def sentence(error: ValidationError) -> str:
    """What is wrong with the first few fields of a model, in one line that names them and what came."""
    return sentence_of(error.errors(include_url=False, include_context=False))


def sentence_of(items: Sequence[Mapping[str, Any]]) -> str:
    """The same, of pydantic's list of what is wrong."""
    parts = []
    for item in items[:SENTENCE_ITEMS]:
        name = ".".join(str(part) for part in item["loc"] if part != "body") or "value"
        # A name may be a stranger's: as text in one line, and not without end.
        name = repr(name)[1:-1][:SENTENCE_INPUT_CHARS]
        what = item["msg"][:1].lower() + item["msg"][1:]
        came = f", got {_shown(item['input'])}" if item["type"] != "missing" else ""
        parts.append(f"{name}: {what}{came}")
    if len(items) > len(parts):
        parts.append(f"and {len(items) - len(parts)} more")
    return "; ".join(parts)


def _shown(value: Any) -> str:
    try:
        return repr(value)[:SENTENCE_INPUT_CHARS]
    except RecursionError:
        return f"a {type(value).__name__} nested too deeply to show"


def _read(path: Path) -> dict[str, Any]:
    try:
        loaded = parse_yaml(read_text(path))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: no YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: expected values in a few levels, got them nested too deeply") from error
    if loaded is None:
        return {}
    if not isinstance(loaded, dict):
        raise ConfigError(f"{path}: expected a mapping of names to values, got {type(loaded).__name__}")
    return loaded


def _scalar(value: Any, name: str) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return parse_yaml(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: no YAML value: {value!r}") from error
    except RecursionError as error:
        raise ConfigError(f"{name}: expected a value in a few levels, got one nested too deeply") from error


def _put(tree: dict[str, Any], dotted: str, value: Any, name: str) -> None:
    *parents, last = dotted.split(".")
    for parent in parents:
        below = tree.setdefault(parent, {})
        if not isinstance(below, dict):
            raise ConfigError(f"{name}: {parent} is a value, expected a mapping")
        tree = below
    tree[last] = value
