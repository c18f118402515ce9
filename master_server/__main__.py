# SPDX-License-Identifier: Apache-2.0
"""`master-server --cell CELL.YAML`: serve one cell until stopped.

`master-server replay FILE...` serves a recording in place of a master. `master-server recording-info FILE...` lists the
content of a recording. `master-server new-token unit` replaces a token.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import json
import logging
import os
import signal
import socket
import ssl
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import uvicorn
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from master_server.app import Application, add_viewer, make_app, make_replay_app
from master_server.config import ENVIRONMENT_PREFIX, MasterConfig, ReplayConfig, ServerConfig
from master_server.core import Master, Readable
from master_server.logs import LogFormat, LogLevel, configure
from master_server.persistence import Store
from master_server.persistence.store import FILE_NAME
from master_server.recording.recorder import Recorder
from master_server.recording.replay import Replay
from master_server.recording.timeline import Timeline, summary
from master_server.security import Access, Limits, Role, load_access, token_file, write_token
from master_server.server.connection_guard import Acceptor, GuardedHttp, fingerprint, quiet, server_context
from master_server.server.latest_only_websocket import SERVER_OPTIONS
from master_server.viewer.host import is_installed
from master_server.viewer.proxy import PAGE, Gate, link_path
from master_server.viewer.sessions import LINK_S
from shared.cell import Cell
from shared.clock import monotonic_ns
from shared.configuration import assignments, load
from shared.discovery import Announcement, Announcer, only_loopback
from shared.errors import CellwatchError, ConfigError
from shared.files import write_whole
from shared.messages import CONTRACT_VERSION
from shared.service import ServiceManager

logger = logging.getLogger("master_server")

STOP_S = 1
"""Whole seconds for open requests at shutdown; a service manager allows two in all."""

BACKLOG = 256
"""Units that connect in the same moment, for example after a power cut, with room to spare."""

LOGGING = ("log_level", "log_format")
LISTENING = ("host", "port", "state_dir", "ready_file", "public_reads", "tls_certificate", "tls_key", *LOGGING)
REPLAY_OPTIONS = ("files", "speed", "start_s", "loop", *LISTENING)

SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}

ANY_ADDRESS = ("0.0.0.0", "::")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; an expected failure is one line and exit code 1."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in PARSERS:
        options = PARSERS[given[0]]().parse_args(given[1:])
    else:
        options = _parser().parse_args(given)
    try:
        options.run(options)
    except CellwatchError as error:
        print(f"master-server: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        logger.info("stopped")
    return 0


class _Server(uvicorn.Server):
    """A server that reports when it is ready."""

    def __init__(
        self,
        config: uvicorn.Config,
        listener: socket.socket,
        limits: Limits,
        tls: ssl.SSLContext | None,
        ready: Mapping[str, str | int],
        ready_file: Path | None,
        host: str,
        status: Callable[[], str],
        announcer: Announcer | None,
        gate: Gate | None,
    ) -> None:
        super().__init__(config)
        self._announcer = announcer
        self._announcing: asyncio.Task[None] | None = None
        self._gate = gate
        self._acceptor = Acceptor(listener, limits, self._protocol, tls)
        self._everywhere = f" and all other addresses of {socket.gethostname()}" if host in ANY_ADDRESS else ""
        self._ready = ready
        self._ready_file = ready_file
        self._status = status
        self._manager = ServiceManager()
        self._informing: asyncio.Task[None] | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._acceptor.start()
        # Exempt existing objects: each full collection would visit them, and all units would wait 0.1 s.
        gc.freeze()
        text = json.dumps(self._ready)
        if self._ready_file is not None:
            write_whole(self._ready_file, f"{text}\n".encode(), synced=False)
        print(f"master-server: listening at {self._ready['url']}{self._everywhere}", flush=True)
        for role in Role:
            path = self._ready[f"{role.value}_token_file"]
            print(f"master-server: the token of the {role.value} is in {path}", flush=True)
        if self._gate is not None:
            print(f"master-server: {self._viewer_line(self._gate)}", flush=True)
        self._manager.ready(self._status())
        if self._manager.is_present:
            self._informing = asyncio.create_task(self._manager.follow(self._status))
        if self._announcer is not None:
            self._announcing = asyncio.create_task(self._announcer.run())

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._manager.stopping()
        if self._informing is not None:
            self._informing.cancel()
        if self._announcing is not None:
            self._announcing.cancel()
        self._acceptor.close()
        await super().shutdown(sockets)
        if self._announcing is not None:
            await asyncio.wait((self._announcing,))

    def _viewer_line(self, gate: Gate) -> str:
        url = self._ready["url"]
        if not sys.stdout.isatty():
            # This line is kept in a log, and a log must not hold a link that grants access.
            return f"the viewer is at {url}{PAGE}"
        return f"the viewer is at {url}{link_path(gate.sessions)} (works once, within {LINK_S // 60} minutes)"

    def _protocol(self) -> GuardedHttp:
        return GuardedHttp(self.config, self.server_state, self.lifespan.state)


def _serve_master(options: argparse.Namespace) -> None:
    config = _config(options)
    configure(config.log_level, config.log_format)
    cell = Cell.load(config.cell)
    announced = config.announce
    if announced is None:
        announced = not only_loopback(config.host)
    with contextlib.closing(Store.open(config.state_dir / FILE_NAME)) as store:
        master = Master(cell, config.settings, store)
        recorder = Recorder(master, config.recording, config.state_dir / "recordings")

        def announce(sha256: str) -> Announcement:
            cell = master.published.reference
            return Announcement(cell.name, cell.sha256, CONTRACT_VERSION, bool(sha256), sha256)

        _serve(
            config, lambda access, limits: make_app(master, access, recorder, limits), announce if announced else None
        )


def _serve_replay(options: argparse.Namespace) -> None:
    config = load(ReplayConfig, None, os.environ, ENVIRONMENT_PREFIX, _overrides(options, REPLAY_OPTIONS))
    configure(config.log_level, config.log_format)
    with _opened(config.files) as recording:
        if recording.trouble:
            logger.warning("%s", recording.trouble)
        replay = Replay(recording, config.speed, config.start_s, config.loop)
        _serve(config, lambda access, limits: make_replay_app(replay, access, limits))


def _print_recording_info(options: argparse.Namespace) -> None:
    configure(options.log_level or "INFO", options.log_format or "text")
    with _opened(options.files) as recording:
        print("\n".join(summary(recording)))


def _replace_token(options: argparse.Namespace) -> None:
    path = write_token(options.state_dir, Role(options.role))
    print(f"master-server: the new token of the {options.role} is in {path}; a running master uses it within a second")


def _opened(files: Sequence[Path]) -> Timeline:
    """Open a recording; show the progress at a terminal."""
    columns = (TextColumn("reading"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("reading", total=None)
        return Timeline(files, lambda read, total: bar.update(task, completed=read, total=total))


def _serve(
    config: ServerConfig,
    make: Callable[[Access, Limits], Application],
    announce: Callable[[str], Announcement] | None = None,
) -> None:
    """Serve until stopped; `announce` turns the certificate's fingerprint (empty without TLS) into an announcement."""
    access = load_access(config.state_dir, config.public_reads)
    tls, sha256 = None, ""
    if config.tls_certificate is not None and config.tls_key is not None:
        tls = server_context(config.tls_certificate, config.tls_key)
        sha256 = fingerprint(config.tls_certificate)
        print(f"master-server: the certificate's fingerprint is sha256 {sha256}")
    limits = Limits()
    app = make(access, limits)
    gate = add_viewer(app, config.unit_actions) if config.viewer and is_installed() else None
    listener = _listen(config.host, config.port)
    listens_at, port = listener.getsockname()[:2]
    host = "127.0.0.1" if config.host in ANY_ADDRESS else config.host
    ready = {
        "url": f"{'http' if tls is None else 'https'}://{f'[{host}]' if ':' in host else host}:{port}",
        "port": port,
        "pid": os.getpid(),
        **{f"{role.value}_token_file": str(token_file(config.state_dir, role)) for role in Role},
    }
    logging.getLogger("uvicorn.error").addFilter(quiet)
    server = _Server(
        uvicorn.Config(
            app,
            http=GuardedHttp,
            log_config=None,
            access_log=False,
            # The caller's address is that of its connection; headers are ignored.
            proxy_headers=False,
            server_header=False,
            date_header=False,
            timeout_graceful_shutdown=STOP_S,
            **SERVER_OPTIONS,
        ),
        listener,
        limits,
        tls,
        ready,
        config.ready_file,
        config.host,
        lambda: _status(app.services.master, ready["url"]),
        Announcer(lambda: announce(sha256), listens_at, port) if announce is not None else None,
        gate,
    )
    # After an orderly stop, the server raises the signal again that it received.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        # It opens no socket itself: it gets bounded connections from the acceptor.
        server.run(sockets=[])
    finally:
        listener.close()
        if config.ready_file is not None:
            config.ready_file.unlink(missing_ok=True)


