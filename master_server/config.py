# SPDX-License-Identifier: Apache-2.0
"""The master's own configuration; what may change while it runs is in `shared.settings`."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, model_validator

from master_server.recording import RecordingConfig
from shared.settings import Settings

ENVIRONMENT_PREFIX = "CELLWATCH_MASTER_"

DEFAULT_PORT = 8420


def default_state_dir() -> Path:
    """Where a service manager, or else the user's own conventions, want state to be kept."""
    if managed := os.environ.get("STATE_DIRECTORY"):
        return Path(managed.split(":")[0])
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "cellwatch" / "master"


class MasterConfig(BaseModel):
    """Frozen; from a YAML file, `CELLWATCH_MASTER_*` variables and flags. Only `cell` has no default."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cell: Path = Field(description="The cell's `cell.yaml`.")
    host: str = Field(default="0.0.0.0", description="Address to listen at.")
    port: int = Field(default=DEFAULT_PORT, ge=0, le=65535, description="0 takes a free one.")
    tls_certificate: Path | None = Field(default=None, description="PEM; with it and its key the master speaks TLS.")
    tls_key: Path | None = Field(default=None, description="Of the certificate, in PEM, without a password.")
    state_dir: Path = Field(default_factory=default_state_dir, description="Where tokens are kept.")
    public_reads: bool = Field(default=False, description="Whether reading needs no token.")
    settings: Settings = Field(default=Settings(), description="What the master starts with.")
    recording: RecordingConfig = Field(default=RecordingConfig(), description="What is recorded, and how much is kept.")
    ready_file: Path | None = Field(
        default=None, description="Written as JSON (url, port, pid, token files) when the master can be asked."
    )

    @model_validator(mode="after")
    def _certificate_with_its_key(self) -> MasterConfig:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("expected tls_certificate and tls_key, got one of them")
        return self
