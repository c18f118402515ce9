# SPDX-License-Identifier: Apache-2.0
"""A recording answers as the master did, also one whose writer was killed."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from master_server.__main__ import main
from master_server.api.routes import map, replay, robot, units
from master_server.app import make_app, make_replay_app
from master_server.core import Master
from master_server.recording import recording_reader as recorded_module
from master_server.recording import timeline as timeline_module
from master_server.recording.moment import METADATA, STATE_TOPIC, StateRecord, moment_of
from master_server.recording.recording_file import RecordingFile
from master_server.recording.recording_reader import Recording
from master_server.recording.replay import Replay, ReplayRequest
from master_server.recording.timeline import Timeline, duration_s
from master_server.security import Access
from shared.cell import Cell, PlacedMesh
from shared.errors import Refusal, SourceError
from shared.meshes import box_mesh
from shared.messages import JointsRequest
from shared.settings import Settings
from tests.master_server.fakes import MS, START_NS, FakeUnit, S, cell, sees_all

UNIT = "unit-token-0123456789"
OPERATOR = "operator-token-0123456789"
ACCESS = Access(UNIT.encode(), OPERATOR.encode())
WALL_LESS_MONOTONIC_NS = 1_700_000_000 * S
STEP_NS = 100 * MS
STEPS = 40
ASKED = (0, 7, 15, 16, 20, 21, 25, 26, 33, 39)
PATHS = (
    "/voxels?unseen=true",
    "/voxels?form=keys",
    "/voxels?form=centres",
    "/units",
    "/coverage?blocks=true",
    "/cell",
    "/settings",
    "/robot",
    f"/robot?since_ns={START_NS + S}",
)


@dataclass
class Clock:
    now_ns: int = START_NS

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Replace the clock wherever a route reads it."""
    clock = Clock()
    for module in (map, units, robot, replay):
        monkeypatch.setattr(module, "monotonic_ns", clock)
    return clock


