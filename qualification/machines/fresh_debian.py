# SPDX-License-Identifier: Apache-2.0
"""A Debian that has only Python, its venv and make, and the commands of an ordinary user in a checkout there.

The root file system is made once and is read-only. Writes go to the user's home and to /tmp, which lie beside it. pip
in the machine reaches the same index as pip here: it gets this machine's configuration, and every file that it names.
"""

from __future__ import annotations

import configparser
import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from qualification.networks import run
from shared.errors import CellwatchError, ConfigError
from shared.files import write_whole

SUITES = {"bookworm": "3.11", "trixie": "3.13"}
"""Debian's releases, and the Python version of each."""

PACKAGES = ("make", "python3", "python3-venv")
"""All packages that the README requires."""

TOOLS = {"git": "git", "mmdebstrap": "mmdebstrap", "systemd-nspawn": "systemd-container"}
"""Commands that the test needs here, and the package of each."""

NAMESPACES = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")
"""Mounts and processes end with the first process. The network is this machine's, as for any new user."""

USER, USER_ID = "newcomer", 1000
HOME = "/srv/newcomer"
CHECKOUT = f"{HOME}/cellwatch"
REPORTS = "reports"
"""Folder beside the checkout, for files that the test reads."""

WHEELS = "/srv/wheels"
"""pip's cache, which all roots share."""

PROPAGATED = Path("/run/systemd/nspawn")
"""Folder in which systemd-nspawn makes a folder for each container."""

DEBIAN_S = 600.0
"""Time limit to fetch and unpack Debian, a minute on a good network."""

LENT_VARIABLES = re.compile(
    r"PIP_(?!CACHE_DIR$|CONFIG_FILE$|NO_CACHE_DIR$)\w+|(?:https?|all|no)_proxy|SSL_CERT_(?:FILE|DIR)|\w+_CA_BUNDLE",
    re.IGNORECASE,
)
"""Environment variables that tell pip, and the libraries below it, how to reach an index."""

UNREACHABLE = ("Retrying (Retry(", "Temporary failure in name resolution", "Name or service not known")
"""Messages of pip about a failure of the network."""