def _status(master: Readable, url: str) -> str:
    """Return one line for people: the number of live units, and the master's address."""
    states = [unit.state for unit in master.unit_states(monotonic_ns())]
    return f"{states.count('live')} of {len(states)} units live; at {url}"


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=BACKLOG, dualstack_ipv6=host == "::")
    except OSError as error:
        raise ConfigError(f"cannot listen at {host} port {port}: {error.strerror or error}") from error
    # Connections inherit this. Without it, the second half of an answer waits 40 ms for an acknowledgement.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _config(options: argparse.Namespace) -> MasterConfig:
    overrides = _overrides(options, ("cell", "announce", *LISTENING))
    if options.record is not None:
        overrides |= {"recording.enabled": True, "recording.folder": str(options.record)}
    return load(MasterConfig, options.config, os.environ, ENVIRONMENT_PREFIX, overrides)


def _overrides(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    overrides: dict[str, Any] = dict(assignments(options.set))
    return overrides | {name: value for name in names if (value := getattr(options, name)) is not None}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="master-server",
        description="The master that all edge units post to.",
        epilog=f"Every option may also be a variable, as in {ENVIRONMENT_PREFIX}PORT=9000; flags win over variables, "
        "and those over the file. Commands with a --help of their own: replay, recording-info, new-token.",
    )
    parser.set_defaults(run=_serve_master)
    parser.add_argument("--config", type=Path, metavar="YAML", help="configuration file")
    parser.add_argument("--cell", type=Path, metavar="YAML", help="the watched cell (cell.yaml)")
    _add_server_options(parser)
    parser.add_argument(
        "--announce",
        action=argparse.BooleanOptionalAction,
        help="announce the address by multicast DNS (default: unless it is loopback only)",
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="record the master's state, as MCAP files")
    return parser


