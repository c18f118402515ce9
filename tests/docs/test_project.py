# SPDX-License-Identifier: Apache-2.0
"""Files for the next owner name what there is: make targets, versions, forms."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

CHECKOUT = Path(__file__).resolve().parents[2]
TARGETS = set(re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
MAKE = re.compile(r"^ *(?:- run:|entry:)? *make ([a-z-]+)((?: SLOW=1)?)", re.MULTILINE)
FORMS = sorted((CHECKOUT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def made_by(path: str) -> set[tuple[str, str]]:
    """Return the targets that a file has made, each with its SLOW."""
    return set(MAKE.findall((CHECKOUT / path).read_text(encoding="utf-8")))


def test_the_workflow_makes_what_ci_makes() -> None:
    assert made_by(".ci/run") == made_by(".github/workflows/check.yml") == {("docs", ""), ("test", " SLOW=1")}


@pytest.mark.parametrize("path", [".pre-commit-config.yaml", ".github/workflows/check.yml", ".ci/run"])
def test_every_target_is_there(path: str) -> None:
    targets = {target for target, _ in made_by(path)}
    assert targets
    assert targets <= TARGETS


def test_hooks_fetch_nothing() -> None:
    hooks = yaml.safe_load((CHECKOUT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert {repository["repo"] for repository in hooks["repos"]} == {"local"}
    assert {hook["language"] for hook in hooks["repos"][0]["hooks"]} == {"system"}


def test_the_changelog_has_the_version() -> None:
    version = re.search(r'^version = "([\d.]+)"$', (CHECKOUT / "pyproject.toml").read_text("utf-8"), re.MULTILINE)
    assert version is not None
    headings = re.findall(r"^## \[([\w.]+)\]", (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert version[1] in headings


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.stem)
def test_a_form_asks_for_each_thing_once(form: Path) -> None:
    fields = yaml.safe_load(form.read_text(encoding="utf-8"))["body"]
    names = [field["id"] for field in fields]
    assert len(set(names)) == len(names)
    assert all(field["attributes"]["label"] for field in fields)