def settle_in() -> None:
    """Hide the traces of systemd-nspawn, in private namespaces.

    Raises:
        ConfigError: the folder cannot be mounted over.
    """
    PROPAGATED.mkdir(parents=True, exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", "mode=0755", "tmpfs", str(PROPAGATED))


class Unreachable(CellwatchError):
    """Debian or the wheels cannot be fetched; the project is not the cause."""


@dataclass(frozen=True)
class Lent:
    """Parts of this machine that pip in a root gets."""

    variables: dict[str, str]
    configuration: str
    """One pip.conf, merged from all that apply here."""
    paths: tuple[Path, ...]
    """Existing files that the configuration names."""


def lend(environment: Mapping[str, str], home: Path) -> Lent:
    """Return the parts of this machine that pip needs, from its environment and configuration files."""
    variables = {name: value for name, value in environment.items() if LENT_VARIABLES.fullmatch(name)}
    merged = configparser.RawConfigParser()
    # As pip does: a missing file is skipped, and a later one overrides.
    merged.read(_configuration_files(environment, home))
    values = [*variables.values(), *(value for section in merged.sections() for value in merged[section].values())]
    text = io.StringIO()
    merged.write(text)
    return Lent(variables, text.getvalue(), tuple(sorted({path for value in values for path in _paths(value)})))


def _configuration_files(environment: Mapping[str, str], home: Path) -> Iterator[Path]:
    for folder in reversed(environment.get("XDG_CONFIG_DIRS", "/etc/xdg").split(":")):
        yield Path(folder) / "pip" / "pip.conf"
    yield Path("/etc/pip.conf")
    yield home / ".pip" / "pip.conf"
    yield Path(environment.get("XDG_CONFIG_HOME") or home / ".config") / "pip" / "pip.conf"
    yield from (Path(prefix) / "pip.conf" for prefix in (sys.base_prefix, sys.prefix))
    if name := environment.get("PIP_CONFIG_FILE"):
        yield Path(name)


def _paths(value: str) -> Iterator[Path]:
    for word in value.split():
        if word.startswith("file:///") and word.rstrip("/").endswith("/simple"):
            # An index in a folder; the files that it lists are in the same folder.
            word = word.rstrip("/").removesuffix("/simple")
        for name in word.removeprefix("file://").split(":"):
            if name.startswith("/") and not name.startswith("//") and Path(name).exists():
                yield Path(name)


@dataclass(frozen=True)
class FreshDebian:
    """One such machine, in a folder of this test."""

    suite: str
    folder: Path

    @property
    def root(self) -> Path:
        """Return its root file system."""
        return self.folder / self.suite

    @property
    def home(self) -> Path:
        """Return the path of the user's home on this machine."""
        return self.folder / "homes" / self.suite

    @property
    def checkout(self) -> Path:
        """Return the path of the user's checkout on this machine."""
        return self.home / Path(CHECKOUT).name

    def install(self) -> bool:
        """Make the root file system, unless one of the same packages exists. Return True if it was made.

        Raises:
            Unreachable: Debian cannot be fetched.
        """
        made, state = self.folder / f"{self.suite}.made", f"{self.suite}: {' '.join(PACKAGES)}\n"
        if self.root.is_dir() and made.is_file() and made.read_text() == state:
            return False
        made.unlink(missing_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        _remove(self.root)
        command = ("mmdebstrap", "--quiet", "--variant=minbase", f"--include={','.join(PACKAGES)}")
        try:
            subprocess.run((*command, self.suite, str(self.root)), check=True, timeout=DEBIAN_S)
        except subprocess.CalledProcessError as error:
            raise Unreachable(f"Debian {self.suite} cannot be fetched; see the output of mmdebstrap above") from error
        except subprocess.TimeoutExpired as error:
            raise Unreachable(f"Debian {self.suite} cannot be fetched within {DEBIAN_S:g} s") from error
        for name, line in (
            ("passwd", f"{USER}:x:{USER_ID}:{USER_ID}::{HOME}:/bin/sh"),
            ("group", f"{USER}:x:{USER_ID}:"),
        ):
            with (self.root / "etc" / name).open("a") as file:
                file.write(line + "\n")
        write_whole(made, state.encode(), synced=False)
        return True

    def check_out(self, source: Path, anew: bool) -> None:
        """Copy those files of the checkout `source` that git tracks or would add.

        With `anew` nothing of an earlier run is kept; without it environment and compiled kernels are kept.

        Raises:
            ConfigError: the folder is no checkout.
        """
        if anew:
            _remove(self.home)
        listing = self.home / "checked-out"
        before = listing.read_text().split("\0") if listing.is_file() else []
        names = _files(source)
        for name in set(before) - set(names):
            (self.checkout / name).unlink(missing_ok=True)
        for name in names:
            target = self.checkout / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if not _same(source / name, target):
                # The time of the file is kept, because make and numba use it to find outdated results.
                shutil.copy2(source / name, target)
        for part in ("tmp", "shared", REPORTS):
            (self.home / part).mkdir(exist_ok=True)
        listing.write_text("\0".join(names))
        owned_by = f"{USER_ID}:{USER_ID}"
        self._wheels.mkdir(exist_ok=True)
        subprocess.run(("chown", "-R", owned_by, str(self.home), str(self._wheels)), check=True)

    def run(
        self, command: str, log: Path, timeout_s: float, lent: Lent, beside: Path | None = None
    ) -> tuple[int | None, str]:
        """Run a shell command as the user, in the checkout, with `beside` as ../shared.

        Return its exit code, None if it did not end in time, and its standard output. `log` gets all output.
        """
        configuration = self.home / "pip.conf"
        # The file may hold a password.
        configuration.touch(mode=0o600)
        configuration.write_text(lent.configuration)
        os.chown(configuration, USER_ID, USER_ID)
        written = {HOME: self.home, "/tmp": self.home / "tmp", "/var/tmp": self.home / "tmp", WHEELS: self._wheels}
        read = {str(path): path for path in (Path("/etc/resolv.conf"), Path("/etc/hosts"), *lent.paths)}
        read["/etc/pip.conf"] = configuration
        if beside is not None:
            read[f"{HOME}/shared"] = beside
        for target, source in (written | read).items():
            self._make_mount_point(target, source.is_dir())
        binds = [f"--bind={source}:{target}" for target, source in written.items()]
        binds += [f"--bind-ro={source}:{target}" for target, source in read.items()]
        variables = lent.variables | {"PIP_CACHE_DIR": WHEELS}
        words = (
            "systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--as-pid2", f"--machine=fresh-{self.suite}",
            f"--hostname={os.uname().nodename}", f"--directory={self.root}", "--read-only", "--resolv-conf=off",
            "--timezone=off", "--link-journal=no", "--console=pipe", f"--user={USER}", f"--chdir={CHECKOUT}", *binds,
            *(f"--setenv={name}={value}" for name, value in variables.items()), "sh", "-c", command,
        )  # fmt: skip
        said = log.with_suffix(".stdout")
        try:
            with said.open("wb") as out, log.open("wb") as err:
                # Its own /tmp would be limited to a tenth of the memory.
                done = subprocess.run(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    timeout=timeout_s,
                    check=False,
                    env=os.environ | {"SYSTEMD_NSPAWN_TMPFS_TMP": "0"},
                )
            code: int | None = done.returncode
        except subprocess.TimeoutExpired:
            code = None
        finally:
            configuration.unlink()
        text = said.read_text(errors="replace")
        said.unlink()
        with log.open("a") as file:
            file.write(text)
        return code, text

    @property
    def _wheels(self) -> Path:
        return self.folder / "wheels"

    def _make_mount_point(self, target: str, is_folder: bool) -> None:
        """Make a mount point, which is not possible after the root is read-only."""
        point = self.root / target.lstrip("/")
        if is_folder:
            point.mkdir(parents=True, exist_ok=True)
        elif not point.exists():
            point.parent.mkdir(parents=True, exist_ok=True)
            point.touch()


def is_unreachable(log: Path) -> bool:
    """Return True if a command failed because of the network."""
    text = log.read_text(errors="replace")
    return any(words in text for words in UNREACHABLE)


def _files(source: Path) -> list[str]:
    """Return the files of a checkout that git tracks or would add, as they are now."""
    # Run as root, in a checkout of another user.
    git = ("git", "-C", str(source), "-c", f"safe.directory={source}", "ls-files", "-z")
    done = subprocess.run((*git, "--cached", "--others", "--exclude-standard"), capture_output=True, check=False)
    if done.returncode:
        raise ConfigError(f"{source}: expected a checkout, git says: {done.stderr.decode().strip()}")
    return sorted(name for name in done.stdout.decode().split("\0") if name and (source / name).is_file())


def _same(source: Path, target: Path) -> bool:
    if not target.exists():
        return False
    ours, theirs = source.stat(), target.stat()
    return (ours.st_size, ours.st_mtime_ns, ours.st_mode) == (theirs.st_size, theirs.st_mtime_ns, theirs.st_mode)


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
