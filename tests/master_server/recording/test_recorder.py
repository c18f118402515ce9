# SPDX-License-Identifier: Apache-2.0
"""Recordings: readable by standard tools, bounded, and without delay for the master."""

from __future__ import annotations

import asyncio
import json
import resource
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pydantic import ValidationError

from master_server.core import Master
from master_server.recording import foxglove
from master_server.recording.moment import MapRecord, SeenRecord, StateRecord, moment_of
from master_server.recording.recorder import Recorder, RecordingConfig
from master_server.recording.recording_file import RecordingFile
from shared.clock import monotonic_ns
from shared.errors import Refusal
from shared.lattice import Lattice
from shared.meshes import box_mesh
from shared.messages import JointsRequest
from tests.master_server.fakes import MS, START_NS, S, joined, master, sees_all

pytestmark = pytest.mark.alone

WALL_LESS_MONOTONIC_NS = 1_700_000_000 * S
PATIENCE_S = 10.0


async def until(look: Callable[[], Any]) -> None:
    deadline_ns = monotonic_ns() + PATIENCE_S * S
    while not look():
        assert monotonic_ns() < deadline_ns
        await asyncio.sleep(0.005)


def scripted(path: Path) -> Master:
    """Three seconds of two units and a robot: a voxel walks, one unit dies, the lattice changes."""
    watched = master(with_robot=True)
    first, second = joined(watched, 1), joined(watched, 2)
    file = RecordingFile(path, WALL_LESS_MONOTONIC_NS)
    for step in range(30):
        now_ns = START_NS + S + step * 100 * MS
        watched.put_joints(JointsRequest(positions=(0.01 * step, 0.5)), now_ns)
        if step == 20:
            watched.change_settings({"voxel_size_m": 0.1})
        walking = [step // 3, 411]
        first.update(now_ns, walking, seen=sees_all(watched))
        if step < 12:
            second.update(now_ns, walking[1:])
        file.add(moment_of(watched, now_ns + MS))
    file.close()
    return watched


def pictures(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(
            topics=["/voxels", "/unseen", "/cell", "/tf"]
        ):
            assert schema is not None
            yield channel.topic, schema.name, message.log_time, decoded


def records(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                json.loads(schema.data)
                yield channel.topic, schema.name, message.log_time, message.data


def test_standard_readers_can_read_a_recording(tmp_path: Path) -> None:
    scripted(tmp_path / "a.mcap")
    names: dict[str, str] = {}
    counts: Counter[str] = Counter()
    clouds, transforms = [], []
    for topic, name, log_ns, message in pictures(tmp_path / "a.mcap"):
        names[topic] = name
        counts[topic] += 1
        if topic == "/voxels":
            clouds.append((log_ns, message))
        if topic == "/tf":
            transforms.append(message)
    assert names == {
        "/voxels": "foxglove.PointCloud",
        "/unseen": "foxglove.SceneUpdate",
        "/cell": "foxglove.SceneUpdate",
        "/tf": "foxglove.FrameTransforms",
    }
    # A map that did not change is not written again.
    assert counts == {"/voxels": 12, "/unseen": 2, "/cell": 1, "/tf": 30}
    log_ns, cloud = clouds[0]
    assert log_ns == START_NS + S + MS + WALL_LESS_MONOTONIC_NS
    assert cloud.timestamp.ToNanoseconds() == log_ns
    assert cloud.frame_id == "world"
    assert [(field.name, field.offset, field.type) for field in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("witnesses", 12, 1),
    ]
    points = np.frombuffer(cloud.data, foxglove.POINT)
    assert cloud.point_stride == 16
    centres = np.stack((points["x"], points["y"], points["z"]), axis=1)
    np.testing.assert_allclose(centres, [[0.025, 0.025, 0.025], [0.075, 0.075, 0.075]], atol=1e-6)
    assert points["witnesses"].tolist() == [1, 2]
    assert [one.child_frame_id for one in transforms[0].transforms][:2] == ["unit_1", "unit_2"]


def test_transforms_are_those_of_the_robot(tmp_path: Path) -> None:
    watched = scripted(tmp_path / "a.mcap")
    robot = watched.cell.robot
    assert robot is not None
    step = 0
    for topic, _, _, message in pictures(tmp_path / "a.mcap"):
        if topic != "/tf":
            continue
        pose = robot.link_poses((0.01 * step, 0.5))[0]
        found = next(one for one in message.transforms if one.child_frame_id == f"robot/{robot.links[0].name}")
        assert found.parent_frame_id == "world"
        at, q = found.translation, found.rotation
        np.testing.assert_allclose((at.x, at.y, at.z), pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(rotation(q.w, q.x, q.y, q.z), pose[:3, :3], atol=1e-9)
        step += 1
    assert step == 30


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray[Any, Any]:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_cell_is_a_box_and_models(tmp_path: Path) -> None:
    watched = scripted(tmp_path / "a.mcap")
    (scene,) = [message for topic, _, _, message in pictures(tmp_path / "a.mcap") if topic == "/cell"]
    box, link = scene.entities
    corners = np.array([(point.x, point.y, point.z) for point in box.lines[0].points])
    assert len(corners) == 24
    assert (corners.min(axis=0).tolist(), corners.max(axis=0).tolist()) == ([0.0, 0.0, 0.0], [1.0, 2.0, 0.5])
    assert watched.cell.robot is not None
    assert link.frame_id == f"robot/{watched.cell.robot.links[0].name}"
    assert link.models[0].media_type == "model/stl"
    assert len(link.models[0].data) == 84 + 12 * 50


def test_data_for_a_replay_is_recorded_without_loss(tmp_path: Path) -> None:
    watched = scripted(tmp_path / "a.mcap")
    found = list(records(tmp_path / "a.mcap"))
    assert {(topic, name) for topic, name, _, _ in found} == {
        ("/cellwatch/state", "cellwatch.StateRecord"),
        ("/cellwatch/map", "cellwatch.MapRecord"),
        ("/cellwatch/seen", "cellwatch.SeenRecord"),
        ("/cellwatch/settings", "cellwatch.Settings"),
    }
    last = {topic: data for topic, _, _, data in found}
    now_ns = START_NS + S + 29 * 100 * MS + MS
    view = watched.view(now_ns)
    state = StateRecord.model_validate_json(last["/cellwatch/state"])
    assert (state.at_ns, state.reasons, state.oldest_view_age_s) == (now_ns, view.reasons, view.oldest_view_age_s)
    assert state.units == tuple(watched.units(now_ns))
    assert state.robot == watched.robot_answer(0, now_ns)
    merged = MapRecord.model_validate_json(last["/cellwatch/map"])
    keys, witnesses = merged.arrays()
    assert merged.lattice.lattice() == watched.lattice
    np.testing.assert_array_equal(keys, view.keys)
    np.testing.assert_array_equal(witnesses, view.witnesses)
    seen = SeenRecord.model_validate_json(last["/cellwatch/seen"])
    np.testing.assert_array_equal(seen.counts(), watched.seen_by(now_ns))


@pytest.mark.parametrize("seed", range(5))
def test_boxes_cover_exactly_the_chosen_blocks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chosen = rng.random((7, 8, 9)) < rng.random()
    chosen[2:5, 1:6, 3:8] = True
    covered = np.zeros(chosen.shape, int)
    for first, last in zip(*foxglove.boxes_of(chosen), strict=True):
        covered[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] += 1
    np.testing.assert_array_equal(covered, chosen)


def test_unseen_boxes_are_at_the_blocks() -> None:
    seen_by = np.ones((4, 5, 6), np.uint8)
    seen_by[1, 2, 3] = seen_by[2, 2, 3] = seen_by[0, 0, 0] = 0
    blocks = Lattice((-1.0, 0.0, 0.5), 0.1, seen_by.shape)
    drawn = foxglove.unseen_scene(blocks, seen_by, foxglove.stamp_of(0)).SerializeToString()
    (entity,) = SceneUpdate.FromString(drawn).entities
    found = [
        (one.pose.position.x, one.pose.position.y, one.pose.position.z, one.size.x, one.size.y, one.size.z)
        for one in entity.cubes
    ]
    np.testing.assert_allclose(sorted(found), [(-0.95, 0.05, 0.55, 0.1, 0.1, 0.1), (-0.8, 0.25, 0.85, 0.2, 0.1, 0.1)])
    for cube in entity.cubes:
        assert cube.pose.orientation.w == 1.0
        assert 0.0 < cube.color.a < 0.5
    assert not foxglove.unseen_scene(blocks, np.ones_like(seen_by), foxglove.stamp_of(0)).entities[0].cubes


def test_boxes_are_few() -> None:
    assert len(foxglove.boxes_of(np.ones((5, 6, 7), bool))[0]) == 1
    assert len(foxglove.boxes_of(np.zeros((5, 6, 7), bool))[0]) == 0


def test_stl_has_the_triangles() -> None:
    mesh = box_mesh("box", (0.2, 0.4, 0.6))
    data = foxglove.stl_of(mesh)
    assert int.from_bytes(data[80:84], "little") == len(mesh.faces)
    triangles = np.frombuffer(data[84:], foxglove.STL_TRIANGLE)
    np.testing.assert_array_equal(triangles["corners"], mesh.vertices[mesh.faces].astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(triangles["normal"], axis=1), 1.0, atol=1e-6)


def live(**settings: Any) -> Master:
    """Return a master by the real clock with one unit."""
    watched = master(with_robot=True, stale_after_s=60.0, **settings)
    joined(watched, 1, monotonic_ns()).update(monotonic_ns(), range(0, 4000, 2), seen=sees_all(watched))
    return watched


def recorder(watched: Master, folder: Path, **config: Any) -> Recorder:
    return Recorder(watched, RecordingConfig(**{"maps_per_s": 30.0, "free_bytes_min": 0, **config}), folder)


async def test_it_starts_and_stops(tmp_path: Path) -> None:
    recording = recorder(live(), tmp_path / "new" / "folder")
    assert not recording.status().recording
    began = await recording.start()
    assert began.recording
    assert (await recording.start()).file == began.file
    await until(lambda: recording.status().moments >= 5)
    ended = await recording.stop()
    assert (ended.recording, ended.dropped, ended.reason, ended.maps) == (False, 0, "", 1)
    assert ended.file is not None
    assert ended.bytes == Path(ended.file).stat().st_size
    assert len([topic for topic, *_ in records(Path(ended.file)) if topic == "/cellwatch/state"]) == ended.moments
    again = await recording.start()
    assert again.file != ended.file
    assert await recording.stop() == await recording.stop()


async def test_files_follow_one_another_and_the_oldest_go(tmp_path: Path) -> None:
    stranger = tmp_path / "mine.mcap"
    stranger.write_bytes(bytes(2**18))
    watched = live()
    unit = joined(watched, 2, monotonic_ns())
    recording = recorder(watched, tmp_path, file_bytes_max=2**16, total_bytes_max=2**18, file_s_max=1.0)
    await recording.start()
    first = recording.status().file
    rng = np.random.default_rng(0)
    names: set[str | None] = set()

    def look() -> bool:
        unit.update(monotonic_ns(), np.flatnonzero(rng.random(8000) < 0.5).tolist())
        names.add(recording.status().file)
        return len(names) >= 5

    await until(look)
    await recording.stop()
    files = sorted(tmp_path.glob("cellwatch-*.mcap"))
    assert first is not None
    assert not Path(first).exists()
    # The bound may be exceeded by the last chunk of each file.
    assert sum(file.stat().st_size for file in files) < 2**19
    assert stranger.exists()
    for file in files:
        assert {topic for topic, *_ in records(file)} >= {"/cellwatch/state", "/cellwatch/map", "/cellwatch/seen"}


async def test_a_file_that_cannot_grow_ends_the_recording_with_a_reason(tmp_path: Path) -> None:
    watched = live()
    unit = joined(watched, 2, monotonic_ns())
    recording = recorder(watched, tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    rng = np.random.default_rng(0)

    def look() -> str:
        unit.update(monotonic_ns(), np.flatnonzero(rng.random(8000) < 0.5).tolist())
        return recording.status().reason

    try:
        await recording.start()
        await until(look)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    status = await recording.stop()
    assert not status.recording
    assert status.reason == f"{status.file}: File too large"
    # The master goes on, and recording can start again.
    assert unit.update(monotonic_ns(), [1]).versions == watched.versions.model_copy(update={"pose": 1})
    assert (await recording.start()).recording
    await recording.stop()


async def test_recording_stops_before_the_disk_is_full(tmp_path: Path) -> None:
    recording = recorder(live(), tmp_path, free_bytes_min=2**62)
    with pytest.raises(Refusal, match="bytes are left on the disk") as refused:
        await recording.start()
    assert refused.value.status == 507
    await recording.begin()
    status = recording.status()
    assert (status.recording, status.file) == (False, None)
    assert "bytes are left on the disk" in status.reason
    assert list(tmp_path.iterdir()) == []


async def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Refusal, match="file/folder: Not a directory"):
        await recorder(live(), tmp_path / "file" / "folder").start()


async def test_a_slow_disk_drops_moments_without_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()
    add = RecordingFile.add

    def slow(self: RecordingFile, moment: Any) -> bool:
        assert gate.wait(PATIENCE_S)
        return add(self, moment)

    monkeypatch.setattr(RecordingFile, "add", slow)
    recording = recorder(live(), tmp_path)
    await recording.start()
    await until(lambda: recording.status().dropped >= 5)
    gate.set()
    status = await recording.stop()
    assert status.reason == ""
    assert 1 <= status.moments <= 8


def test_bounds_that_contradict_are_refused() -> None:
    with pytest.raises(ValidationError, match="total_bytes_max: expected twice file_bytes_max"):
        RecordingConfig(file_bytes_max=2**20, total_bytes_max=2**20)
