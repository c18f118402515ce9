# SPDX-License-Identifier: Apache-2.0
"""Draw the two pictures of docs/architecture.md from the source: the processes and their data, and the rooms.

`python scripts/draw_architecture.py` writes them into assets/pictures; it needs nothing but Python. The rooms are the
listings of the packages. The processes and calls are placed by hand, and held against the source: a process that the
product starts and the picture lacks is an error, and so is a call that the master does not serve.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

CHECKOUT = Path(__file__).resolve().parent.parent
PICTURES = CHECKOUT / "assets" / "pictures"

PRODUCT = ("edge_unit", "master_server")
"""Packages whose processes are drawn, and between whom the wall stands."""
TOOLS = ("simulation", "benchmarks", "qualification")
"""Packages around the product; their rooms are named without what they hold."""
LISTED = re.compile(r"^ {4}(\w+/?) +\S", re.MULTILINE)

PROCESSES = {
    "edge_unit/sources/realsense/capture_session.py": "capture process",
    "master_server/cells/cell_loading.py": "unpacking process",
    "master_server/viewer/host.py": "viewer process",
}
"""Calls by which the product starts a process, and the box of each."""

# ---------------------------------------------------------------------- what the source says


def listing(folder: Path) -> list[str]:
    """Return the modules of a package in the order of its listing; sub-packages end in a slash."""
    docstring = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")), clean=False)
    return LISTED.findall(docstring or "")


def packages(root: Path) -> list[str]:
    """Return the packages at the top of the checkout."""
    return sorted(file.parent.name for file in root.glob("*/__init__.py") if file.parent.name != "tests")


def imported(root: Path, package: str) -> set[str]:
    """Return the other packages of the project that `package` imports, inside functions too."""
    found = set()
    for file in (root / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.split(".")[0])
    return found & set(packages(root)) - {package}


def routes(root: Path) -> set[str]:
    """Return the calls that the master serves, as `PUT /settings`; a WebSocket is `WS`."""
    found = set()
    for file in (root / "master_server").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            path, name = node.args[0], ast.unparse(node.func)
            if not (isinstance(path, ast.Constant) and isinstance(path.value, str) and path.value.startswith("/")):
                continue
            verb = name.rpartition(".")[2]
            if verb in {"get", "put", "post", "delete"}:
                found.add(f"{verb.upper()} {path.value}")
            elif verb == "websocket":
                found.add(f"WS {path.value}")
            elif verb == "Route":
                methods = next(ast.literal_eval(word.value) for word in node.keywords if word.arg == "methods")
                found |= {f"{method} {path.value}" for method in methods}
    return found


def started(root: Path) -> set[str]:
    """Return the files of the product that start a process."""
    return {
        file.relative_to(root).as_posix()
        for package in PRODUCT
        for file in (root / package).rglob("*.py")
        if "create_subprocess_exec(" in file.read_text(encoding="utf-8")
    }


# ---------------------------------------------------------------------- how it is drawn

INK, FAINT, LINE = "#1f2937", "#6b7280", "#94a3b8"
COLOURS = {
    "edge_unit": ("#e8f1fb", "#2563a8"),
    "master_server": ("#fdf0e3", "#b45309"),
    "geometry": ("#eaf6ec", "#2f7d3b"),
    "shared": ("#f3eefb", "#6d43b0"),
}
PLAIN = ("#f4f5f7", "#64748b")
HARDWARE = ("#ffffff", "#475569")
SANS = "Helvetica, Arial, 'Liberation Sans', sans-serif"
MONO = "'DejaVu Sans Mono', Menlo, Consolas, monospace"
MONO_WIDTH = 0.63
"""Of a character of the widest of these fonts, in parts of its size."""


class Drawing:
    """An SVG that grows element by element."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height = width, height
        self._title = title
        self._parts: list[str] = []

    def box(self, x: float, y: float, w: float, h: float, colour: tuple[str, str], *, round_by: int = 8) -> None:
        """Draw a filled box with its top left corner at (x, y)."""
        self._parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="{round_by}" '
            f'fill="{colour[0]}" stroke="{colour[1]}" stroke-width="1.5"/>'
        )

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 13,
        colour: str = INK,
        bold: bool = False,
        mono: bool = False,
        anchor: str = "start",
    ) -> None:
        """Write one line with its base line at `y`."""
        weight = ' font-weight="bold"' if bold else ""
        family = f' font-family="{MONO}"' if mono else ""
        self._parts.append(
            f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" fill="{colour}" text-anchor="{anchor}"{weight}{family}>'
            f"{escape(text)}</text>"
        )

    def lines(self, x: float, y: float, lines: str, **style: object) -> None:
        """Write a few lines, the first with its base line at `y`."""
        size = float(str(style.get("size", 13)))
        for number, line in enumerate(lines.split("\n")):
            self.text(x, y + number * size * 1.35, line, **style)  # type: ignore[arg-type]  # as `text` takes them

    def arrow(self, *points: tuple[float, float], both: bool = False) -> None:
        """Draw a line through the points with a head at its end, or at both."""
        start = ' marker-start="url(#head)"' if both else ""
        path = " ".join(f"{'L' if number else 'M'}{x:g},{y:g}" for number, (x, y) in enumerate(points))
        self._parts.append(
            f'<path d="{path}" fill="none" stroke="{INK}" stroke-width="1.6"{start} marker-end="url(#head)"/>'
        )

    def line(self, *points: tuple[float, float], colour: str = LINE, wide: float = 1.5) -> None:
        """Draw a line through the points."""
        path = " ".join(f"{'L' if number else 'M'}{x:g},{y:g}" for number, (x, y) in enumerate(points))
        self._parts.append(f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{wide:g}"/>')

    def svg(self) -> str:
        """Return all of it."""
        return "\n".join(
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
                f'width="{self.width}" height="{self.height}" font-family="{SANS}" role="img">',
                f"<title>{escape(self._title)}</title>",
                '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
                f'orient="auto-start-reverse"><path d="M0,0 L10,5 L0,10 z" fill="{INK}"/></marker></defs>',
                f'<rect width="{self.width}" height="{self.height}" fill="#ffffff"/>',
                *self._parts,
                "</svg>",
                "",
            )
        )


