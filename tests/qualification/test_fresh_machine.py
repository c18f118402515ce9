# SPDX-License-Identifier: Apache-2.0
"""Results of `make fresh-machine` from given machines, checkouts, demos and reports; no Debian is fetched here."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from qualification import fresh_machine
from qualification.fresh_machine import SMOKE_TESTS, Row, counted, demo_trouble, main, why_not
from qualification.machines import fresh_debian
from qualification.machines.fresh_debian import FreshDebian, Unreachable, is_unreachable, lend
from tests.missing import need_command

CHECKOUT = Path(__file__).parents[2]

REPORT = """<testsuites><testsuite tests="7">
<testcase classname="some.test_a" name="test_one" />
<testcase classname="some.test_a" name="test_two"><properties /></testcase>
<testcase classname="some.test_a" name="test_wrong"><failure message="no">text</failure></testcase>
<testcase classname="some.test_a" name="test_broken"><error message="no">text</error></testcase>
<testcase classname="some.test_a" name="test_seen[1]"><skipped message="no browser" /></testcase>
<testcase classname="some.test_a" name="test_seen[2]"><skipped message="no browser" /></testcase>
<testcase classname="some.test_a" name="test_booted"><skipped message="no machines" /></testcase>
</testsuite></testsuites>"""

FIGURES: dict[str, Any] = {"failures": [], "fps_per_unit": [15.0, 14.9, 15.0, 14.8]}


# ---------------------------------------------------------------- results


def test_reports_are_counted_with_the_reasons_of_skips(tmp_path: Path) -> None:
    for name in ("of-many-at-once", "one-by-one"):
        (tmp_path / name).write_text(REPORT)
    tests = counted(tmp_path, 2)
    assert (tests.passed, tests.failed, tests.skipped) == (4, 4, {"no browser": 4, "no machines": 2})
    assert tests.names == ["some.test_a::test_wrong", "some.test_a::test_broken"] * 2


@pytest.mark.parametrize("code", [2, None])
@pytest.mark.parametrize("text", [None, "", "<testsuites><testsuite>", "<testsuites><testcase /></testsuites>"])
def test_where_no_test_failed_and_the_command_did_one_has_failed(
    tmp_path: Path, text: str | None, code: int | None
) -> None:
    if text is not None:
        (tmp_path / "report").write_text(text)
    tests = counted(tmp_path, code)
    assert tests.failed == len(tests.names) == 1


@pytest.mark.parametrize(
    ("code", "said", "trouble"),
    [
        (0, "making .venv\n" + json.dumps(FIGURES) + "\n", None),
        (None, json.dumps(FIGURES), "it did not end"),
        (2, json.dumps(FIGURES), "it ended with 2"),
        (0, "", "its last line is not JSON"),
        (0, "Ctrl-C ends it\n", "its last line is not JSON"),
        (0, json.dumps(FIGURES | {"failures": ["unit2 is blind: why", "unit3"]}), "unit2 is blind: why; unit3"),
        (0, json.dumps(FIGURES | {"fps_per_unit": [15.0] * 3}), "expected frames of 4 units, got [15.0, 15.0, 15.0]"),
        (0, json.dumps(FIGURES | {"fps_per_unit": [15.0, 0.0] * 2}), "expected frames of 4 units, got [15.0, 0.0"),
    ],
)
def test_a_demo_is_good_only_with_frames_of_all_units(code: int | None, said: str, trouble: str | None) -> None:
    found = demo_trouble(code, said)
    assert (found is None) if trouble is None else (found or "").startswith(trouble)


def test_tests_of_the_smoke_part_are_there() -> None:
    assert [name for name in SMOKE_TESTS if not (CHECKOUT / name).is_file()] == []


# ---------------------------------------------------------------- exit codes


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *came: Row | BaseException) -> int:
    """Run the command inside of its namespaces, with machines that give these results."""
    each = iter(came)

    def pay(_: object) -> Row:
        outcome = next(each)
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(fresh_machine, "settle_in", lambda: None)
    monkeypatch.setattr(fresh_machine, "raise_when_stopped", lambda: None)
    monkeypatch.setattr(fresh_machine.Visit, "pay", pay)
    return main(["--inside", "--no-results", "--folder", str(tmp_path)])


WELL = Row("bookworm", "3.11", True, 2600, 0, 60, 900.5)


@pytest.mark.parametrize(
    ("came", "status"),
    [
        ((WELL, Row("trixie", "3.13", True, 2600, 0, 60, 890.0)), 0),
        ((WELL, Row("trixie", "3.13", False, 2600, 0, 60, 890.0)), 1),
        ((WELL, Row("trixie", "3.13", True, 2599, 1, 60, 890.0)), 1),
        ((WELL, Row("trixie", "3.13", True, 0, 0, 60, 890.0)), 1),
        ((WELL, Unreachable("Debian trixie cannot be fetched")), 3),
        ((KeyboardInterrupt(),), 130),
    ],
)
def test_the_last_line_is_json_whatever_happened(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    came: tuple[Row | BaseException, ...],
    status: int,
) -> None:
    assert run(monkeypatch, tmp_path, *came) == status
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["roots"]
    assert [row["debian"] for row in rows] == [row.debian for row in came if isinstance(row, Row)]
    keys = ["debian", "python", "demo_ok", "passed", "failed", "skipped", "seconds"]
    assert all(list(row) == keys for row in rows)


def test_all_packages_that_are_missing_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setenv("PATH", "")
    assert why_not() == "missing: apt-get install git mmdebstrap systemd-container"
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert why_not() == "only root may make root file systems"


# ---------------------------------------------------------------- the machine


def test_pip_is_lent_its_configuration_and_the_files_that_it_names(tmp_path: Path) -> None:
    home, authority, wheels, index = (tmp_path / name for name in ("home", "authority.pem", "wheels", "index"))
    for folder in (home / ".config" / "pip", wheels, index / "simple"):
        folder.mkdir(parents=True)
    authority.touch()
    (home / ".config" / "pip" / "pip.conf").write_text(
        f"[global]\nindex-url = file://{index}/simple/\nfind-links = {wheels}\n  {tmp_path}/gone\ntimeout = 7\n"
    )
    (tmp_path / "more.conf").write_text("[global]\ntimeout = 9\n[install]\nno-compile = yes\n")
    environment = {
        "PIP_CERT": str(authority),
        "PIP_CONFIG_FILE": str(tmp_path / "more.conf"),
        "PIP_CACHE_DIR": "/elsewhere",
        "https_proxy": "http://proxy.example:3128",
        "SSL_CERT_DIR": f"{wheels}:{tmp_path}/gone",
        "XDG_CONFIG_DIRS": str(tmp_path / "none"),
        "HOME": str(home),
    }
    lent = lend(environment, home)
    assert set(lent.variables) == {"PIP_CERT", "https_proxy", "SSL_CERT_DIR"}
    assert {authority, wheels, index} <= set(lent.paths)
    assert tmp_path / "gone" not in lent.paths
    assert "timeout = 9" in lent.configuration
    assert "[install]\nno-compile = yes" in lent.configuration


def test_the_user_gets_the_files_of_git_and_keeps_the_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_command("git", "git")
    monkeypatch.setattr(fresh_debian, "USER_ID", os.getuid())
    source = tmp_path / "source"
    source.mkdir()
    subprocess.run(("git", "init", "-q", str(source)), check=True)
    for name, text in ((".gitignore", "*.log\n"), ("kept.py", "1"), ("gone.py", "2"), ("run.log", "3")):
        (source / name).write_text(text)
    (source / "run").write_text("#!/bin/sh\n")
    (source / "run").chmod(0o755)
    machine = FreshDebian("bookworm", tmp_path / "fresh")
    machine.check_out(source, anew=True)
    assert {path.name for path in machine.checkout.iterdir()} == {".gitignore", "kept.py", "gone.py", "run"}
    assert os.access(machine.checkout / "run", os.X_OK)
    (machine.checkout / ".venv").mkdir()
    (source / "gone.py").unlink()
    (source / "kept.py").write_text("new")
    machine.check_out(source, anew=False)
    assert {path.name for path in machine.checkout.iterdir()} == {".gitignore", "kept.py", "run", ".venv"}
    assert (machine.checkout / "kept.py").read_text() == "new"
    machine.check_out(source, anew=True)
    assert not (machine.checkout / ".venv").exists()


def test_a_root_is_made_again_only_for_other_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A substitute for mmdebstrap that does the relevant part, or fails.
    commands = tmp_path / "bin"
    commands.mkdir()
    fake = commands / "mmdebstrap"
    fake.write_text(
        '#!/bin/sh\nfor root; do :; done\nmkdir -p "$root/etc" && touch "$root/etc/passwd" "$root/etc/group"\n'
    )
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    machine = FreshDebian("trixie", tmp_path / "fresh")
    assert machine.install()
    assert (machine.root / "etc" / "passwd").read_text().startswith("newcomer:x:1000:1000:")
    assert not machine.install()
    monkeypatch.setattr(fresh_debian, "PACKAGES", ("make", "python3", "python3-venv", "curl"))
    assert machine.install()
    monkeypatch.setattr(fresh_debian, "PACKAGES", ("make",))
    fake.write_text("#!/bin/sh\nexit 1\n")
    with pytest.raises(Unreachable, match="Debian trixie cannot be fetched"):
        machine.install()
    assert not (tmp_path / "fresh" / "trixie.made").exists()


@pytest.mark.parametrize(
    ("text", "unreachable"),
    [
        ("WARNING: Retrying (Retry(total=4, connect=None, read=None", True),
        ("ERROR: No matching distribution found for pyrealsense2==1.0", False),
    ],
)
def test_a_network_failure_differs_from_a_missing_wheel(tmp_path: Path, text: str, unreachable: bool) -> None:
    (tmp_path / "log").write_text(text)
    assert is_unreachable(tmp_path / "log") == unreachable
