# SPDX-License-Identifier: Apache-2.0
"""Every block of code in README.md and docs/ runs, or the page says why not.

The blocks of one page run in their order in one folder, with a running master's `state`, a `cell.yaml` and `.venv`,
as a reader of the page has them. A block that does not run has a comment before it: `<!-- not run: needs a camera -->`.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from pydantic import ValidationError

from edge_unit.config import UnitConfig
from master_server.config import MasterConfig
from shared.cell_file import CellFile
from simulation.world.world import DEMO_CELL
from tests.missing import need_command
from tests.system.cluster import Cluster

CHECKOUT = Path(__file__).resolve().parents[2]
PAGES = (CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").rglob("*.md")))
LIMIT_S = 200.0
"""Kernels may have to be compiled first."""
MOMENT_S = 2.0
"""A block that loops for ever is stopped after this time."""

OPERATOR = 'operator="Authorization: Bearer $(cat state/operator.token)"'
"""A variable that README.md sets once."""

FENCE = re.compile(r"^( *)(```+)(\w*)[^\n`]*\n(.*?)^\1\2 *$", re.MULTILINE | re.DOTALL)
REASON = re.compile(r"<!-- not run: (\S.*?) -->\s*\Z")
OUTPUT = {"", "text"}
"""Blocks in no language show what is printed, or a drawing."""

LANGUAGES = {"sh", "python", "yaml", "js"}
NO_BROWSER = "needs a browser"
"""The reason of every block in JavaScript."""


class Block(NamedTuple):
    """A block of code, the line where it begins, and the reason for which it does not run."""

    line: int
    language: str
    code: str
    reason: str | None


def blocks(page: str) -> Iterator[Block]:
    """Yield the blocks of a page that are code."""
    for match in FENCE.finditer(page):
        language, code = match[3], textwrap.dedent(match[4])
        if language in OUTPUT:
            continue
        comment = REASON.search(page[: match.start()])
        reason = comment[1] if comment else NO_BROWSER if language == "js" else None
        yield Block(page.count("\n", 0, match.start()) + 1, language, code, reason)


ALL = [(page.relative_to(CHECKOUT).as_posix(), block) for page in PAGES for block in blocks(page.read_text("utf-8"))]
RUN = [(page, block) for page, block in ALL if block.reason is None and block.language in {"sh", "python"}]
COMPILE = {page for page, block in RUN if "edge_unit.pipeline" in block.code}
"""Pages of which a block may have to compile kernels first."""
RUN_PAGES = [
    pytest.param(page, marks=[pytest.mark.slow] if page in COMPILE else [], id=page)
    for page in sorted({page for page, _ in RUN})
]
YAML = [(page, block) for page, block in ALL if block.reason is None and block.language == "yaml"]


def check_yaml(text: str) -> None:
    """Raise ValidationError or AssertionError unless `text` is a cell.yaml, a unit.yaml or a part of one."""
    keys: dict[str, Any] = yaml.safe_load(text)
    if keys.keys() <= {"pose"}:  # of any body
        keys = {"static": [{"name": "body", "box": [1.0, 1.0, 1.0], **keys}]}
    if keys.keys() <= CellFile.model_fields.keys():
        whole = {"name": "cell", "box": {"min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 1.0]}}
        CellFile.model_validate(whole | keys)
    elif keys.keys() <= UnitConfig.model_fields.keys():
        UnitConfig.model_validate({"source": {"kind": "simulated"}, "token": "t"} | keys if _no_token(keys) else keys)
    else:
        assert keys.keys() <= MasterConfig.model_fields.keys(), f"keys of no file of ours: {sorted(keys)}"
        MasterConfig.model_validate({"cell": "cell.yaml"} | keys)


def _no_token(keys: dict[str, Any]) -> bool:
    return not {"token", "token_file"} & keys.keys()


def test_every_block_is_in_a_language_that_is_run() -> None:
    unknown = [f"{page}:{block.line}: {block.language}" for page, block in ALL if block.language not in LANGUAGES]
    assert not unknown, "write `sh`, `python` or `yaml`; `text` for what is printed"
    assert len(ALL) > 30


@pytest.mark.parametrize(("page", "block"), YAML, ids=[f"{page}:{block.line}" for page, block in YAML])
def test_yaml_is_of_a_cell_or_a_unit(page: str, block: Block) -> None:
    check_yaml(block.code)


@pytest.fixture
def folder(tmp_path: Path, master: Cluster) -> Path:
    """The folder of a reader who has done what README.md says so far."""
    state = master.folder / "master"
    shutil.copytree(DEMO_CELL.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / "state").symlink_to(state)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "assets").symlink_to(CHECKOUT / "assets")
    for token in ("unit.token", "operator.token"):
        shutil.copy(state / token, tmp_path)
    return tmp_path


def command_of(block: Block, port: int) -> list[str]:
    """Return what runs a block, its master at `port`; a request that a master refuses fails the block."""
    code = re.sub(r"(?:localhost|127\.0\.0\.1):8420", f"127.0.0.1:{port}", block.code)
    if block.language == "python":
        return [sys.executable, "-c", code]
    for command in ("curl", "openssl"):
        if re.search(rf"\b{command}\b", code):
            need_command(command, command)
    code = re.sub(r"^( *|.*\| )curl ", r"\1curl -sS --fail-with-body --noproxy '*' ", code, flags=re.MULTILINE)
    code = re.sub(r"^(.*?) +# refused.*$", r"if \1; then exit 99; fi", code, flags=re.MULTILINE)
    return ["bash", "-euo", "pipefail", "-c", f"{OPERATOR}\n{code}"]


@pytest.mark.timeout(500)
@pytest.mark.parametrize("page", RUN_PAGES)
def test_the_blocks_of_a_page_run(page: str, folder: Path, master: Cluster) -> None:
    for block in [block for name, block in RUN if name == page]:
        command_line = command_of(block, master.port)
        endless = re.search(r"^\s*while True:", block.code, re.MULTILINE) is not None
        environment = {
            **os.environ,
            "PYTHONPATH": str(CHECKOUT),
            "PATH": f"{Path(sys.prefix) / 'bin'}:{os.environ['PATH']}",
            "NO_PROXY": "*",
        }
        process = subprocess.Popen(
            command_line, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        try:
            printed, _ = process.communicate(timeout=MOMENT_S if endless else LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            printed, _ = process.communicate()
            assert endless, f"{page}:{block.line}: still runs after {LIMIT_S:g} s\n{printed}"
            assert "Traceback" not in printed, f"{page}:{block.line}:\n{printed}"
        else:
            assert process.returncode == 0, f"{page}:{block.line}: exit {process.returncode}\n{printed}"


def test_a_block_says_why_it_is_not_run() -> None:
    page = (
        "<!-- not run: needs a camera -->\n\n```python\nx\n```\nText\n```python\ny\n```\n\n"
        "1. Do\n\n   ```sh\n   sudo x\n   ```\n```\noutput\n```\n```js\nz\n```\n"
    )
    assert list(blocks(page)) == [
        Block(3, "python", "x\n", "needs a camera"),
        Block(7, "python", "y\n", None),
        Block(13, "sh", "sudo x\n", None),
        Block(19, "js", "z\n", NO_BROWSER),
    ]


@pytest.mark.parametrize(
    "text",
    [
        "box: {min: [0, 0, 0]}",
        "name: a\nrobbot: {}",
        "source: {kind: none}",
        "static: [{name: a, mesh: a, scale: -1}]",
    ],
)
def test_wrong_yaml_is_found(text: str) -> None:
    with pytest.raises((ValidationError, AssertionError)):
        check_yaml(text)