# ---------------------------------------------------------------------- processes and data


class Call(NamedTuple):
    """A call on an arrow, and the routes that it stands for."""

    text: str
    routes: tuple[str, ...]


UNIT_CALLS = (
    Call("POST /initialize", ("POST /initialize",)),
    Call("POST /update", ("POST /update",)),
    Call("GET /robot", ("GET /robot",)),
    Call("GET /cell", ("GET /cell", "GET /cell/meshes/{sha256}")),
)
JOINT_CALLS = (Call("PUT /robot/joints", ("PUT /robot/joints",)),)
MAP_CALLS = (Call("WS /stream, GET /voxels", ("WS /stream", "GET /voxels")),)
OPERATOR_CALLS = (
    Call("PUT /settings, /cell", ("PUT /settings", "PUT /cell")),
    Call("GET /units", ("GET /units",)),
)
VIEWER_CALLS = (Call("/viewer/", ("GET /viewer", "WS /viewer")),)
METRICS_CALLS = (Call("GET /metrics", ("GET /metrics",)),)


def check_processes(root: Path) -> None:
    """Hold the picture of processes against the source.

    Raises:
        ValueError: the product starts a process that is not drawn, or a call on an arrow is not served.
    """
    if started(root) != set(PROCESSES):
        difference = ", ".join(sorted(started(root) ^ set(PROCESSES)))
        raise ValueError(
            f"the processes that the product starts are not those that are drawn; they differ by {difference}"
        )
    served = routes(root)
    for call in (*UNIT_CALLS, *JOINT_CALLS, *MAP_CALLS, *OPERATOR_CALLS, *VIEWER_CALLS, *METRICS_CALLS):
        for route in call.routes:
            if route not in served:
                raise ValueError(f"{call.text}: the master serves no {route}")


