"""Hostile folders of objects: names never leave the folder, and one bad entry costs its own object
alone.
"""

import dataclasses
import json
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchgrasp import PointCloud, load_grasps
from torchgrasp.cloud.read import save_cloud
from torchgrasp.data import list_views, read_entries, read_entry, read_object_mesh, read_view
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.evaluation import EvaluationSpec, Protocol, evaluate
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore
from torchgrasp.evaluation.views import ObjectView
from torchgrasp.foundation.errors import CloudFileError, DatasetError, MeshError, Status
from torchgrasp.hand.load import load_hand

POSE = [[1.0, 0.0, 0.0, 0.4], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
GOOD = {"views": {"v0": {"T_object_camera": POSE}}}


def pose(**changes: object) -> dict:
    return {"views": {"v0": {"T_object_camera": POSE} | changes}}


ENTRIES = {
    "a list": [],
    "null": None,
    "a text": "views",
    "no views": {},
    "views a list": {"views": ["v0"]},
    "views null": {"views": None},
    "a view null": {"views": {"v0": None}},
    "no pose": {"views": {"v0": {}}},
    "a pose of 3 x 3": pose(T_object_camera=[[1, 0, 0]] * 3),
    "a ragged pose": pose(T_object_camera=[[1], [1, 2], [1, 2, 3], []]),
    "a pose of texts": pose(T_object_camera=[["1"] * 4] * 4),
    "a pose null": pose(T_object_camera=None),
    "a pose too deep": pose(T_object_camera=[[[1] * 4] * 4] * 4),
    "a camera at 1e300 m": pose(T_object_camera=[[1, 0, 0, 1e300], *POSE[1:]]),
    "a scale of text": GOOD | {"suggested_scale": "1.0"},
    "a scale null is a list": GOOD | {"suggested_scale": [1]},
    "a scale of 0": GOOD | {"suggested_scale": 0},
    "a scale below 0": GOOD | {"suggested_scale": -1},
    "a scale that is true": GOOD | {"suggested_scale": True},
    "a scale of 1e-300": GOOD | {"suggested_scale": 1e-300},
    "a scale of 4000 digits": GOOD | {"suggested_scale": 10**4000},
    "a mass of text": GOOD | {"mass_kg": "1 kg"},
    "a mass below 0": GOOD | {"mass_kg": -1},
    "a family that is a number": GOOD | {"family": 5},
    "a group of a million letters": GOOD | {"group": "x" * 10**6},
}

NAMES = [
    "",
    ".",
    "..",
    "../outside",
    "a/b",
    "/tmp",
    "a\\b",
    "c:",
    "a\0b",
    "a\nb",
    "\x1b]0;x\x07",
    " a",
    "a.",
]
NAMES += ["a" * 101, "\ud800", "\u202eexe"]

FILES = {
    "a list": b"[1]",
    "null": b"null",
    "a number": b"5",
    "objects a list": b'{"objects": ["cup"]}',
    "objects a number": b'{"objects": 5}',
    "no objects": b"{}",
    "garbage": b"\xff\xfe\x00",
    "empty": b"",
    "latin-1": b'{"objects": {"c\xe4": {}}}',
    "deep lists": b"[" * 200_000,
    "deep objects": b'{"objects":' * 100_000,
    "NaN": b'{"objects": {"cup": {"suggested_scale": NaN}}}',
    "a number of 5000 digits": b'{"objects": {"cup": {"suggested_scale": ' + b"1" * 5000 + b"}}}",
}


def write(folder: Path, entries: object) -> Path:
    """Write a manifest of these objects, and the files of a box under each plain name."""
    (folder / "manifest.json").write_text(json.dumps({"objects": entries}))
    return folder


def put(folder: Path, size: float = 0.06, view: str = "v0") -> None:
    folder.mkdir(parents=True)
    box = trimesh.creation.box((size, size, size))
    box.apply_translation([0, 0, size / 2])
    box.export(folder / "mesh.ply")
    points, faces = trimesh.sample.sample_surface(box, 1500, seed=0)
    points = points[
        box.face_normals[faces] @ [0.7, 0.0, 0.7] > 0.1
    ]  # what a camera sees from above and ahead
    save_cloud(PointCloud(torch.from_numpy(np.array(points))), folder / f"{view}_noisy.ply")


@pytest.mark.parametrize("name", ENTRIES)
def test_a_bad_entry_is_refused_by_field_and_the_others_are_read(tmp_path: Path, name: str):
    write(tmp_path, {"bad": ENTRIES[name], "good": GOOD})
    assert list(read_entries(tmp_path)) == ["bad", "good"] and list_views(
        tmp_path, only=["good"]
    ) == [("good", "v0")]
    with pytest.raises(DatasetError, match=r"manifest\.json: objects\.bad") as refused:
        read_entry(tmp_path, "bad")
    assert len(str(refused.value)) < 500


@pytest.mark.promise("H2")
@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_a_name_is_one_part_of_a_path(tmp_path: Path, name: str):
    for entries in ({name: GOOD}, {"cup": {"views": {name: GOOD["views"]["v0"]}}}):
        with pytest.raises(DatasetError, match="the name"):
            list_views(write(tmp_path, entries))


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_manifest_is_refused(tmp_path: Path, name: str):
    (tmp_path / "manifest.json").write_bytes(FILES[name])
    with pytest.raises(DatasetError):
        list_views(tmp_path)


@pytest.mark.promise("H2")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes among its files")
def test_pipes_and_links_to_the_outside_are_refused(tmp_path: Path):
    put(tmp_path / "outside")
    folder = tmp_path / "objects"
    put(folder / "cup")
    write(folder, {"cup": GOOD})
    assert read_object_mesh(folder, "cup").volume == pytest.approx(0.06**3)
    for file, read in (
        ("mesh.ply", read_object_mesh),
        ("v0_noisy.ply", lambda *at: read_view(*at, "v0")),
    ):
        (folder / "cup" / file).unlink()
        (folder / "cup" / file).symlink_to(tmp_path / "outside" / file)
        with pytest.raises(DatasetError, match="files within"):
            read(folder, "cup")
        (folder / "cup" / file).unlink()
        os.mkfifo(folder / "cup" / file)
        with pytest.raises((MeshError, CloudFileError), match="no file"):
            read(folder, "cup")
    (folder / "manifest.json").unlink()
    os.mkfifo(folder / "manifest.json")
    with pytest.raises(DatasetError, match="no file"):
        read_entries(folder)


def test_a_view_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(DatasetError, match="view 'v1' of 'cup'"):
        read_view(write(tmp_path, {"cup": GOOD}), "cup", "v1")


@pytest.mark.promise("H2")
def test_bad_entries_and_names_cost_their_objects_alone(tmp_path: Path):
    outside = tmp_path / "outside"
    put(outside)
    put(tmp_path / "objects" / "gone")
    precious = tmp_path / "outside_v0.safetensors"
    precious.write_text("precious")
    write(
        tmp_path / "objects",
        {str(outside): GOOD, "../outside": GOOD, "loose": {"views": 5}, "torn": GOOD},
    )
    scores = list(
        evaluate(tmp_path / "objects", load_hand("barrett"), spec=EvaluationSpec(1, starts=5))
    )
    assert [score.refusal for score in scores] == [Status.BAD_OBJECT] * 4
    assert all(score.note.startswith(("objects: expected", "mesh: expected")) for score in scores)
    assert sum(math.isnan(score.seconds) for score in scores) == 3  # the fourth was looked at
    assert precious.read_text() == "precious" and not list(outside.glob("*.safetensors"))


@pytest.mark.promise("H2")
def test_two_names_never_share_a_file_of_grasps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Each view keeps grasps with a score of its own, which its attempts read; nothing is planned
    or simulated.
    """
    objects = tmp_path / "objects"
    grasps = load_shipped_grasp("jug", "barrett")
    put(objects / "a", 0.06, "b_c"), put(objects / "a_b", 0.05, "c")
    view = GOOD["views"]["v0"]
    write(objects, {"a": {"views": {"b_c": view}}, "a_b": {"views": {"c": view}}})

    def plan(view: ObjectView, shelf: Path, friction: float, spec: EvaluationSpec) -> ViewScore:
        dataclasses.replace(grasps, score=torch.full((1,), float(len(view.object)))).save(
            view.file(shelf)
        )
        return dataclasses.replace(view.score, executable=1)

    def attempt(
        view: ObjectView, shelf: Path, protocol: Protocol, spec: EvaluationSpec, row: int, draw: int
    ) -> ProtocolResult:
        return ProtocolResult(
            row, draw, True, Status.OK, force=float(load_grasps(view.file(shelf)).score)
        )

    monkeypatch.setattr("torchgrasp.evaluation.sweep._plan", plan)
    monkeypatch.setattr("torchgrasp.evaluation.sweep._try", attempt)
    scores = list(
        evaluate(objects, load_hand("barrett"), spec=EvaluationSpec(1), folder=tmp_path / "grasps")
    )
    written = sorted(
        str(x.relative_to(tmp_path / "grasps"))
        for x in (tmp_path / "grasps").rglob("*.safetensors")
    )
    assert written == ["a/b_c.safetensors", "a_b/c.safetensors"]
    assert [attempt.force for score in scores for attempt in score.attempts] == [1.0, 3.0]
