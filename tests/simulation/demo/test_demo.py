# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulation.demo import __main__ as demo
from simulation.fleet.processes import STOP_SIGNALS


@pytest.fixture(autouse=True)
def own_signals(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Restore the signal handlers: the demo owns its process, the tests do not."""
    monkeypatch.delenv("MAKELEVEL", raising=False)
    before = [(number, signal.getsignal(number)) for number in STOP_SIGNALS]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--json",), "--json: expected --seconds"),
        (("--units", "0"), "--units: expected 1 to 50, got 0"),
        (("--people", "3"), "--people: expected 0 to 2, got 3"),
        (("--resolution", "100x100"), "--resolution: expected one of 424x240, "),
        (("--voxel-size", "1"), "--voxel-size: expected 0.01 to 0.1, got 1"),
        (("--seconds", "nan"), "--seconds: expected 1 to 600, got nan"),
        (("--fps", "many"), "--fps: invalid number value: 'many'"),
    ],
)
def test_wrong_options_are_refused_with_a_message(
    arguments: tuple[str, ...], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        demo.main(arguments)
    assert refused.value.code == 2
    assert sentence in capsys.readouterr().err


def test_a_folder_with_files_is_not_changed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "precious").touch()
    assert demo.main(("--folder", str(tmp_path))) == 1
    assert f"--folder {tmp_path}: expected an empty folder" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]
