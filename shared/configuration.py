# SPDX-License-Identifier: Apache-2.0
"""Load a configuration from a YAML file, the environment and the command line; later sources win."""

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
"""Number of errors that a message describes; further errors are only counted."""

SENTENCE_INPUT_CHARS = 60
"""Maximum length of a quoted value: enough to recognise it, while a value may have a megabyte."""

NESTING = "__"
"""Separator of levels: `PREFIX_SOURCE__FPS=15` is `source.fps: 15`. Single underscores are part of many names."""


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
    """Load and check a configuration `model`.

    Start from the YAML file `path`, or from nothing when it is None. Apply the variables of `environment` whose name
    starts with `prefix`, then `overrides`, whose keys are dotted (`source.fps`). Parse text of the last two as YAML.

    Raises:
        ConfigError: the file is missing or not a YAML mapping, or a value is invalid; the text names it.
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
    """Parse `["a.b=1"]` of the command line into `{"a.b": "1"}`.

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
    """Describe the first few errors of a model in one line: the field, the expectation and the value."""
    return sentence_of(error.errors(include_url=False, include_context=False))


def sentence_of(items: Sequence[Mapping[str, Any]]) -> str:
    """Describe pydantic's list of errors as `sentence` does."""
    parts = []
    for item in items[:SENTENCE_ITEMS]:
        name = ".".join(str(part) for part in item["loc"] if part != "body") or "value"
        # The name may come from the network: quote it and cut it, so that it stays in one line.
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
        raise ConfigError(f"{path}: expected YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: expected a few levels of nesting, got too many") from error
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
        raise ConfigError(f"{name}: expected a YAML value, got {value!r}") from error
    except RecursionError as error:
        raise ConfigError(f"{name}: expected a few levels of nesting, got too many") from error


def _put(tree: dict[str, Any], dotted: str, value: Any, name: str) -> None:
    *parents, last = dotted.split(".")
    for parent in parents:
        below = tree.setdefault(parent, {})
        if not isinstance(below, dict):
            raise ConfigError(f"{name}: expected {parent} to be a mapping, got a value")
        tree = below
    tree[last] = value