def draw_processes(root: Path) -> str:
    """Return the picture of processes and data, as SVG."""
    check_processes(root)
    drawing = Drawing(1320, 800, "Processes and data of Cellwatch")
    unit, master = COLOURS["edge_unit"], COLOURS["master_server"]
    white_unit, white_master = ("#ffffff", unit[1]), ("#ffffff", master[1])

    # Computers.
    drawing.box(20, 20, 470, 760, unit)
    drawing.text(40, 48, "edge computer, one beside each camera", size=16, bold=True, colour=unit[1])
    drawing.box(670, 20, 390, 760, master)
    drawing.text(690, 48, "the master's computer", size=16, bold=True, colour=master[1])
    drawing.text(1110, 48, "robot, people, plant", size=16, bold=True, colour=HARDWARE[1])

    # The edge computer.
    drawing.box(40, 70, 200, 70, HARDWARE, round_by=20)
    drawing.lines(140, 98, "depth camera\nRealSense D400, by USB", anchor="middle")
    drawing.arrow((140, 140), (140, 190))
    drawing.box(40, 190, 200, 96, white_unit)
    drawing.text(56, 214, "capture process", bold=True)
    drawing.lines(56, 234, "the SDK, which may hang;\nended and started anew\nby the unit", size=12, colour=FAINT)
    drawing.box(270, 190, 200, 96, HARDWARE)
    drawing.text(286, 214, "shared memory", bold=True)
    drawing.lines(286, 234, "depth images,\nuint16 (H, W): the only\ncopy of an image", size=12, colour=FAINT)
    drawing.arrow((240, 238), (270, 238))
    drawing.arrow((370, 286), (370, 330))
    drawing.box(40, 330, 430, 270, white_unit)
    drawing.text(56, 354, "unit process: edge-unit run", bold=True)
    drawing.box(56, 370, 398, 92, unit)
    drawing.text(70, 392, "worker thread, one frame at a time", bold=True)
    drawing.lines(
        70,
        412,
        "expected depth → foreground → voxels → density\n→ seen → health; kernels compiled by numba",
        size=12,
        colour=FAINT,
    )
    drawing.text(70, 450, "frame → report: keys, seen blocks, health", size=12)
    drawing.box(56, 486, 398, 98, unit)
    drawing.text(70, 508, "event loop", bold=True)
    drawing.lines(
        70,
        528,
        "source, uplink with a slot of one report, joint history,\n"
        "clock offset, commands of the master, search for the\nmaster by multicast DNS",
        size=12,
        colour=FAINT,
    )
    drawing.arrow((140, 462), (140, 486), both=True)
    drawing.box(40, 640, 430, 120, HARDWARE)
    drawing.text(56, 664, "disk: state_dir and caches", bold=True)
    drawing.lines(
        56,
        684,
        "cell and its meshes, background model, usual fit of the\n"
        "camera, last master, last camera: void or made again\nwhen they are lost; compiled kernels and hulls",
        size=12,
        colour=FAINT,
    )
    drawing.arrow((255, 600), (255, 640), both=True)

    # Between them.
    drawing.arrow((454, 520), (690, 520))
    drawing.arrow((690, 560), (454, 560))
    for number, call in enumerate(UNIT_CALLS):
        drawing.text(578, 452 + 18 * number, call.text, size=12, mono=True, anchor="middle")
    drawing.text(578, 542, "keys, seen, health, times", size=12, colour=FAINT, anchor="middle")
    drawing.lines(
        578,
        580,
        "in the answer: joints,\nversions, settings, pose,\ncommands",
        size=12,
        colour=FAINT,
        anchor="middle",
    )
    drawing.lines(578, 640, "8420/tcp; nothing\nconnects to a unit", size=12, bold=True, anchor="middle")

    # The master's computer.
    drawing.box(690, 330, 350, 270, white_master)
    drawing.text(706, 354, "master process: master-server", bold=True)
    drawing.box(706, 370, 318, 152, master)
    drawing.text(720, 392, "event loop", bold=True)
    drawing.lines(
        720,
        412,
        "guards: connections, rates, tokens\n"
        "slot for each IP address, freshness\n"
        "merge of fresh slots, witnesses\n"
        "union of what is seen\n"
        "stream, latest-only, 32 readers\n"
        "a tick each 25 ms",
        size=12,
        colour=FAINT,
    )
    drawing.box(706, 536, 318, 50, master)
    drawing.text(720, 556, "recording thread", bold=True)
    drawing.text(720, 574, "ten moments a second, as MCAP", size=12, colour=FAINT)
    drawing.box(690, 70, 165, 100, white_master)
    drawing.text(704, 94, "unpacking process", bold=True)
    drawing.lines(704, 114, "reads a zip of a cell,\nin bounds, once for\neach PUT /cell", size=12, colour=FAINT)
    drawing.box(875, 70, 165, 100, white_master)
    drawing.text(889, 94, "viewer process", bold=True)
    drawing.lines(889, 114, "viser, at loopback,\nwhile a browser is\nopen; has no token", size=12, colour=FAINT)
    drawing.arrow((772, 170), (772, 330), both=True)
    drawing.arrow((957, 170), (957, 330), both=True)
    drawing.box(690, 640, 350, 120, HARDWARE)
    drawing.text(706, 664, "disk: state_dir", bold=True)
    drawing.lines(
        706,
        684,
        "master.db: units, poses, settings, the cell;\nwritten before an answer says so\n"
        "unit.token, operator.token\nrecordings, the oldest deleted first",
        size=12,
        colour=FAINT,
    )
    drawing.arrow((865, 600), (865, 640), both=True)

    # Robot and people.
    people = (
        (100, "operator", "browser", VIEWER_CALLS),
        (228, "operator", "curl, scripts", OPERATOR_CALLS),
        (366, "robot's controller", "125 times a second", JOINT_CALLS),
        (494, "robot, planner, PLC", "readers of the map", MAP_CALLS),
        (622, "Prometheus", "every 15 s", METRICS_CALLS),
    )
    for y, name, detail, calls in people:
        drawing.box(1110, y, 190, 56, HARDWARE, round_by=20)
        drawing.text(1205, y + 24, name, bold=True, anchor="middle")
        drawing.text(1205, y + 43, detail, size=12, colour=FAINT, anchor="middle")
        for number, call in enumerate(calls):
            drawing.text(1205, y + 74 + 16 * number, call.text, size=11.5, mono=True, anchor="middle")
        drawing.line((1085, y + 28), (1110, y + 28), colour=INK, wide=1.6)
    # All of it by the master's one port.
    drawing.line((1085, 128), (1085, 650), colour=INK, wide=1.6)
    drawing.arrow((1085, 446), (1040, 446))
    return drawing.svg()


