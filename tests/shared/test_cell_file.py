# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from pydantic import BaseModel

from shared.cell import Cell
from shared.cell_file import (
    BoardFile,
    BodyFile,
    BoxFile,
    CellFile,
    CylinderFile,
    DHFile,
    DHJointFile,
    PoseFile,
    RobotFile,
    ShapeFile,
    ToolFile,
    named_file,
    read_cell_file,
)
from shared.errors import CellError

CHECKOUT = Path(__file__).resolve().parents[2]
MANUAL = (CHECKOUT / "docs" / "cell.md").read_text(encoding="utf-8")
SECTIONS: dict[
    str, tuple[type[BaseModel], type[BaseModel] | None]
] = {  # heading: model, and what is documented elsewhere
    "The file": (CellFile, None),
    "Box": (BoxFile, None),
    "Bodies": (BodyFile, ShapeFile),
    "Shapes": (ShapeFile, None),
    "Cylinder": (CylinderFile, None),
    "Poses": (PoseFile, None),
    "Robot": (RobotFile, None),
    "DH": (DHFile, None),
    "DH rows": (DHJointFile, None),
    "Tool": (ToolFile, ShapeFile),
    "Board": (BoardFile, None),
}
EXAMPLES = re.findall(r"```yaml\n(.*?)```", MANUAL, re.DOTALL)

MINIMAL = "name: c\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n"


def written(folder: Path, text: str) -> Path:
    file = folder / "cell.yaml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize("heading", SECTIONS)
def test_manual_lists_every_key_and_its_default(heading: str) -> None:
    model, elsewhere = SECTIONS[heading]
    section = re.search(rf"^#+ {heading}\n(.*?)(?=^#+ )", MANUAL, re.DOTALL | re.MULTILINE)
    assert section is not None
    documented = dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", section[1], re.MULTILINE))
    fields = {
        name: field for name, field in model.model_fields.items() if name not in getattr(elsewhere, "model_fields", {})
    }
    assert set(documented) == set(fields)
    for name, field in fields.items():
        assert (documented[name] == "required") == field.is_required(), name
        default = field.get_default(call_default_factory=True, validated_data={})
        if not field.is_required() and default is not None and not isinstance(default, BaseModel):
            plain = list(default) if isinstance(default, tuple) else default
            assert yaml.safe_load(documented[name].strip("`")) == plain, name


def test_manual_names_every_model() -> None:
    models = {model for model, _ in SECTIONS.values()}
    below = {each for each in vars(sys.modules[CellFile.__module__]).values() if _is_model(each)}
    assert below == models


def _is_model(value: object) -> bool:
    return (
        isinstance(value, type) and issubclass(value, BaseModel) and not value.__name__.startswith(("_", "BaseModel"))
    )


def test_manual_examples_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(EXAMPLES) == 5
    for name in ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "gripper", "fixture"):
        trimesh.creation.box(extents=(80.0, 80.0, 80.0)).export(tmp_path / f"{name}.stl")
    urdf = tmp_path / "xarm7_realsense" / "robot" / "xarm7.urdf"
    urdf.parent.mkdir(parents=True)
    urdf.write_text(
        '<robot name="r"><link name="a"><collision><geometry><box size="1 1 1"/></geometry></collision></link></robot>'
    )
    monkeypatch.setenv("CELLWATCH_DATA", str(tmp_path))
    cells: dict[str, Cell] = {}
    for example in EXAMPLES:
        whole = example if example.startswith("name:") else MINIMAL + example
        cell = Cell.load(written(tmp_path, whole))
        cells[cell.name] = cell
    ur3 = cells["ur3_dh"].robot
    assert ur3 is not None
    assert ur3.joint_names == ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
    np.testing.assert_allclose(ur3.frame_pose("link_6", np.zeros(6))[:3, 3], [-0.4569, -0.19425, 0.06655], atol=1e-9)
    xarm7 = yaml.safe_load((CHECKOUT / "assets" / "cells" / "xarm7" / "cell.yaml").read_text(encoding="utf-8"))
    assert xarm7 in [yaml.safe_load(example) for example in EXAMPLES]


