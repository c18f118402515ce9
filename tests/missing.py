# SPDX-License-Identifier: Apache-2.0
"""Requirements of a test that this machine lacks."""

from __future__ import annotations

import os
import shutil
from typing import NoReturn

import pytest

from qualification.networks import NAMESPACES, allowed


def missing(reason: str) -> NoReturn:
    """Skip the test, except where CI is set: there it fails."""
    if os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


def need_command(command: str, package: str) -> None:
    """Require a command that no wheel brings; `package` is the package of the distribution."""
    if shutil.which(command) is None:
        missing(f"there is no {command} here (apt-get install {package})")


def need_namespaces() -> None:
    """Require private networks, in which a test may do anything."""
    need_command("ip", "iproute2")
    if not any(allowed(unshare) for unshare in NAMESPACES):
        missing("the kernel allows no namespaces here")