# ---------------------------------------------------------------------- rooms


class Room(NamedTuple):
    """A folder in the listing of a package, or the modules beside folders, and the modules that it lists."""

    name: str
    modules: tuple[str, ...]


def rooms_of(root: Path, package: str) -> list[Room]:
    """Return the rooms of a package in the order of the flow; modules that stand alone are gathered as they come."""
    rooms: list[Room] = []
    for name in listing(root / package):
        if name.endswith("/"):
            rooms.append(Room(name, tuple(listing(root / package / name.rstrip("/")))))
        elif rooms and not rooms[-1].name:
            rooms[-1] = Room("", (*rooms[-1].modules, name))
        else:
            rooms.append(Room("", (name,)))
    return rooms


def wrapped(modules: tuple[str, ...], width: float, size: float) -> list[str]:
    """Return the modules as lines of at most `width`, a mark between two in the order of the flow."""
    most = int(width / (size * MONO_WIDTH))
    lines = [""]
    for number, name in enumerate(modules):
        word = f"{name} → " if number + 1 < len(modules) else name
        if lines[-1] and len(lines[-1]) + len(word) > most:
            lines.append("")
        lines[-1] += word
    return [line.rstrip() for line in lines]


SIZE, STEP, PAD = 11.5, 16, 12
"""Of the modules' text, its line height, and the room around it."""


