# SPDX-License-Identifier: Apache-2.0
"""The README's pictures of the operator's window: the demo in a browser, as a still and as a moving picture.

`python -m simulation.demo.window_pictures FOLDER` writes `viewer.png` and `viewer.gif`; needs Debian's chromium.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from playwright.async_api import Page, async_playwright

from shared.errors import CellwatchError, ConfigError
from simulation.fleet.fleet import Fleet, FleetOptions
from simulation.fleet.power import LABELS, PowerSwitch

WIDTH, HEIGHT = 1280, 800
GIF_WIDTH, GIF_HEIGHT = 720, 450

FRAMES, CUT_AT = 18, 7
"""Number of frames of the moving picture, and the frame after which a unit loses its power."""

STILL_AT = 3
"""Index of the still picture; in earlier frames everything still fades in."""

FRAME_MS = 450
"""Duration of each frame; without a graphics card, painting one takes about this time, too."""

COLOURS = 128

PNG_BYTES_MAX, GIF_BYTES_MAX = 400_000, 1_500_000
"""Limits of the files; a README is also read over slow lines."""

LOAD_MS = 90_000
"""Timeout of the first frame without a graphics card."""

SETTLE_S = 3.0
"""Delay until the robot and a person are in the picture, not only the cell."""

# Without a graphics card, SwiftShader renders WebGL.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

WITHOUT_NOTICES = ".mantine-Notifications-root { display: none }"
"""Hides the browser's notice of a missing graphics card, which does not concern the demo."""


async def take(folder: Path) -> None:
    """Run the demo and write both pictures.

    Raises:
        ConfigError: there is no browser, or a picture is too large.
    """
    browser_path = shutil.which("chromium")
    if browser_path is None:
        raise ConfigError("chromium: expected it to be installed, found none; scripts/system-packages installs it")
    with tempfile.TemporaryDirectory(prefix="cellwatch-pictures-") as scratch:
        fleet = Fleet(FleetOptions(), Path(scratch))
        async with fleet.processes, PowerSwitch(fleet.switch_power) as power:
            await fleet.start_master(power.actions)
            await (await fleet.start_warm_up())
            await fleet.start_units()
            link = await fleet.viewer_link()
            if link is None:
                raise ConfigError("the master has no viewer; expected viser to be installed")
            async with async_playwright() as playwright:
                browser = await playwright.chromium.launch(executable_path=browser_path, args=FLAGS)
                page = await browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
                page.set_default_timeout(LOAD_MS)
                frames = await _watch(page, link, fleet.options.units)
                await browser.close()
    folder.mkdir(parents=True, exist_ok=True)
    _keep(folder / "viewer.png", _png(frames[STILL_AT]), PNG_BYTES_MAX)
    _keep(folder / "viewer.gif", _gif(frames), GIF_BYTES_MAX)


async def _watch(page: Page, link: str, units: int) -> list[Image.Image]:
    await page.goto(link)
    await page.wait_for_function(f"document.querySelectorAll('tr[data-state=\"live\"]').length == {units}")
    await page.wait_for_selector("canvas")
    await page.add_style_tag(content=WITHOUT_NOTICES)
    await asyncio.sleep(SETTLE_S)
    frames = []
    for number in range(FRAMES):
        frames.append(Image.open(io.BytesIO(await page.screenshot())).convert("RGB"))
        if number == CUT_AT:
            await page.get_by_role("button", name=LABELS["cut"]).click()
        await asyncio.sleep(FRAME_MS / 1000.0)
    return frames


def _png(frame: Image.Image) -> bytes:
    data = io.BytesIO()
    frame.quantize(256).save(data, "PNG", optimize=True)
    return data.getvalue()


def _gif(frames: list[Image.Image]) -> bytes:
    data = io.BytesIO()
    small = [frame.resize((GIF_WIDTH, GIF_HEIGHT), Image.Resampling.LANCZOS) for frame in frames]
    # One palette for all, from a frame with all colours, so that only changes are written again.
    palette = small[-1].quantize(COLOURS)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in small)
    first.save(data, "GIF", save_all=True, append_images=others, duration=FRAME_MS, loop=0, optimize=True)
    return data.getvalue()


def _keep(path: Path, data: bytes, bytes_max: int) -> None:
    if len(data) > bytes_max:
        raise ConfigError(f"{path}: expected at most {bytes_max} bytes, got {len(data)}")
    path.write_bytes(data)
    print(f"{path}: {len(data)} bytes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Take the pictures; exit code 1 if they cannot be taken."""
    parser = argparse.ArgumentParser(prog="window_pictures", description="The README's pictures of the viewer.")
    parser.add_argument("folder", type=Path, help="folder for viewer.png and viewer.gif")
    options = parser.parse_args(arguments)
    try:
        asyncio.run(take(options.folder))
    except CellwatchError as error:
        print(f"make pictures: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