def _replay_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="master-server replay",
        description="Serve a recording as if it were the master; pause and seek in it.",
    )
    parser.set_defaults(run=_serve_replay)
    parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="a recording (.mcap), or all files of one, in any order"
    )
    parser.add_argument("--speed", type=float, help="1 is real time")
    parser.add_argument("--from", dest="start_s", type=_seconds, metavar="TIME", help="start there, as in 30s or 5m")
    parser.add_argument("--loop", action="store_true", default=None, help="start anew at the end")
    _add_server_options(parser)
    return parser


def _info_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="master-server recording-info", description="List a recording's content.")
    parser.set_defaults(run=_print_recording_info)
    parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="a recording (.mcap), or all files of one, in any order"
    )
    _add_log_options(parser)
    return parser


def _token_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="master-server new-token",
        description="Replace a token: a running master refuses the old one within a second, and ends streams that "
        "were opened with it. The token itself is not printed.",
    )
    parser.set_defaults(run=_replace_token)
    parser.add_argument("role", choices=[role.value for role in Role], help="whose token")
    parser.add_argument("--state-dir", type=Path, metavar="DIR", required=True, help="state folder of the master")
    return parser


def _add_server_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", help="address to listen at (default: all)")
    parser.add_argument("--port", type=int, help="port to listen at, 0 for a free one (default: 8420)")
    parser.add_argument(
        "--state-dir", type=Path, metavar="DIR", help="folder of the tokens and of all state that outlives the master"
    )
    parser.add_argument("--tls-certificate", type=Path, metavar="PEM", help="serve TLS with this certificate ...")
    parser.add_argument("--tls-key", type=Path, metavar="PEM", help="... and its key")
    parser.add_argument("--ready-file", type=Path, metavar="FILE", help="written as JSON when the master is ready")
    parser.add_argument("--public-reads", action="store_true", default=None, help="reading needs no token")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="any other field: settings.voxel_size_m=0.03"
    )
    _add_log_options(parser)


def _add_log_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log-level", choices=get_args(LogLevel), help="lowest level that is logged (default: INFO)")
    parser.add_argument("--log-format", choices=get_args(LogFormat), help="lines as text or as JSON (default: text)")


def _seconds(text: str) -> float:
    """Parse `90`, `90s`, `1.5m` or `1h`."""
    number, unit = (text[:-1], text[-1]) if text[-1:] in SECONDS else (text, "s")
    try:
        return float(number) * SECONDS[unit]
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a time as in 30s, 5m or 1h, got {text}") from error


PARSERS = {"replay": _replay_parser, "recording-info": _info_parser, "new-token": _token_parser}


if __name__ == "__main__":
    sys.exit(main())