def card_height(rooms: list[Room], width: float) -> float:
    """Return the height of a package drawn by `draw_card`."""
    inner = width - 4 * PAD
    return 40 + sum(_room_height(room, inner) + 8 for room in rooms) + 6


def _room_height(room: Room, inner: float) -> float:
    return 14 + (18 if room.name else 0) + STEP * len(wrapped(room.modules, inner, SIZE) if room.modules else ())


def draw_card(
    drawing: Drawing, package: str, rooms: list[Room], x: float, y: float, width: float, height: float
) -> None:
    """Draw one package with its rooms, from the top in the order of the flow."""
    colour = COLOURS.get(package, PLAIN)
    drawing.box(x, y, width, height, colour)
    drawing.text(x + PAD, y + 26, f"{package}/", size=16, bold=True, colour=colour[1])
    top = y + 40
    for room in rooms:
        h = _room_height(room, width - 4 * PAD)
        drawing.box(x + PAD, top, width - 2 * PAD, h, ("#ffffff", colour[1]), round_by=5)
        line: float = top + 20
        if room.name:
            drawing.text(x + 2 * PAD, line, room.name, bold=True)
            line += 18
        for text in wrapped(room.modules, width - 4 * PAD, SIZE) if room.modules else ():
            drawing.text(x + 2 * PAD, line - 2, text, size=SIZE, mono=True, colour=FAINT if room.name else INK)
            line += STEP
        top += h + 8


def draw_rooms(root: Path) -> str:
    """Return the picture of packages, their rooms and their walls, as SVG."""
    found = packages(root)
    left, right, gap = 30, 690, 60
    wide, whole = 600, 1260
    sides = {package: rooms_of(root, package) for package in PRODUCT}
    side_height = max(card_height(rooms, wide) for rooms in sides.values())
    geometry_rooms, shared_rooms = rooms_of(root, "geometry"), rooms_of(root, "shared")
    geometry_height, shared_height = card_height(geometry_rooms, wide), card_height(shared_rooms, whole)
    others = [package for package in found if package not in (*PRODUCT, "geometry", "shared")]
    others.sort(key=lambda package: (package in TOOLS, TOOLS.index(package) if package in TOOLS else 0, package))
    other_wide = (whole - 20 * (len(others) - 1)) / len(others)
    other_rooms = {
        package: [Room("", tuple(name for room in rooms_of(root, package) for name in _named(room)))]
        for package in others
    }
    other_height = max(card_height(rooms, other_wide) for rooms in other_rooms.values())

    side_top = 76
    geometry_top = side_top + side_height + gap
    shared_top = geometry_top + geometry_height + gap
    others_top = shared_top + shared_height + gap
    table_top = others_top + other_height + 56
    height = int(table_top + 24 * (len(found) + 1) + 24)
    drawing = Drawing(whole + 60, height, "Packages of Cellwatch, their rooms and walls")
    drawing.text(left, 36, "The packages and their rooms, in the order of the flow", size=18, bold=True)
    note = "Within a package no module imports one that is listed below it."
    drawing.text(left, 57, note, colour=FAINT)

    for package, x in zip(PRODUCT, (left, right), strict=True):
        draw_card(drawing, package, sides[package], x, side_top, wide, side_height)
    draw_card(drawing, "geometry", geometry_rooms, left, geometry_top, wide, geometry_height)
    draw_card(drawing, "shared", shared_rooms, left, shared_top, whole, shared_height)
    for number, package in enumerate(others):
        beside = left + number * (other_wide + 20)
        draw_card(drawing, package, other_rooms[package], beside, others_top, other_wide, other_height)

    # The wall, and what leans on what.
    wall = (left + wide + right) / 2
    drawing.line((wall, side_top), (wall, shared_top - 18), colour="#b91c1c", wide=4)
    note_y = geometry_top + geometry_height / 2
    drawing.lines(
        wall + 16,
        note_y - 4,
        "The wall: neither side\nimports the other. They\nspeak HTTP only, by\nshared.messages and\nshared.wire.",
        colour="#b91c1c",
    )
    middle = left + wide / 2
    down = (
        ("edge_unit", "geometry", (middle, side_top + side_height), (middle, geometry_top)),
        ("geometry", "shared", (middle, geometry_top + geometry_height), (middle, shared_top)),
        ("edge_unit", "shared", (left + 12, side_top + side_height), (left + 12, shared_top)),
        ("master_server", "shared", (right + wide / 2, side_top + side_height), (right + wide / 2, shared_top)),
    )
    for importer, target, start, end in down:
        if target not in imported(root, importer):
            raise ValueError(f"{importer} does not import {target}, as it is drawn")
        if (importer, target) == ("edge_unit", "shared"):
            start, end = (start[0] - 24, start[1] - 20), (end[0] - 24, end[1] + 20)
            drawing.arrow((left, start[1]), start, end, (left, end[1]))
            continue
        drawing.arrow(start, end)
        drawing.text(start[0] + 10, start[1] + gap / 2 + 4, "imports", size=12, colour=FAINT)

    draw_table(drawing, root, found, left, table_top)
    return drawing.svg()


