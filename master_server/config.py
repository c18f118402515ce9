# SPDX-License-Identifier: Apache-2.0
"""The master's own configuration; settings that may change at run time are in `shared.settings`."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, model_validator

from master_server.logs import LogFormat, LogLevel
from master_server.recording.recorder import RecordingConfig
from master_server.recording.replay import SPEED_MAX, SPEED_MIN
from shared.files import default_state_dir
from shared.settings import Settings

ENVIRONMENT_PREFIX = "CELLWATCH_MASTER_"

DEFAULT_PORT = 8420


class ServerConfig(BaseModel):
    """Address, access and files of the server. Frozen; from a YAML file, `CELLWATCH_MASTER_*` variables and flags."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(default="0.0.0.0", description="Address to listen at.")
    port: int = Field(default=DEFAULT_PORT, ge=0, le=65535, description="0 takes a free one.")
    tls_certificate: Path | None = Field(default=None, description="PEM; with it and its key the master serves TLS.")
    tls_key: Path | None = Field(default=None, description="Key of the certificate, in PEM, without a password.")
    state_dir: Path = Field(
        default_factory=lambda: default_state_dir("master"),
        description="Folder of the tokens and of all state that outlives the master.",
    )
    public_reads: bool = Field(default=False, description="If true, reading needs no token.")
    log_level: LogLevel = Field(default="INFO", description="Lowest level that is logged.")
    log_format: LogFormat = Field(default="text", description="Lines for people, or JSON for a collector.")
    viewer: bool = Field(default=True, description="If true, operators find the 3-D view of the cell under `/viewer/`.")
    unit_actions: dict[str, str] = Field(
        default={},
        max_length=8,
        description="More actions on a unit in the viewer: the text of the button, and the address for its POST, with "
        "{id}, {ip} and {serial} of the unit.",
    )
    ready_file: Path | None = Field(
        default=None, description="File to write as JSON (url, port, pid, token files) when the master is ready."
    )

    @model_validator(mode="after")
    def _certificate_with_its_key(self) -> ServerConfig:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("expected tls_certificate and tls_key, got one of them")
        return self


class MasterConfig(ServerConfig):
    """Configuration of a master. Only `cell` has no default."""

    cell: Path = Field(description="The cell's `cell.yaml`.")
    settings: Settings = Field(default=Settings(), description="Settings of the first start.")
    announce: bool | None = Field(
        default=None, description="If true, announce the address by multicast DNS; by default, if beyond loopback."
    )
    recording: RecordingConfig = Field(default=RecordingConfig(), description="Recordings and their bounds.")


class ReplayConfig(ServerConfig):
    """Configuration of a server that replays a recording in place of a master."""

    files: tuple[Path, ...] = Field(min_length=1, description="The files of one recording, in any order.")
    speed: float = Field(default=1.0, ge=SPEED_MIN, le=SPEED_MAX, description="Speed of the replay; 1 is real time.")
    start_s: float = Field(default=0.0, ge=0.0, description="Time in the recording at which the replay starts.")
    loop: bool = Field(default=False, description="If true, start anew at the end.")
