# SPDX-License-Identifier: Apache-2.0
"""The pictures of docs/architecture.md are what the source says."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import ModuleType

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent
PICTURES = CHECKOUT / "assets" / "pictures"
HINT = "run python scripts/draw_architecture.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw_architecture", CHECKOUT / "scripts" / "draw_architecture.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pictures_are_what_the_script_draws(script: ModuleType) -> None:
    assert list(script.stale(CHECKOUT, PICTURES)) == [], HINT


def test_a_picture_that_is_old_or_missing_is_found(script: ModuleType, tmp_path: Path) -> None:
    names = list(script.DRAWN)
    (tmp_path / names[0]).write_text("<svg/>", encoding="utf-8")
    assert list(script.stale(CHECKOUT, tmp_path)) == names


def test_every_module_of_the_product_is_in_the_picture(script: ModuleType) -> None:
    text = "\n".join(ElementTree.parse(PICTURES / "architecture-rooms.svg").getroot().itertext())
    words = set(text.replace("→", " ").split())
    for package in ("shared", "geometry", "edge_unit", "master_server"):
        names = script.listing(CHECKOUT / package)
        assert len(names) > 2, package
        assert set(names) <= words, package
        for name in names:
            if name.endswith("/"):
                assert set(script.listing(CHECKOUT / package / name.rstrip("/"))) <= words, name


def test_a_call_that_is_not_served_is_an_error(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "METRICS_CALLS", (script.Call("GET /figures", ("GET /figures",)),))
    with pytest.raises(ValueError, match="GET /figures"):
        script.check_processes(CHECKOUT)


def test_a_process_that_is_not_drawn_is_an_error(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = dict(script.PROCESSES)
    left_out, _ = drawn.popitem()
    monkeypatch.setattr(script, "PROCESSES", drawn)
    with pytest.raises(ValueError, match=left_out):
        script.check_processes(CHECKOUT)
