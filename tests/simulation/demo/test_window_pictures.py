# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image, ImageDraw

from shared.errors import ConfigError
from simulation.demo import window_pictures


def frames(count: int) -> list[Image.Image]:
    """Return frames of a red square that moves over white."""
    found = []
    for number in range(count):
        frame = Image.new("RGB", (window_pictures.WIDTH, window_pictures.HEIGHT), "white")
        ImageDraw.Draw(frame).rectangle((100 * number, 100, 100 * number + 300, 400), fill="red")
        found.append(frame)
    return found


def test_frames_become_a_moving_picture(tmp_path: Path) -> None:
    path = tmp_path / "viewer.gif"
    window_pictures._keep(path, window_pictures._gif(frames(3)), window_pictures.GIF_BYTES_MAX)
    with Image.open(path) as image:
        assert (image.size, image.n_frames, image.info["loop"]) == ((720, 450), 3, 0)
        for number in range(3):
            image.seek(number)
            assert image.convert("RGB").getpixel((round((100 * number + 150) * 0.5625), 140)) == (255, 0, 0)


def test_a_picture_that_is_too_large_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected at most 10 bytes, got"):
        window_pictures._keep(tmp_path / "viewer.png", window_pictures._png(frames(1)[0]), 10)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_browser_is_named_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert window_pictures.main([str(tmp_path)]) == 1
    assert "scripts/system-packages installs it" in capsys.readouterr().err