BAD = {
    "unknown key": (
        "boks: 1\n",
        "boks: expected a key out of name, box, static, objects, robot, board, got an unknown one",
    ),
    "unknown key below": (
        "static: [{name: a, box: [1, 1, 1], pose: {xyz: [0, 0, 0], rpy: [0, 0, 0]}}]\n",
        "static[0].pose.rpy: expected a key out of xyz, rpy_deg, got an unknown one",
    ),
    "unknown key in a dictionary": (
        "robot: {urdf: r.urdf, link_meshes: {elbow: {mesh: a.stl, size: 1}}}\n",
        "robot.link_meshes.elbow.size: expected a key out of mesh, scale, box, cylinder, pose, got an unknown one",
    ),
    "twice": ("static: []\nstatic: []\n", "line 4: expected YAML, got a syntax error: duplicate key static"),
    "scale": ("static: [{name: a, mesh: a.stl, scale: -1}]\n", "static[0].scale: expected greater than 0, got -1"),
    "text": (
        "static:\n  - name: a\n    mesh: a.stl\n    scale: 0,001\n",
        "static[0].scale: expected a number, got '0,001'",
    ),
    "truth": ("static: [{name: a, mesh: a.stl, scale: true}]\n", "static[0].scale: expected a number, got True"),
    "nan": ("static: [{name: a, box: [1, 1, .nan]}]\n", "static[0].box[2]: expected a finite number, got nan"),
    "pair": ("objects: [{name: a, box: [1, 1]}]\n", "objects[0].box[2]: expected a value, got none"),
    "no shape": ("static: [{name: a}]\n", "static[0]: expected one of mesh, box or cylinder, got none"),
    "two shapes": (
        "static: [{name: a, mesh: a.stl, box: [1, 1, 1]}]\n",
        "static[0]: expected one of mesh, box or cylinder, got mesh and box",
    ),
    "scaled box": ("static: [{name: a, box: [1, 1, 1], scale: 0.001}]\n", "static[0]: expected scale only beside mesh"),
    "name": ("static: [{name: a b, box: [1, 1, 1]}]\n", "static[0].name: expected text that matches ^"),
    "name twice": (
        "static: [{name: a, box: [1, 1, 1]}]\nobjects: [{name: a, box: [1, 1, 1]}]\n",
        "expected each name once among static and objects, got a again",
    ),
    "neither": ("robot: {}\n", "robot: expected either urdf or dh, got neither"),
    "both": ("robot: {urdf: r, dh: {joints: [{}]}}\n", "robot: expected either urdf or dh, got both"),
    "urdf's key": ("robot: {meshes: visual, dh: {joints: [{}]}}\n", "robot: expected meshes only beside urdf, got dh"),
    "dh tool": (
        "robot: {dh: {joints: [{}]}, tool: {box: [1, 1, 1], parent: a}}\n",
        "robot: expected tool.parent only beside urdf",
    ),
    "no rows": ("robot: {dh: {joints: []}}\n", "robot.dh.joints: expected at least 1 entries, got 0"),
    "meshes": (
        "robot: {urdf: r, meshes: hull}\n",
        "robot.meshes: expected 'collision_or_visual', 'collision' or 'visual', got 'hull'",
    ),
    "marker": (
        "board: {columns: 5, rows: 7, square_m: 0.04, marker_m: 0.04}\n",
        "board: expected marker_m below square_m = 0.04, got 0.04",
    ),
    "narrow": (
        "board: {columns: 1, rows: 7, square_m: 0.04, marker_m: 0.03}\n",
        "board: expected a charuco board of at least 2 x 2 squares, got 1 x 7",
    ),
    "columns": (
        "board: {columns: 5.0, rows: 7, square_m: 0.04, marker_m: 0.03}\n",
        "board.columns: expected a whole number, got 5.0",
    ),
    "four": ("objects: [{name: a, box: [1, 1, 1, 1]}]\n", "objects[0].box: expected at most 3 entries, got 4"),
    "no list": ("static: {a: 1}\n", "static: expected a list, got keys and values"),
    "no keys": ("robot: [1]\n", "robot: expected keys and values, got a list"),
    "nothing": ("static: [null]\n", "static[0]: expected keys and values, got nothing"),
    "list": ("robot: {urdf: [a]}\n", "robot.urdf: expected text, got a list"),
    "yaml": ("static: [\n", "line 4: expected YAML, got a syntax error: expected the node content"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_file_is_one_sentence_that_names_file_and_key(tmp_path: Path, case: str) -> None:
    text, words = BAD[case]
    file = written(tmp_path, MINIMAL + text)
    with pytest.raises(CellError) as caught:
        read_cell_file(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_problem_gets_its_own_sentence(tmp_path: Path) -> None:
    file = written(tmp_path, "name: 3\nbox: {min: [0, 0, 0], max: [1, 1, 0]}\nrobot: {urdf: 1}\nstatic: 5\n")
    with pytest.raises(CellError) as caught:
        read_cell_file(file)
    assert str(caught.value).splitlines() == [
        f"{file}: name: expected text, got 3",
        f"{file}: box: expected max above min on three axes, got [0.0, 0.0, 0.0] to [1.0, 1.0, 0.0]",
        f"{file}: static: expected a list, got 5",
        f"{file}: robot.urdf: expected text, got 1",
    ]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "expected keys and values, got NoneType"),
        (b"- 1\n", "expected keys and values, got list"),
        (b"\xff\xfe\x00", "expected text in UTF-8"),
        (b"name: c\n", "box: expected a value, got none"),
        (b"!!python/object:os.system {}\n", "expected YAML, got a syntax error: could not determine a constructor"),
    ],
)
def test_invalid_cell_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    file = tmp_path / "cell.yaml"
    file.write_bytes(content)
    with pytest.raises(CellError, match=re.escape(words)):
        read_cell_file(file)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CellError, match=r"gone\.yaml: expected a readable cell file, got: No such file"):
        read_cell_file(tmp_path / "gone.yaml")


