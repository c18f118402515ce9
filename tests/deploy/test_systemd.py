# SPDX-License-Identifier: Apache-2.0
"""The unit files, verified by systemd itself and by the settings of the oldest supported version."""

from __future__ import annotations

import configparser
import re
import subprocess
from pathlib import Path

import pytest

from edge_unit.config import UnitConfig
from tests.missing import need_command

SYSTEMD = Path(__file__).parents[2] / "deploy" / "systemd"
SERVICES = sorted(SYSTEMD.glob("*.service"))
DAEMONS = [SYSTEMD / "edge-unit.service", SYSTEMD / "master-server.service"]

EXPOSURE_MAX = 2.0

KNOWN_TO_249 = {
    "Unit": "After Before Conflicts DefaultDependencies Description Documentation StartLimitIntervalSec Wants",
    "Install": "WantedBy",
    "Service": "AmbientCapabilities CacheDirectory CacheDirectoryMode CapabilityBoundingSet DeviceAllow DevicePolicy "
    "DynamicUser Environment ExecStart KeyringMode LimitCORE LimitNOFILE LockPersonality MemoryDenyWriteExecute "
    "MemoryMax Nice NoNewPrivileges NotifyAccess OOMScoreAdjust PrivateDevices PrivateTmp PrivateUsers ProtectClock "
    "ProtectControlGroups ProtectHome ProtectHostname ProtectKernelLogs ProtectKernelModules ProtectKernelTunables "
    "ProtectProc ProtectSystem RemainAfterExit RemoveIPC Restart RestartSec RestrictAddressFamilies "
    "RestrictNamespaces RestrictRealtime RestrictSUIDSGID StateDirectory StateDirectoryMode SupplementaryGroups "
    "SystemCallArchitectures SystemCallErrorNumber SystemCallFilter TasksMax TimeoutAbortSec TimeoutStartSec "
    "TimeoutStopSec Type UMask WatchdogSec",
}
"""Settings in use, each looked up in the manual of systemd 249. Look up a new setting there before adding it."""


class UnitFile(configparser.RawConfigParser):
    """A unit file: keys keep their case. Of a repeated key the last value is kept, which suffices here."""

    def __init__(self, path: Path) -> None:
        super().__init__(strict=False, interpolation=None, comment_prefixes=("#",), delimiters=("=",))
        self.read_string(path.read_text())

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    need_command("systemd-analyze", "systemd")
    return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("service", DAEMONS, ids=lambda path: path.name)
def test_systemd_has_nothing_to_say(service: Path) -> None:
    verified = analyze("verify", str(service))
    # systemd only warns about an unknown setting.
    assert (verified.returncode, verified.stderr, verified.stdout) == (0, "", "")


def test_systemd_would_say_something(tmp_path: Path) -> None:
    wrong = tmp_path / "edge-unit.service"
    wrong.write_text(DAEMONS[0].read_text().replace("RestartSec=1", "RestartSeconds=1"))
    assert "RestartSeconds" in analyze("verify", str(wrong)).stderr


@pytest.mark.parametrize("service", DAEMONS, ids=lambda path: path.name)
def test_the_services_have_few_privileges(service: Path) -> None:
    judged = analyze("security", "--offline=true", f"--threshold={round(10 * EXPOSURE_MAX)}", str(service))
    assert judged.returncode == 0, judged.stdout


@pytest.mark.parametrize("service", SERVICES, ids=lambda path: path.name)
def test_systemd_249_knows_every_setting(service: Path) -> None:
    unit = UnitFile(service)
    assert unit.sections() == ["Unit", "Service", "Install"]
    for section in unit.sections():
        assert set(unit[section]) <= set(KNOWN_TO_249[section].split())


@pytest.mark.parametrize("service", DAEMONS, ids=lambda path: path.name)
def test_it_is_watched_and_always_started_again(service: Path) -> None:
    unit = UnitFile(service)
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert unit["Service"]["Restart"] == "always"
    assert unit["Service"]["Type"] == "notify"
    assert float(unit["Service"]["WatchdogSec"]) <= 10.0
    assert unit["Service"]["DynamicUser"] == "yes"


def test_the_unit_writes_only_where_it_may() -> None:
    service = UnitFile(DAEMONS[0])["Service"]
    text = DAEMONS[0].read_text()
    assert f"CELLWATCH_JIT_CACHE=%C/{service['CacheDirectory']}" in text
    assert f"HOME=%S/{service['StateDirectory']}" in text


def test_the_unit_takes_its_state_directory_from_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/cellwatch-unit")
    config = UnitConfig.model_validate({"source": {"kind": "realsense"}})
    assert config.state_dir == Path("/var/lib/cellwatch-unit")


def test_rules_are_whole_and_name_a_group_that_the_unit_is_in() -> None:
    text = (SYSTEMD / "70-cellwatch-realsense.rules").read_text()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pair = r'[A-Z]+(?:\{[^}]+\})?(?:==|=)"[^"]*"'
    for line in lines:
        assert re.fullmatch(rf"{pair}(?:, {pair})*", line), line
    labels = set(re.findall(r'LABEL="(\w+)"', text))
    assert set(re.findall(r'GOTO="(\w+)"', text)) == labels
    products = [product for group in re.findall(r'idProduct\}=="([^"]+)"', text) for product in group.split("|")]
    assert len(products) == len(set(products))
    assert all(re.fullmatch("[0-9a-f]{4}", product) for product in products)
    assert {"0b07", "0b3a", "0b5c"} <= set(products)  # D435, D435i, D455
    groups = set(re.findall(r'GROUP="(\w+)"', text))
    assert groups <= set(UnitFile(DAEMONS[0])["Service"]["SupplementaryGroups"].split())


def test_every_group_is_made_where_it_is_missing() -> None:
    made = set(re.findall(r"^g (\w+) ", (SYSTEMD / "cellwatch.sysusers.conf").read_text(), re.MULTILINE))
    for service in DAEMONS:
        assert set(UnitFile(service)["Service"]["SupplementaryGroups"].split()) <= made


def test_the_journal_is_bounded() -> None:
    journal = UnitFile(SYSTEMD / "journald.conf.d" / "cellwatch.conf")["Journal"]
    assert journal["SystemMaxUse"].endswith("M")
    assert journal["RuntimeMaxUse"].endswith("M")
