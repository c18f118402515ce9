# SPDX-License-Identifier: Apache-2.0
"""The site: its reference follows the packages, its links lead somewhere, nothing is loaded from elsewhere."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.missing import missing

CHECKOUT = Path(__file__).resolve().parents[2]


def load_hooks() -> ModuleType:
    """Load scripts/site_hooks.py, which lies in no package."""
    spec = importlib.util.spec_from_file_location("site_hooks", CHECKOUT / "scripts" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hooks = load_hooks()


def test_every_public_name_has_a_docstring() -> None:
    assert list(hooks.without_docstring(CHECKOUT)) == []


def test_a_public_name_without_a_docstring_is_found(tmp_path: Path) -> None:
    (tmp_path / "things").mkdir()
    (tmp_path / "things" / "__init__.py").write_text('"""Things."""')
    (tmp_path / "things" / "one.py").write_text(
        "class A(B):\n    def f(self): return super().f()\n    def g(self): return 1\n    def _h(self): ...\n"
        'class P(Protocol):\n    """P."""\n    def f(self): ...\ndef public(): pass\ndef _private(): pass\n'
    )
    assert list(hooks.without_docstring(tmp_path)) == [
        "things/one.py:1: the module",
        "things/one.py:1: A",
        "things/one.py:3: g",
        "things/one.py:8: public",
    ]


def test_the_reference_has_every_package_and_module() -> None:
    pages = {package: hooks.reference_of(package, CHECKOUT) for package in hooks.packages(CHECKOUT)}
    assert CHECKOUT / "edge_unit" / "sources" / "realsense" in pages
    for package, page in pages.items():
        dotted = ".".join(package.relative_to(CHECKOUT).parts)
        for file in package.glob("*.py"):
            if not file.stem.startswith("_"):
                assert f"\n::: {dotted}.{file.stem}\n" in page
    pipeline = pages[CHECKOUT / "edge_unit" / "pipeline"]
    assert "[`DepthPipeline`][edge_unit.pipeline.depth_pipeline.DepthPipeline]" in pipeline


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("[a](cell.md#box)", "[a](cell.md#box)"),
        ("[a](../assets/cells/demo/cell.yaml)", "[a](repository/assets/cells/demo/cell.yaml.md)"),
        ("![a](../assets/pictures/demo.png)", "![a](repository/assets/pictures/demo.png)"),
        ("[a](../shared/__init__.py)", "[a](reference/shared.md)"),
        ("[a](../edge_unit/pipeline/)", "[a](reference/edge_unit/pipeline.md)"),
        ("[a](../benchmarks/REPORT.md)", "[a](repository/benchmarks/REPORT.md)"),
        ("[a](decisions/)", "[a](decisions/README.md)"),
        ("[a](../nothing.md)", "[a](../nothing.md)"),
        ("[a](#here) [b](https://example.org/x.md)", "[a](#here) [b](https://example.org/x.md)"),
        ('<img src="../assets/pictures/demo.png">', '<img src="repository/assets/pictures/demo.png">'),
        ("```\n[a](../README.md)\n```", "```\n[a](../README.md)\n```"),
    ],
)
def test_links_to_the_repository_lead_into_the_site(line: str, expected: str) -> None:
    assert hooks.linked(line, "docs/unit.md", "unit.md", CHECKOUT) == expected + "\n"


def test_lists_are_indented_as_the_site_needs_them() -> None:
    page = "Some:\n- one\n  more\n  - inner\n1. a\n\n   ```sh\n   - b\n   ```\n\nText\n```\n- no list\n```\n"
    assert hooks.lists_of_four(page) == (
        "Some:\n\n- one\n    more\n    - inner\n1. a\n\n    ```sh\n    - b\n    ```\n\nText\n```\n- no list\n```\n"
    )


def test_what_is_loaded_from_elsewhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<link rel="canonical" href="https://x/"><a href="https://x/">x</a><script src="//cdn/x.js"></script>'
        '<img src="here.png"><link rel="stylesheet" href="https://fonts/x.css">'
    )
    (tmp_path / "a.css").write_text("@import 'https://x/y.css'; a {background: url(here.png)} b {src: url(//x/z)}")
    assert list(hooks.foreign(tmp_path)) == [
        "a.css: https://x/y.css",
        "a.css: //x/z",
        "a.html: //cdn/x.js",
        "a.html: https://fonts/x.css",
    ]


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    if importlib.util.find_spec("mkdocs") is None:
        missing("there is no mkdocs here (make docs installs it)")
    build = (sys.executable, "-m", "mkdocs", "build", "-q", "--strict", "--site-dir", str(tmp_path))
    # A proxy that refuses: nothing is fetched.
    environment = {
        **os.environ,
        "NO_MKDOCS_2_WARNING": "1",
        "http_proxy": "http://[::1]:9",
        "https_proxy": "http://[::1]:9",
    }
    built = subprocess.run(build, cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "DepthPipeline" in (tmp_path / "reference" / "edge_unit" / "pipeline.html").read_text(encoding="utf-8")
    assert list(hooks.foreign(tmp_path)) == []