def test_every_form_of_path_finds_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = tmp_path / "cells" / "cell.yaml"
    target = tmp_path / "cells" / "meshes" / "a.stl"
    target.parent.mkdir(parents=True)
    target.touch()
    monkeypatch.setenv("CELL_TEST_FOLDER", str(tmp_path / "cells"))
    for text in ("meshes/a.stl", str(target), "$CELL_TEST_FOLDER/meshes/a.stl", "${CELL_TEST_FOLDER}/meshes/a.stl"):
        assert named_file(cell, "k", text) == target
    package = tmp_path / "site" / "cell_test_wheel"
    (package / "meshes").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "meshes" / "b.stl").touch()
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert named_file(cell, "k", "package:cell_test_wheel/meshes/b.stl") == package / "meshes" / "b.stl"
    assert "cell_test_wheel" not in sys.modules
    # By a distribution's name, for wheels whose files belong to no package.
    assert named_file(cell, "k", "package:airo-models/airo_models/arms/ur3e/ur3e.urdf").is_file()
    assert named_file(cell, "k", "package:airo_models/arms/ur3e/ur3e.urdf").is_file()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gone.stl", "k: expected a file at"),
        ("", "k: expected a file at"),
        ("$CELL_TEST_UNSET/a.stl", "k: expected the environment variable CELL_TEST_UNSET to be set, for $CELL_TEST"),
        ("package:no_such_wheel/a.stl", "k: expected an installed package no_such_wheel, for package:no_such_wheel"),
        ("package:", "k: expected an installed package (no name), for package:"),
        ("package:airo_models/gone.stl", "k: expected a file at"),
        ("package:airo-models/gone.stl", "k: expected a file at"),
    ],
)
def test_paths_to_missing_files_are_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(CellError) as caught:
        named_file(tmp_path / "cell.yaml", "k", text)
    assert str(caught.value).startswith(f"{tmp_path / 'cell.yaml'}: {words}")


def test_integers_are_lengths_too(tmp_path: Path) -> None:
    content: Any = read_cell_file(written(tmp_path, MINIMAL + "static: [{name: a, box: [1, 2, 3]}]\n"))
    assert content.static[0].box == (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(content.static[0].pose.transform(), np.eye(4))


def test_values_nested_too_deeply_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CellError, match=r"cell\.yaml: .*expected a few levels of nesting"):
        read_cell_file(written(tmp_path, MINIMAL + "static: " + "[" * 3000 + "]" * 3000 + "\n"))
