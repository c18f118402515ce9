# SPDX-License-Identifier: Apache-2.0
"""A real headless browser, with all its requests and errors."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from tests.missing import missing

WIDTH, HEIGHT = 1280, 800

LOAD_MS = 90_000
"""Time limit of the first image: without a graphics card, and with two cores for everything, shaders are slow."""

# Without a graphics card SwiftShader renders WebGL.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

LOCAL_SCHEMES = ("data", "blob")

OUT = os.environ.get("CELLWATCH_VIEWER_OUT")
"""Folder in which screenshots are kept for people."""


def chromium() -> str:
    """Return the path of the browser. Without one a test is skipped; with CI set it fails."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        missing("no browser: expected Debian's chromium (scripts/system-packages installs it)")
    return path


@dataclass
class Witness:
    """Requests of a browser, and its errors."""

    asked: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def watch(self, context: BrowserContext) -> None:
        """Record everything from now on."""
        context.on("request", lambda request: self.asked.append(request.url))
        context.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        context.on("weberror", lambda error: self.errors.append(str(error.error)))

    def foreign(self, origin: str) -> list[str]:
        """Return the requests to any host but `origin`."""
        host = urlsplit(origin).netloc
        parts = [(url, urlsplit(url)) for url in self.asked]
        return [url for url, part in parts if part.scheme not in LOCAL_SCHEMES and part.netloc != host]


@contextmanager
def a_browser() -> Iterator[Browser]:
    """Start Debian's Chromium."""
    path = chromium()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def opened(context: BrowserContext, link: str) -> Page:
    """Return the window, once it shows the table of units and an image."""
    page = context.new_page()
    page.set_default_timeout(LOAD_MS)
    page.goto(link)
    page.wait_for_selector('[data-cellwatch="units"]', state="attached")
    page.wait_for_selector("canvas")
    return page


def shot(page: Page, name: str) -> NDArray[np.uint8]:
    """Return a screenshot (H, W, 3). It is kept as `name` if screenshots are kept."""
    data = page.screenshot()
    if OUT:
        folder = Path(OUT)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.png").write_bytes(data)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