@dataclass
class Script:
    """Four seconds of a master: voxels walk, a unit dies, settings, the cell and an object's place change."""

    master: Master = field(init=False)

    def __post_init__(self) -> None:
        crate = PlacedMesh("crate", box_mesh("crate", (0.1, 0.1, 0.1)), np.eye(4))
        bare = cell(with_robot=True)
        self.master = Master(
            Cell("test", bare.box_min_m, bare.box_max_m, objects=(crate,), robot=bare.robot), Settings()
        )
        self.units = [FakeUnit(self.master, ip=f"10.0.0.{n}", serial=f"S{n}") for n in (1, 2)]
        for unit in self.units:
            unit.initialize(START_NS)

    def step(self, number: int) -> int:
        """Run this step; return its end time."""
        now_ns = START_NS + S + number * STEP_NS
        self.master.put_joints(JointsRequest(positions=(0.01 * number, 0.5), velocities=(0.1, 0.0)), now_ns)
        if number == 20:
            self.master.change_settings({"voxel_size_m": 0.1, "seen_block_size_m": 0.2})
        if number == 25:
            moved = np.eye(4)
            moved[0, 3] = 0.3
            self.master.change_cell(self.master.cell.with_object_pose("crate", moved))
        for unit in self.units[: 2 if number < 10 else 1]:
            unit.update(now_ns, [number // 3, 411], seen=sees_all(self.master))
        return now_ns + MS


def record(path: Path, told: Callable[[int, Master, int], None] = lambda number, master, now_ns: None) -> None:
    script = Script()
    file = RecordingFile(path, WALL_LESS_MONOTONIC_NS)
    for number in range(STEPS):
        now_ns = script.step(number)
        file.add(moment_of(script.master, now_ns))
        told(number, script.master, now_ns)
    file.close()


async def ask(app: Any, method: str, path: str, token: str | None = OPERATOR, **more: Any) -> httpx.Response:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    transport = httpx.ASGITransport(app=app, client=("10.0.0.9", 40_000))
    async with httpx.AsyncClient(transport=transport, base_url="http://master") as client:
        return await client.request(method, path, headers=headers, **more)


async def answers(app: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for path in PATHS:
        response = await ask(app, "GET", path)
        assert response.status_code == 200, response.text
        found[path] = response.json()
        if path.startswith(("/voxels", "/coverage")):
            del found[path]["now_ns"]
    for sha256 in {found["/cell"]["objects"][0]["mesh"]}:
        found[sha256] = (await ask(app, "GET", f"/cell/meshes/{sha256}")).content
    found["etag"] = (await ask(app, "GET", "/cell")).headers["etag"]
    return found


def test_every_answer_equals_the_recorded_one(tmp_path: Path, clock: Clock) -> None:
    script = Script()
    app = make_app(script.master, ACCESS)
    file = RecordingFile(tmp_path / "a.mcap", WALL_LESS_MONOTONIC_NS)
    then: dict[int, dict[str, Any]] = {}
    for number in range(STEPS):
        clock.now_ns = script.step(number)
        file.add(moment_of(script.master, clock.now_ns))
        if number in ASKED:
            then[number] = asyncio.run(answers(app))
    file.close()
    reasons = {tuple(found["/voxels?unseen=true"]["reasons"]) for found in then.values()}
    # The compared answers must differ between the times.
    assert len(reasons) >= 4
    assert len({found["etag"] for found in then.values()}) == 2

    with Timeline([tmp_path / "a.mcap"]) as recording:
        assert recording.trouble == ""
        played = Replay(recording, clock=clock)
        app = make_replay_app(played, ACCESS)
        for number in (*ASKED, *reversed(ASKED)):
            body = {"position_s": number * 0.1, "playing": False}
            moved = asyncio.run(ask(app, "PUT", "/replay", json=body))
            assert moved.status_code == 200, moved.text
            clock.now_ns += 7 * S
            assert asyncio.run(answers(app)) == then[number], number


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    record(path)
    return path


@pytest.fixture
def recording(recorded: Path) -> Iterator[Timeline]:
    with Timeline([recorded]) as recording:
        yield recording


async def test_a_replay_is_marked_and_refuses_changes(recording: Timeline, clock: Clock) -> None:
    app = make_replay_app(Replay(recording, clock=clock), ACCESS)
    health = await ask(app, "GET", "/healthz", None)
    assert health.json() == {"status": "ok", "replay": True}
    pose = np.eye(4).tolist()
    for method, path, body, token in (
        ("PUT", "/settings", {"voxel_size_m": 0.03}, OPERATOR),
        ("PUT", "/units/1/pose", {"T_world_camera": pose}, OPERATOR),
        ("DELETE", "/units/1", None, OPERATOR),
        ("POST", "/units/1/background", None, OPERATOR),
        ("PUT", "/robot/joints", {"positions": [0.0, 0.0]}, OPERATOR),
        ("PUT", "/cell/objects/crate/pose", {"T_world_object": pose}, OPERATOR),
        ("PUT", "/cell", {}, OPERATOR),
        ("POST", "/initialize", {}, UNIT),
        ("POST", "/update", None, UNIT),
    ):
        refused = await ask(app, method, path, token, json=body)
        assert refused.status_code == 409, (path, refused.text)
        assert refused.json()["detail"] == "this is a replay: nothing in it can be changed"
        assert refused.headers["cellwatch-replay"] == "true"
    assert (await ask(app, "POST", "/recording")).status_code == 409
    assert (await ask(app, "GET", "/voxels", None)).status_code == 401
    assert (await ask(app, "PUT", "/replay", UNIT, json={})).status_code == 403
    for path in (*PATHS, "/healthz", "/replay", "/nothing"):
        assert (await ask(app, "GET", path)).headers["cellwatch-replay"] == "true"


def test_a_replay_plays_pauses_and_seeks(recorded: Path, clock: Clock) -> None:
    with Timeline([recorded]) as recording:
        assert duration_s(recording) == pytest.approx((STEPS - 1) * 0.1)
        played = Replay(recording, speed=2.0, start_s=0.5, clock=clock)
        heard: list[int] = []
        played.listeners.append(lambda: heard.append(1))

        def position_s() -> float:
            return played.answer(clock.now_ns).position_s

        assert position_s() == 0.5
        # The next moment is 0.1 s later in the recording.
        assert played.next_change_ns(clock.now_ns) == clock.now_ns + 50 * MS
        clock.now_ns += 500 * MS
        assert position_s() == 1.5
        played.change(ReplayRequest(playing=False), clock.now_ns)
        clock.now_ns += 9 * S
        assert position_s() == 1.5
        assert played.next_change_ns(clock.now_ns) is None
        played.change(ReplayRequest(position_s=3.0, speed=1.0, playing=True), clock.now_ns)
        clock.now_ns += S // 2
        assert position_s() == 3.5
        assert played.answer(clock.now_ns).recorded_at_ns == START_NS + S + 35 * STEP_NS + MS + WALL_LESS_MONOTONIC_NS
        clock.now_ns += 60 * S
        ended = played.answer(clock.now_ns)
        assert (ended.position_s, ended.playing) == (3.9, False)
        again = played.change(ReplayRequest(playing=True), clock.now_ns)
        assert (again.position_s, again.playing) == (0.0, True)
        with pytest.raises(Refusal, match=r"expected at most 3\.900 s, got 3\.95"):
            played.change(ReplayRequest(position_s=3.95), clock.now_ns)
        assert len(heard) == 3

        looping = Replay(recording, loop=True, clock=clock)
        clock.now_ns += round(4.9 * S)
        assert looping.answer(clock.now_ns).position_s == pytest.approx(1.0)
        assert looping.answer(clock.now_ns).playing


WRITER = """
import os, signal, sys
from pathlib import Path
from tests.master_server.recording.test_replay import WALL_LESS_MONOTONIC_NS, Script
from master_server.recording.recording_file import RecordingFile
from master_server.recording.moment import METADATA, STATE_TOPIC, StateRecord, moment_of
script = Script()
file = RecordingFile(Path(sys.argv[1]), WALL_LESS_MONOTONIC_NS)
for number in range(36):
    file.add(moment_of(script.master, script.step(number)))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writer_leaves_all_but_its_last_chunk(tmp_path: Path, clock: Clock) -> None:
    whole: dict[int, Any] = {}
    record(tmp_path / "whole.mcap", lambda number, master, now_ns: whole.update({number: master.view(now_ns)}))
    killed = tmp_path / "killed.mcap"
    process = subprocess.run([sys.executable, "-c", WRITER, str(killed)], check=False)
    assert process.returncode == -signal.SIGKILL
    with Timeline([killed]) as recording:
        assert recording.trouble == "killed.mcap: its writer was stopped before it could finish it"
        # Chunks of 1 s: of 3.6 s, three are there, of eleven moments each.
        assert duration_s(recording) == pytest.approx(3.2)
        for number in range(33):
            view = recording.at(recording.begin_ns + number * STEP_NS).view
            np.testing.assert_array_equal(view.keys, whole[number].keys)
            assert view.reasons == whole[number].reasons


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_file_is_read_in_part_or_refused_in_one_sentence(recorded: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = recorded.read_bytes()
    served, refused, damaged = 0, 0, 60
    for _ in range(damaged):
        data = bytearray(whole)
        if rng.random() < 0.5:
            data = data[: rng.integers(0, len(data))]
        else:
            for place in rng.integers(0, len(data), 3):
                data[place] = rng.integers(0, 256)
        recorded.write_bytes(data)
        try:
            with Recording(recorded) as recording:
                for log_ns in range(recording.begin_ns, recording.end_ns, 3 * STEP_NS):
                    recording.at(log_ns)
                served += 1
        except SourceError as error:
            refused += str(recorded) in str(error)
    assert served > 0
    assert refused > 0
    assert served + refused == damaged


def test_a_damaged_chunk_is_skipped(recorded: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Recording(recorded) as recording:
        places = recording._index.chunks
        before = recording.at(recording.begin_ns + 10 * STEP_NS)
    data = bytearray(recorded.read_bytes())
    middle = places[1].offset + places[1].length // 2
    data[middle] ^= 0xFF
    recorded.write_bytes(data)
    with Recording(recorded) as recording:
        assert recording.at(recording.begin_ns + 15 * STEP_NS).log_ns == before.log_ns
        assert recording.at(recording.begin_ns + 30 * STEP_NS).log_ns == recording.begin_ns + 30 * STEP_NS
    assert "is damaged and skipped" in caplog.text


def test_a_file_that_is_no_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_text("no recording at all")
    with (tmp_path / "other.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    for name, words in (
        ("gone.mcap", "cannot be read: No such file"),
        ("empty.mcap", "it is empty"),
        ("text.mcap", "it is no MCAP file"),
        ("other.mcap", "expected a master's recording of format 1.x, got none"),
    ):
        for command in ("recording-info", "replay"):
            assert main([command, str(tmp_path / name)]) == 1
            line = capsys.readouterr().err
            assert line.startswith(f"master-server: {tmp_path / name}: ")
            assert words in line
            assert line.count("\n") == 1


class Later(StateRecord):
    """A record of a possible later version."""

    temperature_c: float


def test_a_recording_of_another_version_is_reported_when_opened(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_module, "StateRecord", Later)
    with pytest.raises(SourceError, match=r"Later: temperature_c: field required"):
        Recording(recorded)


def test_info_lists_the_content(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recording-info", str(recorded)]) == 0
    out = capsys.readouterr().out
    assert "(3.9 s)" in out
    assert "cell      test: 0 0 0 to 1 2 0.5 m" in out
    assert "trouble   none" in out
    assert "units: 1 live, 2 live" in out
    assert any(line.split() == ["/cellwatch/state", "40"] for line in out.splitlines())


@pytest.mark.parametrize(("text", "words"), [("x", "30s, 5m or 1h"), ("5d", "30s, 5m or 1h")])
def test_a_wrong_time_is_named(recorded: Path, capsys: pytest.CaptureFixture[str], text: str, words: str) -> None:
    with pytest.raises(SystemExit):
        main(["replay", str(recorded), "--from", text])
    assert words in capsys.readouterr().err


def test_a_moved_object_costs_a_transform_and_no_mesh(recorded: Path) -> None:
    with Recording(recorded) as recording:
        assert recording.counts["/cell"] == 1
        assert len(recording.cells) == 2
        assert [json.dumps(one["objects"][0]["T_world_mesh"][0]) for one in recording.cells] == [
            "[1.0, 0.0, 0.0, 0.0]",
            "[1.0, 0.0, 0.0, 0.3]",
        ]


def record_in_files(folder: Path, steps: tuple[int, ...], missing_s: float = 0.0) -> list[Path]:
    """Record the same script, with a new file after each of these numbers of steps; between files, time is missing."""
    script = Script()
    paths, startup = [], 0
    for number, ended in enumerate((*steps, STEPS)):
        paths.append(folder / f"{9 - number}.mcap")
        file = RecordingFile(paths[-1], WALL_LESS_MONOTONIC_NS + round(number * missing_s * S))
        for step in range(startup, ended):
            file.add(moment_of(script.master, script.step(step)))
        file.close()
        startup = ended
    return paths


def test_files_of_one_recording_are_one_timeline(tmp_path: Path, recorded: Path, clock: Clock) -> None:
    paths = record_in_files(tmp_path, (13, 26))
    told: list[tuple[int, int]] = []
    with Recording(recorded) as whole, Timeline(sorted(paths), lambda *read: told.append(read)) as recording:
        assert [file.path for file in recording.files] == paths
        assert (recording.begin_ns, recording.end_ns) == (whole.begin_ns, whole.end_ns)
        assert recording.trouble == ""
        assert recording.counts["/cellwatch/state"] == STEPS
        for number in (*range(STEPS), 3, 38, 14):
            log_ns = whole.begin_ns + number * STEP_NS
            assert recording.after(log_ns) == whole.after(log_ns)
            for found, expected in zip(recording.at(log_ns)[:3], whole.at(log_ns)[:3], strict=True):
                assert repr(found) == repr(expected)
        assert [one["objects"] for one in recording.cells] == [one["objects"] for one in whole.cells]
        assert sorted(recording.meshes) == sorted(whole.meshes)
        assert recording.mesh(whole.meshes[0]) == whole.mesh(whole.meshes[0])
        assert recording.mesh("0" * 64) is None
        with pytest.raises(SourceError, match="is missing"):
            recording.cell("0" * 64)
        sizes = sum(path.stat().st_size for path in paths)
        assert recording.size_bytes == sizes
        assert told[-1] == (sizes, sizes)
        assert [read for read, _ in told] == sorted(read for read, _ in told)
        played = Replay(recording, clock=clock)
        answer = played.change(ReplayRequest(position_s=2.0, playing=False), clock.now_ns)
        assert (answer.file, answer.files) == ("8.mcap", 3)
        assert answer.duration_s == pytest.approx((STEPS - 1) * 0.1)


@pytest.mark.parametrize(
    ("missing_s", "words"), [(1.0, "1 s are missing after 9.mcap"), (-1.0, "it overlaps 9.mcap by 1 s")]
)
def test_files_of_several_recordings_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing_s: float, words: str
) -> None:
    monkeypatch.setattr(timeline_module, "GAP_MAX_S", 0.5)
    with pytest.raises(SourceError, match=words):
        Timeline(record_in_files(tmp_path, (20,), missing_s))


def test_each_file_counts_once(recorded: Path) -> None:
    with pytest.raises(SourceError, match="expected each file once"):
        Timeline([recorded, recorded])


def test_info_covers_all_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = record_in_files(tmp_path, (13,))
    assert main(["recording-info", *(str(path) for path in paths)]) == 0
    out = capsys.readouterr().out
    assert all(str(path) in out for path in paths)
    assert "(3.9 s)" in out


def rewritten(path: Path, target: Path, version: str, change: Callable[[str, dict[str, Any]], None]) -> Path:
    """Write a recording again, as another version would: each JSON message after `change(topic, fields)`."""
    with path.open("rb") as source, target.open("wb") as out:
        reader = make_reader(source)
        writer = Writer(out)
        writer.start("", "")
        writer.add_metadata(METADATA, {"format": version})
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data
            if channel.topic.startswith("/cellwatch/"):
                fields = json.loads(data)
                change(channel.topic, fields)
                data = json.dumps(fields).encode()
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        writer.finish()
    return target


def of_a_later_minor(topic: str, fields: dict[str, Any]) -> None:
    fields["weather"] = "fog"
    if topic == STATE_TOPIC:
        fields["causes"] = [{"code": "fogged", "sentence": "unit 1 is fogged", "numbers": {}}]
        fields["reasons"], fields["complete"] = ["unit 1 is fogged"], False
        fields["robot"] |= {"state": "drifting", "drift_rad": 0.1}
        for unit in fields["units"]:
            unit |= {"state": "dozing", "mood": "good"}
            unit["health"] |= {"trouble_code": "fogged", "humidity": 0.9}


def test_a_recording_of_a_later_minor_plays_without_what_is_unknown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    record(tmp_path / "now.mcap")
    later = rewritten(tmp_path / "now.mcap", tmp_path / "later.mcap", "1.99", of_a_later_minor)
    with Recording(later) as recording, Recording(tmp_path / "now.mcap") as own:
        frame, same = recording.at(recording.begin_ns), own.at(own.begin_ns)
    assert "its format 1.99 is newer than 1.1" in caplog.text
    assert frame.settings == same.settings
    np.testing.assert_array_equal(frame.view.keys, same.view.keys)
    assert not frame.view.complete
    assert [cause.code for cause in frame.view.causes] == ["fogged"]
    assert {unit.state for unit in frame.state.units} == {"dozing"}
    assert (frame.state.robot.state, frame.state.units[0].health.trouble_code) == ("drifting", "fogged")


def test_a_recording_of_the_first_format_plays(tmp_path: Path) -> None:
    def of_1_0(topic: str, fields: dict[str, Any]) -> None:
        fields.pop("causes", None)
        fields.pop("reports", None)
        for unit in fields.get("units", ()):
            for name in ("cause", "contract_minor"):
                unit.pop(name, None)

    record(tmp_path / "now.mcap")
    first = rewritten(tmp_path / "now.mcap", tmp_path / "first.mcap", "1", of_1_0)
    with Recording(first) as recording, Recording(tmp_path / "now.mcap") as own:
        frame, same = recording.at(recording.begin_ns), own.at(own.begin_ns)
        assert frame.view.reasons == same.view.reasons
        np.testing.assert_array_equal(frame.view.keys, same.view.keys)


def test_a_moment_that_is_not_complete_and_says_not_why_is_not_complete(tmp_path: Path) -> None:
    def silent(topic: str, fields: dict[str, Any]) -> None:
        if topic == STATE_TOPIC:
            fields |= {"complete": False, "reasons": [], "causes": []}

    record(tmp_path / "now.mcap")
    with Recording(rewritten(tmp_path / "now.mcap", tmp_path / "silent.mcap", "1.1", silent)) as recording:
        view = recording.at(recording.end_ns).view
    assert not view.complete
    assert view.reasons


@pytest.mark.parametrize("version", ["2", "2.0", "0.9", "", "one"])
def test_a_recording_of_another_major_is_refused_in_one_sentence(tmp_path: Path, version: str) -> None:
    record(tmp_path / "now.mcap")
    other = rewritten(tmp_path / "now.mcap", tmp_path / "other.mcap", version, lambda topic, fields: None)
    with pytest.raises(SourceError, match=rf"other\.mcap: expected a master's recording of format 1\.x, got {version}"):
        Recording(other)