def _named(room: Room) -> tuple[str, ...]:
    return (room.name,) if room.name else room.modules


def draw_table(drawing: Drawing, root: Path, found: list[str], x: float, y: float) -> None:
    """Draw which package imports which."""
    order = [name for name in ("shared", "geometry", *PRODUCT) if name in found]
    order += [name for name in found if name not in order and name not in TOOLS]
    order += [name for name in TOOLS if name in found]
    drawing.text(x, y, "imports", size=13, bold=True)
    step = 140
    for column, target in enumerate(order):
        drawing.text(x + 190 + step * column, y, target, size=12, mono=True, anchor="middle")
    for row, package in enumerate(order):
        base = y + 24 * (row + 1)
        drawing.text(x, base, package, size=12, mono=True)
        drawing.line((x, base + 7), (x + 190 + step * len(order) - 70, base + 7), colour="#e5e7eb", wide=1)
        used = imported(root, package)
        for column, target in enumerate(order):
            middle = x + 190 + step * column
            if target in used:
                drawing.text(middle, base, "●", anchor="middle")
            elif target != package:
                drawing.text(middle, base, "·", colour=LINE, anchor="middle")


DRAWN = {"architecture-processes.svg": draw_processes, "architecture-rooms.svg": draw_rooms}
"""Each picture by its file in assets/pictures."""


def stale(root: Path, pictures: Path) -> Iterator[str]:
    """Yield the pictures that are not what the source says now."""
    for name, draw in DRAWN.items():
        file = pictures / name
        if not file.is_file() or file.read_text(encoding="utf-8") != draw(root):
            yield name


def main() -> int:
    """Write the pictures; with `--check` only tell which are not up to date."""
    if sys.argv[1:] == ["--check"]:
        old = list(stale(CHECKOUT, PICTURES))
        for name in old:
            print(f"assets/pictures/{name} is not what the source says: run python scripts/draw_architecture.py")
        return int(bool(old))
    for name, draw in DRAWN.items():
        (PICTURES / name).write_text(draw(CHECKOUT), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
